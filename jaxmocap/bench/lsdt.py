"""LSDT as in Hou et al. 2016: rate and distortion (Figs. 6 and 7), sparsity (Fig. 4), bases and transforms (Figs. 2, 3, 5)."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..codecs import AbstractCodec, LsdtClip, Target, load_artifact
from ..codecs.artifact import Artifact
from ..codecs.container import read_stream
from ..kinematics import positions_cm
from ..metrics import compare
from ..motion import Motion
from ..training.corpus import Corpus
from ..training.positions import ITERATIONS, SAMPLES, SPARSITY
from ..transforms import constant, dct_matrix, fit_lsdt, growing, haar_matrix
from .lossless_folder import timed

SHARES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
SPARSITIES = (2, 5, 8, 11)
_WARM_UP = Target("step", 2.0)


def rate_distortion(
    motions: Mapping[str, Motion], codec: Callable[[Target], AbstractCodec], targets: Sequence[float]
) -> list[dict]:
    """A row a target: bytes of all streams, their ratio to float32 positions, the pooled error, and speeds.

    Every clip meets the target by itself. It is coded once beforehand, so that speeds, by processor seconds and with the
    search for the target, are those after warm-up.
    """
    made = codec(_WARM_UP)
    for motion in motions.values():
        made.decode(made.encode(motion))
    rows = []
    for cm in targets:
        made = codec(Target("mean", cm))
        clips = []
        for name, motion in motions.items():
            data, encode_s = timed(lambda made=made, motion=motion: made.encode(motion))
            decoded, decode_s = timed(lambda made=made, data=data: made.decode(data))
            clips.append({
                "clip": name,
                "frames": motion.frame_count,
                "bytes": len(data),
                "ratio": motion.frame_count * motion.skeleton.joint_count * 12 / len(data),
                **{k: compare(motion, decoded)[k] for k in ("mean_cm", "max_cm")},
                "sections": read_stream(data).section_bytes(),
                "encode_s": encode_s,
                "decode_s": decode_s,
            })
        rows.append({"target_cm": cm, **_pooled(clips), "clips": clips})
    return rows


def _pooled(clips: list[dict]) -> dict:
    frames = sum(c["frames"] for c in clips)
    size = sum(c["bytes"] for c in clips)
    return {
        "ratio": sum(c["ratio"] * c["bytes"] for c in clips) / size,
        "bytes": size,
        "mean_cm": sum(c["mean_cm"] * c["frames"] for c in clips) / frames,
        "max_cm": max(c["max_cm"] for c in clips),
        "encode_fps": frames / sum(c["encode_s"] for c in clips),
        "decode_fps": frames / sum(c["decode_s"] for c in clips),
    }


def of_clip(rows: Sequence[dict], name: str) -> list[dict]:
    """The rows of one clip alone."""
    return [{"target_cm": row["target_cm"], **clip} for row in rows for clip in row["clips"] if clip["clip"] == name]


def error_at(rows: Sequence[dict], ratio: float) -> float | None:
    """The mean error at a ratio: log error over log ratio between the two measured points around it, None outside them."""
    points = sorted((row["ratio"], row["mean_cm"]) for row in rows)
    if not points or not points[0][0] <= ratio <= points[-1][0]:
        return None
    ratios, errors = np.log(points).T
    return float(np.exp(np.interp(np.log(ratio), ratios, errors)))


def error_saved(rows: Sequence[dict], rival: Sequence[dict]) -> list[dict[str, float]]:
    """What part of a rival's mean error is saved at every ratio that was measured of either and lies within both curves."""
    found = []
    for ratio in sorted(row["ratio"] for row in (*rows, *rival)):
        ours, theirs = error_at(rows, ratio), error_at(rival, ratio)
        if ours is not None and theirs is not None:
            found.append({"ratio": ratio, "saved": 1 - ours / theirs})
    return found


def sparsity_models(
    corpus: Corpus, shipped: Artifact, train: Callable[[Corpus, Path, int], tuple[Artifact, dict]]
) -> dict[int, Artifact]:
    """Models trained alike but for P: 2, 5, 8 and 11 (Fig. 4), of which the one for 8 is shipped."""
    with tempfile.TemporaryDirectory() as folder:
        return {
            p: shipped if p == SPARSITY else train(corpus, Path(folder) / f"{p}.partial", p)[0] for p in SPARSITIES
        }


def bases(learned: Float[np.ndarray, "3 joints joints"]) -> dict[str, list]:
    """The matrices of Fig. 2, a row a basis function: DCT, and what was learned for each coordinate."""
    found = {"dct": dct_matrix(learned.shape[-1]), **{f"lsdt {'xyz'[d]}": basis for d, basis in enumerate(learned)}}
    return {name: np.asarray(basis, np.float64).round(4).tolist() for name, basis in found.items()}


def training_samples(corpus: Corpus, count: int = SAMPLES) -> Float[np.ndarray, "3 samples joints"]:
    """Frames at an even pace over a corpus, in cm."""
    frames = np.concatenate([np.asarray(positions_cm(m))[::8] for m in corpus])
    chosen = frames[np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int)]
    return np.ascontiguousarray(chosen.transpose(2, 0, 1))


def convergence(samples: Float[np.ndarray, "3 samples joints"], sparsity: int = 8) -> dict[str, list]:
    """The objective (6) over the iterations, from DCT and from DWT, with constant and with growing P (Fig. 3)."""
    joints = samples.shape[2]
    starts = {"dct": dct_matrix(joints), "dwt": haar_matrix(joints)}
    schedules = {"constant": constant(sparsity), "growing": growing(sparsity)}
    return {
        f"{schedule}, {start}": np.asarray(
            fit_lsdt(jnp.asarray(samples), jnp.asarray(basis, jnp.float32), part).objective
        ).tolist()
        for schedule, part in schedules.items()
        for start, basis in starts.items()
    }


def spatial_transforms(
    motions: dict[str, Motion], basis: Float[np.ndarray, "3 joints joints"]
) -> dict[str, list[dict[str, float]]]:
    """Distortion at equal shares of nonzero coefficients for LSDT, DCT and DWT over the joints of a frame (Fig. 5)."""
    positions = np.concatenate([np.asarray(positions_cm(m)) for m in motions.values()]).astype(np.float64)
    joints = positions.shape[1]
    bases = {"lsdt": basis, "dct": np.stack([dct_matrix(joints)] * 3), "dwt": np.stack([haar_matrix(joints)] * 3)}
    result = {}
    for name, b in bases.items():
        coefficients = np.einsum("dij,njd->ndi", b, positions)
        rows = []
        for share in SHARES:
            least = np.quantile(np.abs(coefficients), 1 - share)
            kept = np.where(np.abs(coefficients) > least, coefficients, 0.0)
            error = np.linalg.norm(np.einsum("dij,ndi->njd", b, kept) - positions, axis=-1)
            rows.append({"share": share, "mean_cm": float(error.mean())})
        result[name] = rows
    return result


def training_speed(samples: Float[np.ndarray, "3 samples joints"], sparsity: int = 8) -> dict[str, float]:
    """Seconds of Algorithm 1 compiled, compile time included, and of the same in numpy, one after the other."""
    start = dct_matrix(samples.shape[2]).astype(np.float32)
    jax.clear_caches()
    began = time.perf_counter()
    fitted = fit_lsdt(jnp.asarray(samples), jnp.asarray(start), constant(sparsity))
    fitted.objective.block_until_ready()
    compiled = time.perf_counter()
    for m in samples:
        numpy_algorithm_1(m, start, sparsity, ITERATIONS)
    done = time.perf_counter()
    return {"jax_s": compiled - began, "numpy_s": done - compiled, "numpy_over_jax": (done - compiled) / (compiled - began)}


def numpy_algorithm_1(
    m: Float[np.ndarray, "samples joints"], basis: Float[np.ndarray, "joints joints"], sparsity: int, iterations: int
) -> Float[np.ndarray, "joints joints"]:
    """Algorithm 1 in numpy at its quickest: partial sorting, and BLAS for all products."""
    for _ in range(iterations):
        e = m @ basis.T
        smallest = np.argpartition(np.abs(e), e.shape[1] - sparsity, axis=1)[:, : e.shape[1] - sparsity]
        np.put_along_axis(e, smallest, 0, 1)
        u, _, vt = np.linalg.svd(m.T @ e)
        basis = (u @ vt).T
    return basis


def cold_decode(motion: Motion, runs: int = 5) -> dict[str, float]:
    """Seconds of `jaxmocap decode` in a new process against `import jax` in another, in turn; medians."""
    with tempfile.TemporaryDirectory() as folder:
        stream, out = Path(folder, "a.jmc"), Path(folder, "a.bvh")
        stream.write_bytes(LsdtClip(load_artifact("lsdt-clip"), target=Target("mean", 1.0)).encode(motion))
        commands = {
            "decode_s": [sys.executable, "-m", "jaxmocap", "decode", str(stream), "-o", str(out)],
            "import_jax_s": [sys.executable, "-c", "import jax"],
        }
        taken: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(runs + 1):
            for name, command in commands.items():
                began = time.perf_counter()
                subprocess.run(command, check=True, capture_output=True)
                taken[name].append(time.perf_counter() - began)
    medians = {name: float(np.median(times[1:])) for name, times in taken.items()}
    return {**medians, "ratio": medians["decode_s"] / medians["import_jax_s"]}
