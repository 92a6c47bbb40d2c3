"""Every notebook runs from top to bottom in a real kernel, with the CMU clips and without, and is committed as it ran."""

import os
import warnings
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
PICTURES = {"01_quickstart": 6, "02_recurring_patterns": 6, "03_learned_transform": 7, "04_live": 6}

pytestmark = [
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no {FOLDER}: notebooks are only in the checkout"),
    pytest.mark.parametrize("name", PICTURES),
]


def pictures(notebook: nbformat.NotebookNode) -> int:
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    assert not [o.evalue for o in outputs if o.output_type == "error"]
    return sum("image/png" in o.get("data", {}) for o in outputs)


def run(name: str, data: Path) -> nbformat.NotebookNode:
    """The notebook, executed in its own folder by a kernel that looks for motions in `data`."""
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    client = NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(FOLDER)}})
    with warnings.catch_warnings():
        # Sockets and event loops are the client's; what the notebook warns of is in the kernel, beyond this filter.
        warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"(zmq|tornado|jupyter_client|nbclient)\b")
        client.execute(env={**os.environ, "JAXMOCAP_DATA": str(data), "PYTHONWARNINGS": "default"})
    return notebook


def test_the_committed_notebook_has_its_pictures(name):
    file = FOLDER / f"{name}.ipynb"
    notebook = nbformat.read(file, as_version=4)
    nbformat.validate(notebook)
    assert pictures(notebook) == PICTURES[name]
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
    assert file.stat().st_size < 900_000


def test_it_runs_without_data(name, tmp_path):
    assert pictures(run(name, tmp_path)) == PICTURES[name]


def test_it_runs_on_cmu_clips(name, data_dir):
    assert pictures(run(name, data_dir.resolve())) == PICTURES[name]
