"""A rig whose controller did not act as its record states is refused at the first such trial."""

from dataclasses import replace

import pytest

import estune
import plants
from estune.errors import RigError
from estune.trial import TrialRequest
from estune.trial.applied_gains import applied_fault


class Otherwise:
    """A rig that runs a changed request, and states the one asked for."""

    def __init__(self, **changed):
        self._rig, self._changed, self.trials = plants.reference_reel(0.8).rig(seed=3), changed, 0

    def __getattr__(self, name):
        return getattr(self._rig, name)

    def run(self, request):
        self.trials += 1
        there = self._rig.run(self._otherwise(request))
        setpoint = request.profile.setpoint(there.sampling_Hz)
        return replace(there, gains=request.gains, setpoint_N=setpoint[: there.time_s.size])

    def _otherwise(self, request):
        factors = dict(self._changed)
        profile = request.profile
        if share := factors.pop("step", None):
            profile = replace(profile, step_N=share * profile.step_N)
        values = {name: factor * getattr(request.gains, name) for name, factor in factors.items()}
        return replace(request, profile=profile, gains=replace(request.gains, **values))


def tune(rig):
    return estune.tune(rig, journal=False, watch=None, trials=2)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"P": 0.8}, r"that of 0\.8 times P as stated"),
        ({"P": 1.2, "I": 1.2, "D": 1.2}, r"that of 1\.2 times P, I and D as stated"),
        ({"setpoint_filter_s": 2.0}, r"that of 2 times the setpoint filter as stated"),
        ({"step": 0.8}, r"that of 0\.8 times the step as stated"),
    ],
    ids=["P", "all gains", "setpoint filter", "step"],
)
def test_trial_with_other_gains_or_another_step_than_stated_is_refused_with_the_factor(
    changed, said
):
    rig = Otherwise(**changed)
    with pytest.raises(RigError, match=said):
        tune(rig)
    assert rig.trials == 1


def test_gains_within_a_few_per_cent_are_those_stated():
    rig = Otherwise(P=0.97)
    about = rig.describe()
    record = rig.run(TrialRequest("run", 0, about.gains, about.step))
    assert applied_fault(record, about) == ""


def test_rig_that_keeps_its_own_gains_is_refused_at_the_first_others():
    class Deaf(Otherwise):
        def _otherwise(self, request):
            return replace(request, gains=self._rig.describe().gains)

    rig = Deaf()
    with pytest.raises(RigError, match=r"times .* as stated"):
        tune(rig)
    assert rig.trials <= 3


def test_rig_that_logs_no_effort_is_not_refused_for_it():
    rig = Otherwise()
    about = rig.describe()
    record = rig.run(TrialRequest("run", 0, about.gains, about.step))
    assert applied_fault(replace(record, current_A=0.0 * record.current_A), about) == ""
