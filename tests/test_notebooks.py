"""Every notebook runs from top to bottom, at smoke size, without a warning or an error in its output.

A notebook keeps its sizes in one cell tagged `parameters`; what it says at smoke size is in that cell's metadata. All
else is run as it stands, assertions included.
"""

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def test_there_are_twelve_in_the_reader_s_order():
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{number:02d}" for number in range(1, 13)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_committed_notebook_is_light_and_was_run(path):
    assert path.stat().st_size < 2e6
    cells = [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert any("image/png" in output.get("data", {}) for cell in cells for output in cell.outputs)
    assert not complaints(cells)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    notebook = nbformat.read(path, 4)
    (sizes,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ()))
    sizes.source = sizes.metadata["smoke"]
    # the kernel is a process of its own, which starts without this one's switches
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(FOLDER.parent), os.environ.get("PYTHONPATH")])))
    monkeypatch.delenv("MPLBACKEND", raising=False)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert not complaints(cell for cell in notebook.cells if cell.cell_type == "code")


def complaints(cells):
    """What cells raised, and what they wrote to standard error, but for progress bars."""
    outputs = [output for cell in cells for output in cell.outputs]
    loud = [output for output in outputs if output.get("name") == "stderr" and "%|" not in output.text]
    return [output for output in outputs if output.output_type == "error"] + [o for o in loud if o.text.strip()]
