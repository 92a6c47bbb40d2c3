"""The quickstart runs from top to bottom in a real kernel, with the CMU clips and without, and is committed as it ran."""

import os
import warnings
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).resolve().parents[1] / "notebooks" / "01_quickstart.ipynb"
PICTURES = 6

pytestmark = pytest.mark.skipif(not NOTEBOOK.is_file(), reason=f"no {NOTEBOOK}: notebooks are only in the checkout")


def pictures(notebook: nbformat.NotebookNode) -> int:
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    assert not [o.evalue for o in outputs if o.output_type == "error"]
    return sum("image/png" in o.get("data", {}) for o in outputs)


def run(data: Path) -> nbformat.NotebookNode:
    """The notebook, executed in its own folder by a kernel that looks for motions in `data`."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    client = NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(NOTEBOOK.parent)}})
    with warnings.catch_warnings():
        # Sockets and event loops are the client's; what the notebook warns of is in the kernel, beyond this filter.
        warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"(zmq|tornado|jupyter_client|nbclient)\b")
        client.execute(env={**os.environ, "JAXMOCAP_DATA": str(data), "PYTHONWARNINGS": "default"})
    return notebook


def test_the_committed_notebook_has_its_pictures():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert pictures(notebook) == PICTURES
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
    assert NOTEBOOK.stat().st_size < 900_000


def test_it_runs_without_data(tmp_path):
    assert pictures(run(tmp_path)) == PICTURES


def test_it_runs_on_cmu_clips(data_dir):
    assert pictures(run(data_dir.resolve())) == PICTURES
