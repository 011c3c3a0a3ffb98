"""Progress of a run on a terminal, in a pipe and in a notebook."""

import io
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.console import Console

import estune
from estune.core.gains import GAIN_UNITS
from estune.run import progress
from estune.run.journal import Journal
from estune.run.loop import Stopped, replay
from estune.trial import Outcome
from tests.support_runs import START, ArithmeticRig


class Unlucky(ArithmeticRig):
    """Rig that diverges in one trial and is interrupted before a later one."""

    def __init__(self, *, diverging, stop_before):
        super().__init__()
        self.diverging, self.stop_before = diverging, stop_before

    def run(self, request):
        if request.number == self.stop_before:
            raise KeyboardInterrupt
        record = super().run(request)
        return (
            replace(record, outcome=Outcome.DIVERGED)
            if request.number == self.diverging
            else record
        )


def test_plain_progress_is_a_heading_and_about_a_dozen_lines(capsys):
    for trials in (40, 200):
        estune.tune(ArithmeticRig(), trials=trials, tolerance=0.0, journal=False)
        lines = capsys.readouterr().err.splitlines()
        assert 8 <= len(lines) <= 20
        assert "Ctrl-C" in lines[0]
        assert lines[1].startswith("baseline")
        done, most = re.search(r"confirm +(\d+) of (\d+)", lines[-1]).groups()
        assert done == most


def test_progress_of_resumed_run_counts_earlier_trials(tmp_path):
    rig = Unlucky(diverging=5, stop_before=20)
    with pytest.raises(Stopped):
        estune.tune(rig, trials=40, folder=tmp_path, run="cut", watch=None)
    before = estune.load(tmp_path / "cut")
    updates = []

    def watch(update):
        updates.append(update)

    with Journal.open(tmp_path / "cut") as journal:
        counter = progress.ProgressCounter(replay(before.plan, before.rig, journal))
    assert "1 unsafe" in counter.status().summary
    assert counter.best == before.to_frame()["best_cost"].iloc[-1]
    assert counter.status().done == 20
    rig.stop_before = None
    estune.resume(tmp_path / "cut", rig, watch=watch)
    assert updates[0].entry.number == 20


class Cell:
    """Display of a notebook cell, with the interface of IPython."""

    def __init__(self):
        self.shown = []

    def display(self, content, **options):
        assert options == {"raw": True, "display_id": True}
        self.update(content, raw=True)
        return self

    def update(self, content, *, raw):
        assert raw
        self.shown.append(content)


def test_notebook_progress_updates_one_output_without_widgets(monkeypatch, capsys):
    cell = Cell()
    shell = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=object()))
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=cell.display))
    # The clock stands still, so that no second drawing becomes due.
    monkeypatch.setattr(progress.time, "monotonic", lambda: 0.0)
    estune.tune(ArithmeticRig(), trials=40, journal=False)
    assert [set(content) for content in cell.shown] == [{"text/plain"}] * 3
    assert re.search(r"confirm +(\d+) of \1\b", cell.shown[-1]["text/plain"])
    assert f"live  {START.text(GAIN_UNITS)}" in cell.shown[-1]["text/plain"]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("width", [80, 120])
def test_terminal_progress_shows_status_and_live_gains(tmp_path, width):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=width, legacy_windows=False)

    with pytest.raises(Stopped):
        estune.tune(Unlucky(diverging=9, stop_before=20), folder=tmp_path, run="cut", watch=None)
    result = estune.load(tmp_path / "cut")
    with Journal.open(tmp_path / "cut") as journal:
        tuning = replay(result.plan, result.rig, journal)
        counter = progress.ProgressCounter(tuning)
        with progress.show_live(counter.status, counter.heading(), console):
            pass
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", out.getvalue())
    assert str(tmp_path / "cut") in text.replace("\n", "")
    line = " ".join(text.split())
    plan = result.plan
    assert f"20 of at most {plan.max_trials} trials" in line
    assert "1 unsafe" in line
    assert f"start {result.start.cost:.3g}" in line
    assert "live P 0.5 N/N" in line
    assert "on arithmetic" in line


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "0:00"), (61.0, "1:01"), (3725.0, "1:02:05"), (float("nan"), "-")]
)
def test_duration_reads_as_a_clock(seconds, text):
    assert progress.duration(seconds) == text
