"""`jaxmocap demo`: the main job on motion made here: learn, compress, decompress, measure, look."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

from .base import Command, Report

_SECONDS = 8.0
_TRAINING_SEEDS = (1, 2, 3, 4)
_TARGETS_CM = (0.3, 0.5, 1.0, 2.0)


@dataclass(kw_only=True)
class Demo(Command):
    """Walk a synthetic figure through training, encoding, decoding, comparing and viewing."""

    output: Path = Path("out/demo")
    """The folder for all files that are made."""

    def run(self) -> Report:
        from ..codecs import LsdtClip, Target
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

        rows = []
        for cm in _TARGETS_CM:
            _say(f"compressing to a mean error of {cm:g} cm")
            codec = LsdtClip(artifact, target=Target("mean", cm))
            data = codec.encode(motion)
            decoded = codec.decode(data)
            raw_bytes = motion.frame_count * motion.skeleton.joint_count * 12
            measured = {key: compare(motion, decoded)[key] for key in ("mean_cm", "max_cm")}
            rows.append({"target_cm": cm, "stream_bytes": len(data), "ratio": raw_bytes / len(data), **measured})
            if cm == 1.0:
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
            f"A walk of {report['frames']} frames, {report['text_bytes']:,} bytes as BVH; "
            f"a transform learned in {report['training_seconds']:.1f} s from four other walks:",
            "",
            f"{'target cm':>10}{'bytes':>10}{'ratio':>10}{'mean cm':>10}{'max cm':>10}",
        ]
        lines += [
            f"{r['target_cm']:>10g}{r['stream_bytes']:>10,}{r['ratio']:>9.0f}:1{r['mean_cm']:>9.3f}{r['max_cm']:>10.2f}"
            for r in rows
        ]
        return "\n".join([*lines, "", f"Open {report['player']} in a browser to see the original beside what is decoded."])


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
