"""The notebooks of the documentation run as they stand, and are committed with their outputs."""

import nbformat
import pytest

from tests.support_notebooks import FOLDER, executed, kernel, outputs

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.fixture(scope="module")
def manager():
    with kernel() as started:
        yield started


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_without_a_complaint(path, tmp_path, manager):
    found = outputs(executed(path, tmp_path, manager))
    assert [o.text for o in found if o.get("name") == "stderr"] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_committed_notebook_is_small_and_was_executed_from_top_to_bottom(path):
    code = [c for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert path.stat().st_size < 100_000
