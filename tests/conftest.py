"""Fixtures of many files: a browser, commands run in a test's process, a run on disk."""

import signal
from pathlib import Path

import pytest

import estune
from estune.cli import run
from tests.support_runs import ArithmeticRig


@pytest.fixture(scope="module")
def chromium():
    """A browser for the pages of a file."""
    from tests.support_browser import browser  # noqa: PLC0415  slow to import

    with browser() as made:
        yield made


@pytest.fixture
def interpreted(monkeypatch):
    """Trials run in CasADi's virtual machine: a few take less time than to compile the plant."""
    from plants.simulation.trial_loop import CasadiLoop, loop_functions  # noqa: PLC0415  slow

    monkeypatch.setattr(
        "plants.models.plant_model.trial_loop",
        lambda structure: CasadiLoop(loop_functions(structure.equations())),
    )


@pytest.fixture
def undrawn(monkeypatch):
    """Figures of pages are empty: to draw one takes 0.3 s."""
    monkeypatch.setattr("estune.support.page_image.to_svg", lambda _figure: "<svg></svg>")


@pytest.fixture
def here(monkeypatch, capsys):
    """Runs a command in this process, and gives what it printed."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def succeed(*arguments):
        assert run(list(map(str, arguments))) == 0
        return capsys.readouterr().out

    return succeed


@pytest.fixture
def arithmetic_run(tmp_path):
    estune.tune(ArithmeticRig(), trials=1, repeats=1, folder=tmp_path, run="one", watch=None)
    return tmp_path / "one"


@pytest.fixture
def refused(monkeypatch, capsys):
    """Runs a command that is to be refused, and gives its exit code and its one line."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.syspath_prepend(Path(__file__).parents[1])

    def refuse(*arguments):
        code = run(list(map(str, arguments)))
        said = capsys.readouterr()
        assert said.err.count("\n") == 1, said.err
        assert said.err.startswith("estune: ")
        return code, said.err

    return refuse
