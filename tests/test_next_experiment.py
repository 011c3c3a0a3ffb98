"""Experiments of a diagnosis: within a rig's limits, and the one that would decide."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import plants
from estune.cli import run
from estune.errors import InvalidInput
from estune.run.trial_file import TrialFile, read_trial
from estune.trial import RigLimits
from estune.trial.profiles import StepProfile, TriangleProfile
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.data.records import read_measurements
from plants.diagnosis.experiments.designs import candidate_experiments, initial_experiments
from plants.diagnosis.experiments.next_experiment import Evidence, next_experiment, rig_of
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.localisation import ResidualLocation, localise
from plants.effects import CoulombFriction, EyeletFriction
from tests.serve_rig import hosted
from tests.support_improve import REEL, RIGS, about, records


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("make", [initial_experiments, candidate_experiments])
def test_experiments_and_predicted_tension_stay_within_limits(name, make):
    rig = about(name)
    experiments = make(rig)
    assert len({one.name for one in experiments}) == len(experiments) >= 5
    for one in experiments:
        rig.limits.check(one.profile)
        trial = plants.simulate(RIGS[name], rig.gains, one.profile)
        assert trial.diverged_at is None
        if rig.cable_length_m is not None:
            assert trial.tension_N.min() >= rig.limits.tension_min_N
            assert trial.tension_N.max() <= rig.limits.tension_max_N
    if make is initial_experiments:
        assert 25.0 < sum(one.profile.duration_s for one in experiments) < 31.0


@pytest.fixture(scope="module")
def plain():
    seen = records(REEL)
    return Evidence(seen, noise_floor(seen), ResidualLocation((), ""), 1.0)


def test_deciding_experiment_separates_refitted_models(plain):
    rivals = {"coulomb": REEL + CoulombFriction(), "eyelet": REEL + EyeletFriction()}
    found = next_experiment("ambiguous", REEL, rivals, plain, about("reel"))
    assert found.separation == max(found.tried.values())
    assert found.trial.name == max(found.tried, key=found.tried.get)

    def apart(profile):
        """Independently: the readings' difference less gain, offset, delay and inertia."""
        one, other = (plants.simulate(m, about("reel").gains, profile) for m in rivals.values())
        parts = []
        for channel, sigma in (("tension_N", 0.04), ("angle_rad", 2e-4)):
            y, d = getattr(one, channel), getattr(other, channel) - getattr(one, channel)
            slopes = [np.ones_like(y), y, np.gradient(y), np.gradient(np.gradient(y))]
            A = np.stack(slopes, axis=1)
            left = d - A @ np.linalg.lstsq(A, d, rcond=None)[0]
            parts.append(np.mean((left / np.hypot(sigma, 0.004 * y.std())) ** 2))
        return sum(parts)

    profiles = {one.name: one.profile for one in candidate_experiments(about("reel"))}
    worst = min(found.tried, key=found.tried.get)
    assert apart(found.trial.profile) > 5.0 * apart(profiles[worst])


@pytest.mark.slow
def test_no_experiment_for_indistinguishable_models(plain):
    same = {"one": REEL + CoulombFriction(), "other": REEL + CoulombFriction()}
    assert next_experiment("ambiguous", REEL, same, plain, about("reel")) is None
    assert next_experiment("named", REEL, same, plain, about("reel")) is None


@pytest.mark.slow
def test_unexplained_error_selects_the_experiment_that_excites_it():
    seen = records(REEL + CoulombFriction(torque_Nm=0.05))
    noise = noise_floor(seen)
    where = localise(seen, [BaseNumbers.of(REEL, m) for m in seen], noise)
    assert where.blocks[0].regime.name.startswith("velocity")
    found = next_experiment("unknown", REEL, {}, Evidence(seen, noise, where, 5.0))
    assert found.separation is None
    assert where.blocks[0].regime.name in found.sentence
    low, high = rig_of(REEL, seen).limits.tension_min_N, rig_of(REEL, seen).limits.tension_max_N
    assert low <= found.trial.profile.extremes[0] < found.trial.profile.extremes[1] <= high


@pytest.fixture
def trial(tmp_path):
    profile = TriangleProfile(15.0, 5.0, 1.0, 2.2, 0.2, loop="open")
    return TrialFile("slow", profile, why="because").write(tmp_path)


def test_trial_file_runs_on_a_rig_and_its_record_joins_the_data(trial, tmp_path, capsys):
    data = tmp_path / "data"
    with hosted("simulated") as endpoint:
        for _ in range(2):  # a trial id never runs twice, the same file may
            assert run(["run-experiment", str(trial), endpoint, "--data", str(data)]) == 0
    assert "the trial ran to its end" in capsys.readouterr().out
    read = read_measurements(data)
    assert len(read.measurements) == 2
    assert not read.findings
    first = read.measurements[0]
    asked = read_trial(trial).profile
    assert (first.loop, first.profile, first.preload_N) == ("open", "triangle", 15.0)
    np.testing.assert_array_equal(first.setpoint_N, asked.setpoint(632.0))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda values: values.pop("profile"), "profile: is missing"),
        (lambda values: values.update(colour="red"), "colour"),
        (lambda values: values["profile"].update(kind="square"), "profile: .*square"),
        (lambda values: values["profile"].update(period_s=-1.0), "period_s is -1.0"),
        (lambda values: values["profile"].update(amplitude_N=90.0), "outside the rig's range"),
        (lambda values: values.update(name="../x"), "may hold only letters"),
    ],
)
def test_unsuitable_trial_file_is_refused(trial, tmp_path, capsys, change, said):
    values = json.loads(trial.read_text())
    change(values)
    trial.write_text(json.dumps(values))
    wanted = ["run-experiment", str(trial), "plants:reference_reel", "--data", str(tmp_path / "d")]
    assert run(wanted) == InvalidInput.exit_code
    assert re.search(said, capsys.readouterr().err)
    assert not (tmp_path / "d").exists()


def test_experiments_of_a_slow_plant_are_longer():
    rig = replace(
        about("reel"),
        settling_time_s=5.0,
        linear_model=None,
        limits=RigLimits(0.0, 100.0, 300.0),
        step=StepProfile(20.0, 10.0, 1.0, 30.0),
    )
    durations = [one.profile.duration_s for one in initial_experiments(rig)]
    assert sum(durations) > 4.0 * sum(
        one.profile.duration_s for one in initial_experiments(about("reel"))
    )
