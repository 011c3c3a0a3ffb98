"""Warm starts from a rig's own linear model."""

import re
from dataclasses import replace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput, UnsafeStart
from estune.interop import linear_model, margins
from estune.run.planning import make_plan
from estune.run.start import KnownStart
from experiments.loop_claims import true_sensitivity
from tests.support_lanes import first_by_day
from tests.support_runs import description, start_for

s = control.tf("s")


@pytest.mark.parametrize(
    ("system", "dead_time_s"),
    [
        (50.0**2 / (s**2 + 2 * 0.1 * 50.0 * s + 50.0**2), 0.002),
        (2.0 / (0.3 * s + 1), 0.05),
        pytest.param(
            1.0 / ((s + 1) * (0.2 * s + 1) * (0.04 * s + 1)), 0.0, marks=pytest.mark.slow
        ),
        pytest.param((1 - 0.1 * s) / ((s + 1) * (0.5 * s + 1)), 0.3, marks=pytest.mark.slow),
        (1.0 / (s * (s + 1.0)), 0.0),
    ],
    ids=["reel", "first order with dead time", "three lags", "non-minimum phase", "integrator"],
)
def test_warm_start_keeps_the_limit_of_sensitivity(system, dead_time_s):
    rig = plants.linear_plant(system, dead_time_s).rig().describe()
    loop = margins(rig.linear_model, start_for("model", rig).gains, rig.controller)
    # |1 + L| >= 1/1.6 everywhere means margins of at least 2.67 and 36 degrees.
    assert loop.stable
    assert loop.gain_margin > 2.6
    assert loop.phase_margin_deg > 36.0


@pytest.mark.parametrize("system", [5.0 / ((s + 1.0) * (s**2 - s + 5.0)), -1.0 / (s + 1.0)])
def test_warm_start_refuses_a_model_that_the_rigs_gains_do_not_hold(system):
    rig = replace(description(), linear_model=linear_model(system))
    with pytest.raises(UnsafeStart, match="give the initial gains"):
        start_for("model", rig)


def test_warm_start_of_rig_without_model_names_a_remedy():
    with pytest.raises(
        InvalidInput, match=r"arithmetic gives no linear model.*give the initial gains"
    ):
        make_plan(replace(description(), linear_model=None), "run", **choices(start="model"))


@pytest.mark.parametrize("length_m", first_by_day(0.5, 1.4))
def test_warm_start_is_safe_and_closer_to_the_optimum(length_m):
    reel = plants.reference_reel(cable_length_m=length_m)
    warm = estune.tune(reel, start="model", trials=1, journal=False, watch=None)
    cold = estune.tune(reel, trials=1, journal=False, watch=None)
    assert warm.unsafe == 0
    assert np.mean(warm.session.baseline) < 0.6 * np.mean(cold.session.baseline)
    response = plants.simulate(reel, warm.start_gains).tension_N
    assert response.max() < 15.0 + 10.0 * 1.051  # limits of overshoot, and of sensitivity:
    assert true_sensitivity(reel, warm.start_gains) < 1.61


def choices(**given):
    names = ("start", "bounds", "step", "cost")
    return {"tuner": "model_based", **dict.fromkeys(names), **given}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder of tuned runs at three lengths."""
    folder = tmp_path_factory.mktemp("runs")
    for length_m in (0.5, 0.9, 1.4):
        tuned(length_m, folder=folder, run=f"at-{length_m:g}".replace(".", "-"))
    return folder


def tuned(length_m, *, seed=0, **how):
    reel = plants.reference_reel(cable_length_m=length_m)
    return estune.tune(reel.rig(seed=seed), tuner="model_based", watch=None, **how)


@pytest.mark.slow
def test_law_of_earlier_runs_starts_a_new_reel_at_its_optimum(runs):
    result = tuned(1.1, seed=5, start=estune.start_from(f"law:{runs}"), journal=False)
    best = tuned(1.1, seed=6, journal=False)
    assert np.mean(result.session.baseline) < 1.05 * best.fun
    assert result.nit <= 6
    assert "law of 3 tunings from 0.5 to 1.4 m" in " ".join(result.remarks())


def test_law_leaves_out_runs_with_another_cost_than_the_latest(runs, tmp_path):
    for run in runs.iterdir():
        (tmp_path / run.name).symlink_to(run)
    tuned(0.7, folder=tmp_path, run="other", cost="itae", trials=3)
    known = start_for(f"law:{tmp_path}", plants.reference_reel(1.0).rig().describe())
    assert "the nearest length" in known.source  # the only run with that cost
    assert known.gains == estune.load(tmp_path / "other").gains


def test_law_refuses_lengths_beyond_its_own_and_takes_the_nearest_of_two(runs, tmp_path):
    with pytest.raises(InvalidInput, match=r"holds from 0.5 to 1.4 m"):
        start_for(f"law:{runs}", plants.reference_reel(cable_length_m=2.0).rig().describe())
    for name in ("at-0-5", "at-1-4"):
        (tmp_path / name).symlink_to(runs / name)
    known = start_for(
        f"law:{tmp_path}", plants.reference_reel(cable_length_m=1.2).rig().describe()
    )
    assert known.gains == estune.load(runs / "at-1-4").gains
    assert "nearest length" in known.source


@pytest.mark.slow
def test_sweep_starts_from_a_run_and_its_cells_give_a_law(runs, tmp_path):
    design = {
        "lengths_m": [0.5, 0.9, 1.4],
        "rigs": ["plants:reference_reel"],
        "tuners": ["model_based"],
        "start": f"run:{runs / 'at-0-9'}",
        "trials": 6,
    }
    result = estune.sweep(design, folder=tmp_path, jobs=1, watch=None)
    starts = {outcome.cell.start.gains for outcome in result.outcomes}
    assert {estune.load(runs / "at-0-9").gains} == starts
    known = start_for(f"law:{tmp_path}", plants.reference_reel(1.0).rig().describe())
    assert pytest.approx(result.law().band("I", 1.0).gain, rel=1e-5) == known.gains.I


class Untold:
    """A rig that gives no linear model of itself."""

    def __init__(self, rig):
        self.run, self.abort, self._rig = rig.run, rig.abort, rig

    def describe(self):
        return replace(self._rig.describe(), linear_model=None)


def test_start_is_refused_by_the_linear_model_and_without_one_by_the_first_record():
    reel = plants.reference_reel(cable_length_m=0.5)
    wild = KnownStart(Gains(1.7, 50.0, 0.01, 0.002), "somewhere")
    with pytest.raises(UnsafeStart, match=r"Ms of 9\.\d by the rig's linear model"):
        estune.tune(reel, start=wild, journal=False, watch=None)
    with pytest.raises(UnsafeStart, match=r"Ms of .* by the record of the first trial"):
        estune.tune(Untold(reel.rig()), start=wild, journal=False, watch=None, eta_max=9.0)


def test_gains_that_start_at_zero_are_named_with_the_options_that_tune_them():
    start = Gains(0.5, 10.0, 0.0, 0.0)
    result = tuned(0.8, start=start, trials=1, journal=False)
    said = " ".join(result.remarks())
    assert "D and setpoint_filter_s start at zero and were not tuned" in said
    options = dict(re.findall(r"--start (\w+)=(\S+?)\.?(?:\s|$)", said))
    whole = replace(start, **{name: float(value) for name, value in options.items()})
    assert "not tuned" not in " ".join(tuned(0.8, start=whole, trials=1, journal=False).remarks())
