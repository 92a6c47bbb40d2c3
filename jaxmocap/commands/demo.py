"""`jaxmocap demo`: the main job on motion made here: learn, compress, decompress, measure, look."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

from .base import Command, Report

_SECONDS = 8.0
_TRAINING_SEEDS = (1, 2, 3, 4)
_TARGETS_CM = (0.5, 1.0, 2.0)
_SHOWN = ("learned", 1.0)


@dataclass(kw_only=True)
class Demo(Command):
    """Walk a synthetic figure through training, encoding, decoding, comparing and viewing."""

    output: Path = Path("out/demo")
    """The folder for all files that are made."""

    def run(self) -> Report:
        from ..codecs import Learned, LsdtClip, Target, load_artifact
        from ..formats import write_motion
        from ..formats.text import write_bytes
        from ..metrics import compare
        from ..synthesis import walk
        from ..training import Corpus, train_lsdt
        from ..viewer import motion_player

        corpus = self.output / "corpus"
        corpus.mkdir(parents=True, exist_ok=True)
        _say(f"making {len(_TRAINING_SEEDS)} walks to learn from, and one to compress")
        for seed in _TRAINING_SEEDS:
            write_motion(walk(seed, _SECONDS), corpus / f"walk{seed}.bvh")
        motion = walk(0, _SECONDS)
        write_motion(motion, self.output / "walk.bvh")

        _say("learning a transform from them")
        began = time.perf_counter()
        artifact, _ = train_lsdt(Corpus.of([corpus], motion.unit_cm), self.output / "demo.partial")
        (self.output / "demo.partial").unlink(missing_ok=True)
        write_bytes(self.output / "demo.safetensors", artifact.data)
        learned = time.perf_counter() - began

        shipped = load_artifact("learned")
        raw_bytes = motion.frame_count * motion.skeleton.joint_count * 12
        rows = []
        for cm in _TARGETS_CM:
            _say(f"compressing to a mean error of {cm:g} cm")
            target = Target("mean", cm)
            codecs = {"learned": Learned(shipped, "joints", target), "lsdt-clip": LsdtClip(artifact, target=target)}
            for name, codec in codecs.items():
                data = codec.encode(motion)
                decoded = codec.decode(data)
                error = compare(motion, decoded)
                sizes = {"stream_bytes": len(data), "ratio": raw_bytes / len(data)}
                rows.append({"codec": name, "target_cm": cm, **sizes, "mean_cm": error["mean_cm"], "max_cm": error["max_cm"]})
                if (name, cm) == _SHOWN:
                    write_bytes(self.output / "walk.jmc", data)
                    write_motion(decoded, self.output / "walk.decoded.bvh")
                    page = motion_player(motion, decoded, ("original", f"decoded from {len(data):,} bytes"))
                    write_bytes(self.output / "player.html", page.encode())
        text_bytes = (self.output / "walk.bvh").stat().st_size
        return {
            "frames": motion.frame_count,
            "text_bytes": text_bytes,
            "training_seconds": learned,
            "model_bytes": len(artifact.data),
            "results": rows,
            "player": str(self.output / "player.html"),
        }

    def text(self, report: Report) -> str:
        rows = report["results"]
        assert isinstance(rows, list)
        lines = [
            f"A walk of {report['frames']} frames, {report['text_bytes']:,} bytes as BVH, coded by learned with the model that",
            f"is shipped, and by lsdt-clip with one learned in {report['training_seconds']:.1f} s from four other walks:",
            "",
            f"{'target cm':>10}  {'codec':<10}{'bytes':>10}{'ratio':>10}{'mean cm':>10}{'max cm':>10}",
        ]
        lines += [
            f"{r['target_cm']:>10g}  {r['codec']:<10}{r['stream_bytes']:>10,}{r['ratio']:>9.0f}:1"
            f"{r['mean_cm']:>9.3f}{r['max_cm']:>10.2f}"
            for r in rows
        ]
        return "\n".join([*lines, "", f"Open {report['player']} in a browser to see the original beside what is decoded."])


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
