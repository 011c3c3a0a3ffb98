"""Notebooks of the documentation, executed; run as a module it renews their outputs.

`python -m tests.support_notebooks` writes small outputs into docs/notebooks: text, tables, and
figures of few colours; figures within the HTML of a result are left out.
"""

import base64
import io
import re
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image
from traitlets.config import Config

from tests.support_fmu import build

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
SVG = re.compile(r"<svg.*?</svg>", re.DOTALL)
WIDTH, COLOURS = 640, 48
"""Width and number of colours of its figures."""


def executed(path: Path, folder: Path) -> nbformat.NotebookNode:
    """The notebook with the outputs that it has in a folder with an FMU."""
    build(folder, start="0.0").rename(folder / "lag.fmu")
    notebook = nbformat.read(path, as_version=4)
    config = Config(KernelManager={"transport": "ipc", "ip": str(folder / "kernel")})
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, config=config, timeout=None, resources=resources).execute()
    return notebook


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]


def shrink(notebook: nbformat.NotebookNode) -> None:
    for cell in notebook.cells:
        cell.metadata = {}  # when it was executed
    for output in outputs(notebook):
        data = output.get("data", {})
        if "text/html" in data:
            data["text/html"] = SVG.sub("", data["text/html"])
        if "image/png" in data:
            image = Image.open(io.BytesIO(base64.b64decode(data["image/png"]))).convert("RGB")
            image.thumbnail((WIDTH, WIDTH))
            small = io.BytesIO()
            image.quantize(COLOURS).save(small, "png", optimize=True)
            data["image/png"] = base64.b64encode(small.getvalue()).decode()


def main() -> None:
    for path in sorted(FOLDER.glob("*.ipynb")):
        with tempfile.TemporaryDirectory() as folder:
            notebook = executed(path, Path(folder))
        shrink(notebook)
        nbformat.write(notebook, path)
        print(path.name, path.stat().st_size)


if __name__ == "__main__":
    main()
