"""Trials of a model begin as those of the rig: friction is held from where the drum came."""

import copy
import tomllib

import numpy as np
import pytest

from estune.core.cost import default_cost
from estune.hardware.compensation.plan import CompensationTerms
from estune.hardware.config import config_from
from estune.trial import TrialRequest
from experiments.virtual_loop import virtual_rig
from plants.effects import CoulombFriction
from plants.emulator import RIG_FILE
from plants.improvement.experiment_runner import ExperimentRunner
from plants.improvement.tuning import approach_of
from plants.simulation.approach import Approach, ApproachedPlant
from plants.simulation.batch import batch_costs, simulate, simulate_drive
from plants.simulation.compensation import compensation_of
from plants.simulation.plant import drive_of
from tests.support_improve import GAINS, REEL

FRICTION_Nm = 0.03
STICKY = REEL + CoulombFriction(torque_Nm=FRICTION_Nm)


@pytest.fixture
def lab(tmp_path):
    """The emulated reel with friction, in virtual time."""
    tables = copy.deepcopy(tomllib.loads(RIG_FILE.read_text()))
    effect = {"name": "coulomb_friction", "torque_Nm": FRICTION_Nm}
    tables["driver"]["settings"]["effects"] = [effect]
    with virtual_rig(config_from(tables, str(RIG_FILE))) as rig:
        yield ExperimentRunner(rig, rig.describe(), tmp_path, "now", lambda _: None)


def test_cost_of_a_rig_with_friction_is_predicted_from_how_its_trials_begin(lab):
    about, cost = lab.about, default_cost(lab.about.settling_time_s)
    trials = lab.trials("step", about.gains, 4)[1:]
    measured = lab.costs(trials, cost).mean()
    approach = approach_of(STICKY, trials, about)
    assert approach.from_N == about.step.step_N  # from above, as a trial leaves it

    def predicted(plant):
        return batch_costs(plant, [about.gains.as_tuple()] * 8, about.step, cost, seed=0).mean()

    assert predicted(ApproachedPlant(STICKY, approach)) == pytest.approx(measured, rel=0.02)
    assert predicted(STICKY) < 0.95 * measured  # settled, with no friction held


def test_trials_of_a_simulated_rig_begin_at_rest():
    rig = STICKY.rig(seed=1)
    about = rig.describe()
    trials = [rig.run(TrialRequest("step", n, about.gains, about.step)) for n in range(3)]
    assert approach_of(STICKY, trials, about) == Approach()


@pytest.mark.parametrize("from_N", [10.0, -10.0])
def test_drum_holds_the_friction_of_the_side_from_which_it_came(from_N):
    trial = simulate(ApproachedPlant(STICKY, Approach(from_N, 0.5)), GAINS)
    settled = simulate(REEL, GAINS)
    before = REEL.profile.step_index(REEL.sampling_Hz) - 1
    held_Nm = (trial.effort_N - settled.effort_N)[before] * REEL.drum_radius_m
    assert held_Nm == pytest.approx(-np.sign(from_N) * FRICTION_Nm, rel=0.1)
    np.testing.assert_array_equal(trial.setpoint_N, settled.setpoint_N)


def test_approach_leaves_a_plant_without_friction_as_it_is():
    plain, other = (
        simulate(REEL, GAINS),
        simulate(ApproachedPlant(REEL, Approach(10.0, 2.0)), GAINS),
    )
    np.testing.assert_allclose(other.tension_N, plain.tension_N, atol=1e-3)


@pytest.mark.parametrize("from_N", [10.0, -10.0])
def test_friction_that_is_fed_forward_begins_with_the_direction_of_the_way(from_N):
    size = {"coulomb_Nm": FRICTION_Nm, "static_Nm": FRICTION_Nm, "stribeck_rad_s": 1.0}
    friction = {**size, "tension_per_rad_N": 190.0, "fraction": 1.0}
    beside = compensation_of({"friction": friction}, STICKY.scale, STICKY.controller)
    drive = drive_of(STICKY.profile, STICKY.sampling_Hz)._replace(compensation=beside)
    plant = ApproachedPlant(STICKY, Approach(from_N, 0.5))
    trial = simulate_drive(plant, GAINS, drive, None, 1e3)
    fed_Nm = CompensationTerms(*trial.terms.T).friction_N * REEL.drum_radius_m
    assert trial.terms.shape[0] == trial.tension_N.size
    assert fed_Nm[0] == pytest.approx(-np.sign(from_N) * FRICTION_Nm)
