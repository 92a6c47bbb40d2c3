"""CRC-32 that not only notices a damaged byte but finds it: the checksum is linear, so an error leaves its own mark."""

from __future__ import annotations

import zlib
from collections.abc import Iterator


def _table() -> list[int]:
    """What one byte makes of an empty register (the polynomial of zlib, reflected)."""
    entries = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0xEDB88320 if value & 1 else 0)
        entries.append(value)
    return entries


_TABLE = _table()
_INDEX = [0] * 256  # the top byte of a table's entry names it
for _n, _entry in enumerate(_TABLE):
    _INDEX[_entry >> 24] = _n


def mended(data: bytes, checksum: int) -> Iterator[bytes]:
    """The data with one byte changed so that its CRC-32 is the wanted one, in every way there is.

    Takes time in proportion to the data. There is seldom more than one way below 1 MB: each byte has a chance of 2^-24.
    """
    mark = zlib.crc32(data) ^ checksum
    for at in range(len(data) - 1, -1, -1):
        error = _INDEX[mark >> 24]
        mark ^= _TABLE[error]
        if not mark and error:
            yield data[:at] + bytes([data[at] ^ error]) + data[at + 1 :]
        mark = mark << 8 | error  # what the register held a byte earlier
