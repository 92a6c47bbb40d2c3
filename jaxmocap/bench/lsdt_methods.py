"""What `jaxmocap bench lsdt` compares: the methods of Figs. 6 and 7, and what Table 2 says of them beyond curves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..codecs import AbstractCodec, Target, load_artifact, make

_CLIP, _FRAME = "lsdt-clip", "lsdt-frame"
_NO_SETTINGS = ("codec", "target", "embed")


@dataclass(frozen=True)
class Method:
    """A codec with its settings. `latency_frames` are those that must be there before the first can be coded, None where
    that is the whole sequence; `found` is what the encoder looks for besides the step; `besides` is what a receiver
    needs besides coefficients, and where it comes from.
    """

    config: Mapping[str, str | int]
    latency_frames: int | None
    found: tuple[str, ...]
    besides: str

    def codec(self, target: Target) -> AbstractCodec:
        return make({**self.config, "target": target})


_OF_MODEL = "bases and codes: model"
FRAME_BASED: dict[str, Method] = {
    "lsdt-frame": Method({"codec": _FRAME}, 0, ("bits of a count",), _OF_MODEL),
    "dct-frame": Method({"codec": "dct-frame"}, 0, ("bits of a count",), "codes: model"),
    "live": Method({"codec": "live", "metric": "joints"}, 0, (), "basis and networks: model"),
}
CLIP_BASED: dict[str, Method] = {
    f"lsdt-clip {form} L={n}": Method({"codec": _CLIP, "form": form, "clip_frames": n}, n, (), _OF_MODEL)
    for form in ("runs", "paper")
    for n in (60, 120, 240)
} | {
    "mdtt": Method({"codec": "mdtt"}, None, ("rank",), "bases: stream; rig: model"),
    "pca-rdo": Method({"codec": "pca-rdo"}, None, ("clip length", "ranks", "weights"), "bases, weights: stream; rig: model"),
    "learned": Method({"codec": "learned", "metric": "joints"}, None, ("levels",), "basis and networks: model"),
}


def table(curves: Mapping[str, list[dict]], mean_cm: float) -> list[dict]:
    """Rows of Table 2, of the methods that have a curve, from the streams of its point at a mean error.

    `set` are the parameters that a codec is given besides the quantiser's, `found` those that its encoder searches.
    `besides_bytes` are those of bones and bases in all streams, `model_bytes` those of the file that both ends have.
    """
    rows = []
    for name, method in (FRAME_BASED | CLIP_BASED).items():
        at = next((row for row in curves.get(name, []) if row["target_cm"] == mean_cm), None)
        if at is not None:
            codec = method.codec(Target("mean", mean_cm))
            rows.append({
                "method": name,
                "codec": codec.config()["codec"],
                "latency_frames": method.latency_frames,
                "set": [key for key in codec.config() if key not in _NO_SETTINGS],
                "found": list(method.found),
                "encode_fps": at["encode_fps"],
                "decode_fps": at["decode_fps"],
                "besides": method.besides,
                "besides_bytes": sum(clip["sections"]["skeleton"] for clip in at["clips"]),
                "bytes": at["bytes"],
                "model_bytes": len(load_artifact(str(method.config["codec"])).data),
                "ratio": at["ratio"],
            })
    return rows
