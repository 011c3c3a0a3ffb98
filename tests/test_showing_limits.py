"""A run runs the trials that show its limits, where few do."""

import pytest

import estune
from estune.errors import InvalidInput
from estune.loop_model.excitation import UnknownLoop
from estune.loop_model.foretold import trials_to_show
from estune.loop_model.intervals import margins_by_records
from estune.run import excitation, showing_limits
from estune.run.ending import RunEnding
from estune.run.loop import Stopped
from estune.run.phase import Phase
from experiments.batch.__main__ import start_of
from experiments.batch.loop import ProcessLoop
from experiments.batch.processes import PROCESSES
from experiments.batch.rig import BatchRig
from tests.test_half_widths import GAINS, tried  # noqa: F401  a fixture
from tests.test_loop_model import trial_of


class LaggingRig(BatchRig):
    """An integrator with a lag, a dead time and noise of 1 % of the step.

    The confirmation does not show its limits.
    """

    def __init__(self):
        process = next(process for process in PROCESSES if process.name == "e^-0.05s/s(0.95s+1)")
        super().__init__(ProcessLoop(process, 0.01), start_of(process), seed=1004)

    def abort(self):
        return self.describe()


def tune(**settings):
    return estune.tune(LaggingRig(), **{"journal": False, "watch": None, **settings})


@pytest.fixture(scope="module")
def shown():
    return tune()


def test_limits_that_few_more_trials_show_are_shown_by_them(shown, monkeypatch):
    monkeypatch.setattr(showing_limits, "SHOWING_MAX", 0)
    left = tune()
    assert left.ending is RunEnding.LIMITS_NOT_SHOWN
    assert shown.ending is RunEnding.TUNED
    assert shown.gains == left.gains
    more = shown.entries[left.nfev :]
    assert 0 < len(more) <= 2
    assert {entry.phase for entry in more} <= {Phase.CONFIRM, Phase.EXCITE}


def test_run_cut_while_it_shows_its_limits_resumes_as_if_undisturbed(shown, tmp_path):
    last = shown.nfev

    def stop(progress):
        if progress.session.number == last - 1:
            raise KeyboardInterrupt

    with pytest.raises(Stopped):
        tune(journal=True, folder=tmp_path, run="cut", watch=stop)
    with pytest.raises(InvalidInput, match="confirming"):
        estune.resume(tmp_path / "cut", LaggingRig(), trials=50, watch=None)
    resumed = estune.resume(tmp_path / "cut", LaggingRig(), watch=None)
    phases = [[entry.phase for entry in run.entries] for run in (shown, resumed)]
    assert phases[0] == phases[1]
    assert resumed.gains == shown.gains
    assert estune.load(tmp_path / "cut").ending is RunEnding.TUNED


def test_foretold_trials_are_more_the_closer_the_limit_and_none_below_the_estimate(
    tried,  # noqa: F811
):
    plant, records, fit = tried
    trial = trial_of(plant)
    loop = UnknownLoop(fit, records, GAINS, GAINS, trial.controller)
    Ms = margins_by_records(fit, records, trial, GAINS).sensitivity

    def foretold(limit):
        return trials_to_show(loop, trial, limit, records[-1])

    close, far = (foretold(Ms.value + share * (Ms.high - Ms.value)) for share in (0.7, 0.9))
    assert 1 <= far < close
    assert foretold(0.99 * Ms.value) is None


def test_excitation_of_chosen_lines_leaves_less_unknown_than_one_of_all_lines(shown, monkeypatch):
    fit, signals = shown.identified.fit, shown.identified.signals
    loop = UnknownLoop(fit, signals, shown.gains, shown.gains, shown.rig.controller)
    best = excitation.best_excitation(loop, shown.plan, shown.rig)
    monkeypatch.setattr(excitation, "LINES_MIN", 200)
    all_lines = excitation.best_excitation(loop, shown.plan, shown.rig)
    assert best.trial.profile.last_line < all_lines.trial.profile.last_line
    assert best.margin.distance > all_lines.margin.distance
    for one in (best, all_lines):
        most = 0.5 * abs(shown.plan.step.step_N) * (1.0 + 1e-9)
        assert max(abs(one.answer.setpoint).max(), abs(one.answer.measurement).max()) <= most
