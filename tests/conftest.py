"""Shared fixtures: where the real motion data is, and JAX in its strict mode."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real motion: JAXMOCAP_DATA, or ../shared/data beside the checkout."""
    folder = Path(os.environ.get("JAXMOCAP_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
    if not (folder / "cmu_bvh").is_dir():
        pytest.skip(f"no motion data at {folder}; set JAXMOCAP_DATA to its folder")
    return folder
