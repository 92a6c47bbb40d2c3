"""zstandard for small and large pieces: no magic, no sizes; the size is known to whoever expands."""

from __future__ import annotations

import zstandard

from ..errors import CorruptStream

_LEVEL, _LARGE, _LARGE_LEVEL = 19, 1 << 23, 9  # the highest level does 3 MB a second
_MOST = 1 << 16  # no byte of zstandard expands to more


def squeeze(data: bytes, dictionary: bytes = b"") -> bytes:
    """The data, smaller where that can be; never larger by more than a few bytes."""
    parameters = zstandard.ZstdCompressionParameters.from_level(
        _LEVEL if len(data) < _LARGE else _LARGE_LEVEL,
        source_size=len(data),
        format=zstandard.FORMAT_ZSTD1_MAGICLESS,
        write_content_size=False,
        write_dict_id=False,
    )
    return zstandard.ZstdCompressor(dict_data=_raw(dictionary), compression_params=parameters).compress(data)


def expand(data: bytes, size: int, dictionary: bytes = b"") -> bytes:
    """The `size` bytes that were squeezed. Raises CorruptStream where they are not so many, or are none."""
    if size == 0:
        return b""
    if size > len(data) * _MOST:
        raise CorruptStream(f"{len(data)} compressed bytes cannot hold {size}")
    decompressor = zstandard.ZstdDecompressor(dict_data=_raw(dictionary), format=zstandard.FORMAT_ZSTD1_MAGICLESS)
    try:
        with decompressor.stream_reader(data) as stream:  # which, unlike `decompress`, trusts no size in the data
            found = stream.read(size + 1)
    except zstandard.ZstdError as error:
        raise CorruptStream(f"compressed bytes are damaged: {error}") from error
    if len(found) != size:
        raise CorruptStream(f"compressed bytes hold {len(found)} bytes, {size} were promised")
    return found


def _raw(dictionary: bytes) -> zstandard.ZstdCompressionDict | None:
    return zstandard.ZstdCompressionDict(dictionary, dict_type=zstandard.DICT_TYPE_RAWCONTENT) if dictionary else None
