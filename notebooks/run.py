"""Run notebooks again and save them: `python notebooks/run.py`, or `python notebooks/run.py 01 07` for some of them.

What is saved is what a reader sees who does not run it: no progress bars, no widgets without a kernel behind them (their
stills stay), pictures in 256 colours.
"""

import base64
import io
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parent
WIDGET = "application/vnd.jupyter.widget-view+json"


def run_notebook(path):
    """Run a notebook in an empty folder, and save it with what its cells show."""
    notebook = nbformat.read(path, 4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": folder}}).execute()
    tidy(notebook)
    nbformat.write(notebook, path)


def tidy(notebook):
    """What cells show, as a reader sees it who does not run them."""
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [shrink(output) for output in join_streams(cell.outputs)]
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }


def join_streams(outputs):
    """Lines that a cell printed one after the other as one output, without progress bars."""
    joined = []
    for output in outputs:
        if joined and output.get("name") and joined[-1].get("name") == output.name:
            joined[-1].text += output.text
        else:
            joined.append(output)
    for output in joined:
        if output.output_type == "stream":  # a bar is written over until nothing of it is left
            output.text = "\n".join(line.rpartition("\r")[2] for line in output.text.split("\n"))
    return [output for output in joined if output.output_type != "stream" or output.text.strip()]


def shrink(output):
    """Without its widget, and its picture in few colours if that is smaller."""
    data = output.get("data", {})
    data.pop(WIDGET, None)
    if "image/png" in data and "text/html" not in data:
        png, few = base64.b64decode(data["image/png"]), io.BytesIO()
        Image.open(io.BytesIO(png)).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(few, "PNG", optimize=True)
        data["image/png"] = base64.b64encode(min(png, few.getvalue(), key=len)).decode()
    return output


if __name__ == "__main__":
    for notebook in sorted(FOLDER.glob("*.ipynb")):
        if not sys.argv[1:] or notebook.name[:2] in sys.argv[1:]:
            print(notebook.name, flush=True)
            run_notebook(notebook)
