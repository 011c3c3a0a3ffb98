"""Units change nothing: the same trials, gains and claims of a plant in any of them."""

from dataclasses import replace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.cost import MOVE_WEIGHT
from estune.core.gains import Gains
from estune.run.loop import Stopped
from estune.trial.profiles import StepProfile

UNITS = {True: (50.0, 0.05), False: (0.02, 20.0)}
"""Scales of measurement and effort where the rig states its plant, and where it does not; neither
their ratio nor their product is one."""

START = Gains(0.5, 4.0, 0.005, 0.05)
LAG = control.tf([1.0], [0.02, 0.3, 1.0])
INTEGRATOR = control.tf([2.0], [0.05, 1.0, 0.0])


def scaled(transfer, measurement, effort):
    """A plant in units that are so many times as small."""
    gain = measurement / effort
    P, I, D, filter_s = START.as_tuple()
    return plants.linear_plant(
        gain * transfer,
        dead_time_s=0.01,
        sampling_Hz=200.0,
        gains=Gains(P / gain, I / gain, D / gain, filter_s),
        profile=StepProfile(0.0, measurement, 0.2, 2.2),
        settling_time_s=0.5,
        noise_rms_N=0.003 * measurement,
        output_min_N=-20.0 * effort,
        output_max_N=20.0 * effort,
    )


class WithoutModel:
    """A rig that says nothing of its plant."""

    def __init__(self, rig):
        self._rig = rig

    def __getattr__(self, name):
        return getattr(self._rig, name)

    def describe(self):
        return replace(self._rig.describe(), linear_model=None)


def tuned(transfer, measurement, effort, *, knows, **settings):
    """Gains of each trial in units of the first plant, and what the run ends with."""
    rig = scaled(transfer, measurement, effort).rig(seed=3)
    options = {"journal": False, "watch": None, **settings}
    result = estune.tune(rig if knows else WithoutModel(rig), **options)
    unit = measurement / effort
    gains = np.array([e.gain_values for e in result.entries]) * [unit, unit, unit, 1.0]
    margins = result.claim.margins
    said = np.array([*margins.sensitivity, *margins.phase_margin_deg]) if margins else np.zeros(6)
    costs = np.array([entry.cost for entry in result.entries])
    return gains, costs, said, result.ending


@pytest.mark.parametrize(
    ("tuner", "transfer", "knows"),
    [
        ("model_based", LAG, True),
        pytest.param("model_based", LAG, False, marks=pytest.mark.slow),
        pytest.param("safe_bayesian", LAG, False, marks=pytest.mark.slow),
        pytest.param("otis", LAG, True, marks=pytest.mark.slow),
        pytest.param("safe_bayesian", INTEGRATOR, True, marks=pytest.mark.slow),
        ("otis", INTEGRATOR, False),
    ],
)
def test_units_change_neither_trials_nor_gains_nor_claims(tuner, transfer, knows):
    search = {"tuner": tuner, "trials": 4}
    gains, costs, said, ending = tuned(transfer, 1.0, 1.0, knows=knows, **search)
    others = tuned(transfer, *UNITS[knows], knows=knows, **search)
    assert len(others[0]) == len(gains)
    assert others[0] == pytest.approx(gains, rel=1e-3)
    assert others[1] == pytest.approx(costs, rel=1e-3, nan_ok=True)  # of an excitation
    if transfer is LAG:  # how slow a pole at the origin is, rounding decides
        assert others[3] == ending
        assert others[2] == pytest.approx(said, rel=1e-2)


def test_effort_of_a_plant_without_rest_is_weighed_at_the_frequency_of_its_settling_time():
    integrator = plants.linear_plant(INTEGRATOR, settling_time_s=3.0).rig().describe()
    assert integrator.effort_scale == pytest.approx(abs(INTEGRATOR(2j * np.pi / 3.0)), rel=1e-6)


def test_measured_scale_is_that_of_the_model_and_is_kept_when_a_run_is_resumed_and_loaded(
    tmp_path,
):
    rig = scaled(LAG, 50.0, 1.0).rig(seed=3)
    known, weight = rig.describe().effort_scale, MOVE_WEIGHT
    options = {"folder": tmp_path, "run": "run", "trials": 2, "watch": None}

    def stop(progress):
        if progress.session.number == 2:
            raise KeyboardInterrupt

    with pytest.raises(Stopped):
        estune.tune(WithoutModel(rig), **options | {"watch": stop})
    result = estune.resume(tmp_path / "run", WithoutModel(rig), watch=None)
    assert result.plan.cost.move_weight == pytest.approx(weight * known**2, rel=0.02)
    assert estune.load(tmp_path / "run").plan.cost == result.plan.cost
