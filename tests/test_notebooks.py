"""Every notebook runs from top to bottom, at smoke size, without a warning or an error in its output.

A notebook keeps its sizes in one cell tagged `parameters`; what it says at smoke size is in that cell's metadata, and so
is what must hold after a cell, its `check`: a reader meets no assertion. All else is run as it stands.
"""

import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
WIDGET = "application/vnd.jupyter.widget-view+json"


def read_code(path):
    notebook = nbformat.read(path, 4)
    return notebook, [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_there_are_twelve_in_the_reader_s_order():
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{number:02d}" for number in range(1, 13)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_committed_notebook_is_light_and_was_run(path):
    assert path.stat().st_size < 1.2e6
    _, cells = read_code(path)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not complaints(cells)
    streams = [output for output in outputs if output.output_type == "stream"]
    assert not [output for output in streams if output.name == "stderr" or "%|" in output.text], "progress bars"
    assert not [output for output in outputs if WIDGET in output.get("data", {})], "a widget without a kernel"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_teaches(path):
    notebook, cells = read_code(path)
    live = [cell for cell in cells if cell.source.rpartition("\n\n\n")[2].startswith("explore(")]
    assert live
    assert all("image/png" in cell.outputs[-1].data for cell in live), "a still, for who does not run it"
    assert not [cell for cell in cells if re.search(r"^\s*assert|testing", cell.source, re.MULTILINE)]
    assert sum("check" in cell.metadata for cell in cells) >= 1
    assert re.findall(r"^from physjax import (.*)$", cells[0].source, re.MULTILINE)[0] != "("
    (exercises,) = [cell.source for cell in notebook.cells if cell.source.startswith("## Exercises")]
    assert len(re.findall(r"^\d\. ", exercises, re.MULTILINE)) == 3
    assert exercises.count("<details><summary>Answer</summary>") == exercises.count("</details>") == 3


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_figures_that_depend_on_a_machine_are_printed_by_cells(path):
    """Prose that says how fast something is has no results file behind it."""
    prose = "\n".join(cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "markdown")
    speed = r"\d[^.\n]*(million|billion|steps/s|times as fast|faster than|seconds on)"
    assert not re.search(speed, prose), re.search(speed, prose)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    notebook, cells = read_code(path)
    (sizes,) = (cell for cell in cells if "parameters" in cell.metadata.get("tags", ()))
    sizes.source = sizes.metadata["smoke"]
    for cell in cells:
        cell.source += "\n" + cell.metadata.get("check", "")
    # the kernel is a process of its own, which starts without this one's switches
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(FOLDER.parent), os.environ.get("PYTHONPATH")])))
    monkeypatch.delenv("MPLBACKEND", raising=False)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert not complaints(cells)


def complaints(cells):
    """What cells raised, and what they wrote to standard error, but for progress bars."""
    outputs = [output for cell in cells for output in cell.outputs]
    loud = [output for output in outputs if output.get("name") == "stderr" and "%|" not in output.text]
    return [output for output in outputs if output.output_type == "error"] + [o for o in loud if o.text.strip()]
