"""Finished searches that go on with more trials."""

import pytest

import estune
from estune.cli import run
from estune.errors import InvalidInput
from estune.run.loop import Stopped
from tests.support_runs import ArithmeticRig


class Interrupted(ArithmeticRig):
    """Rig at which the user stops before a trial."""

    stop_before = None

    def run(self, request):
        if request.number == self.stop_before:
            raise KeyboardInterrupt
        return super().run(request)


def tuned(folder, trials):
    options = {"tuner": "otis", "tolerance": 0.0, "watch": None}
    return estune.tune(ArithmeticRig(), trials=trials, folder=folder, run="run", **options)


def searched(result):
    return [entry.gains for entry in result.entries if str(entry.phase.value) == "search"]


def test_extended_search_proposes_what_a_longer_one_would_have(tmp_path):
    short = tuned(tmp_path, 6)
    extended = estune.resume(short.folder, ArithmeticRig(), trials=10, watch=None)
    whole = tuned(tmp_path / "whole", 10)
    assert (short.nit, extended.nit) == (6, 10)
    assert searched(extended)[:6] == searched(short)
    # Noise depends on the number of a trial, which the first confirmation has moved on.
    assert pytest.approx(searched(whole)[6].P, rel=1e-9) == searched(extended)[6].P
    loaded = estune.load(short.folder)
    assert loaded.gains == extended.gains
    assert loaded.fun == extended.fun
    assert loaded.heading() == extended.heading()
    assert estune.resume(short.folder, ArithmeticRig(), watch=None).nfev == extended.nfev


def test_interrupted_extension_goes_on_as_if_undisturbed(tmp_path):
    first, second = tuned(tmp_path / "a", 6), tuned(tmp_path / "b", 6)
    whole = estune.resume(first.folder, ArithmeticRig(), trials=12, watch=None)
    rig = Interrupted()
    rig.stop_before = second.nfev + 3
    with pytest.raises(Stopped):
        estune.resume(second.folder, rig, trials=12, watch=None)
    resumed = estune.resume(second.folder, ArithmeticRig(), watch=None)
    assert searched(resumed) == searched(whole)
    assert resumed.gains == whole.gains


def test_extension_by_no_trials_is_refused_with_the_number_taken(tmp_path):
    short = tuned(tmp_path, 6)
    with pytest.raises(InvalidInput, match="trials is 6; the search of run run took 6: give more"):
        estune.resume(short.folder, ArithmeticRig(), trials=6, watch=None)
    assert estune.load(short.folder).gains == short.gains


def test_apply_takes_run_and_rig_in_either_order(tmp_path, capsys):
    endpoint, folder = "tcp/127.0.0.1:1", ["--folder", str(tmp_path)]
    assert run(["apply", "none", endpoint, *folder]) == run(["apply", endpoint, "none", *folder])
    said = capsys.readouterr().err.splitlines()
    assert said[0] == said[1]
    assert "none" in said[0]
