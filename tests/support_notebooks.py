"""Notebooks of the documentation, executed; run as a module it renews their outputs.

`python -m tests.support_notebooks` writes small outputs into docs/notebooks: text, tables, and
figures of few colours; figures within the HTML of a result are left out.
"""

import base64
import io
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import nbformat
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
SVG = re.compile(r"<svg.*?</svg>", re.DOTALL)
WIDTH, COLOURS = 640, 48
"""Width and number of colours of its figures."""


@contextmanager
def kernel() -> Iterator[KernelManager]:
    """A kernel that executes one notebook after another: it takes seconds to start."""
    with tempfile.TemporaryDirectory() as folder:
        manager = KernelManager(transport="ipc", ip=str(Path(folder) / "kernel"))
        manager.start_kernel()
        try:
            yield manager
        finally:
            manager.shutdown_kernel(now=True)


def executed(path: Path, folder: Path, manager: KernelManager) -> nbformat.NotebookNode:
    """The notebook with the outputs that it has in a folder, without earlier names."""
    notebook = nbformat.read(path, as_version=4)
    # First the folder: that of the notebook before is gone, and a reset asks where it is.
    first = nbformat.v4.new_code_cell(f"__import__('os').chdir({str(folder)!r})\n%reset -f")
    # Cell 1 of the notebook is to be numbered 1.
    first.source += "\nget_ipython().execution_count = 0"
    notebook.cells.insert(0, first)
    runner = NotebookClient(notebook, km=manager, timeout=None)
    try:
        runner.execute()
    finally:
        runner.kc.stop_channels()
    del notebook.cells[0]
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
        with tempfile.TemporaryDirectory() as folder, kernel() as manager:
            notebook = executed(path, Path(folder), manager)
        shrink(notebook)
        nbformat.write(notebook, path)
        print(path.name, path.stat().st_size)


if __name__ == "__main__":
    main()
