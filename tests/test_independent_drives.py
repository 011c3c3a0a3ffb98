"""Verdicts on drives whose simulator shares no code with the models."""

import math
from dataclasses import replace

import numpy as np
import pytest

import plants
from experiments.independent_drives.drives import draw
from experiments.independent_drives.logs import Logger
from plants.models.model_file import load_model
from tests.support_measurements import open_loop


@pytest.mark.slow
def test_current_limit_is_found_though_a_friction_made_up_for_it(tmp_path):
    """The base fit takes 700 times the viscous friction, with which the limit shows nothing."""
    drive = draw("servo", 6, 3002)
    rng = np.random.default_rng([3002, 6, 1, *b"servo"])
    logger = Logger.drawn("servo", rng)
    logger.write(drive, tmp_path, rng)
    d = plants.explain(
        load_model(tmp_path / "model.toml"),
        tmp_path / "logs",
        columns=logger.columns,
        effects=["current_saturation", "bent_viscous_friction"],
    )
    assert [effect.name for effect in d.effects] == ["current_saturation"]
    limit = d.effects[0].parameters["limit_A"]
    assert limit.value == pytest.approx(drive.numbers["limit"], rel=0.03)
    # Only one of the records reaches the limit: the other says nothing of it.
    assert limit.low < drive.numbers["limit"] < limit.high < 1.3 * limit.low


def test_gravity_of_a_link_points_where_the_encoder_says(tmp_path):
    """Records with zeros of their own shift the phase of a wave with them, which is no angle."""
    drive = draw("link", 1, 3002)
    rng = np.random.default_rng([3002, 1, 1, *b"link"])
    logger = Logger.drawn("link", rng)
    logger.write(drive, tmp_path, rng)
    d = plants.explain(
        load_model(tmp_path / "model.toml"),
        tmp_path / "logs",
        columns=logger.columns,
        effects=["link_gravity"],
    )
    phase = d.effects[0].parameters["phase_rad"]
    told = d.effects[0].effect.phase_rad
    assert told == phase.value
    error = math.remainder(drive.numbers["gravity_angle"] - phase.value, 2.0 * math.pi)
    assert phase.low < phase.value + error < phase.high < phase.low + 0.1


@pytest.mark.slow
def test_fuller_law_does_not_stand_for_a_simpler_one_and_another_effect(tmp_path):
    """Stribeck friction that fades over most speeds explains 0.996 of the two."""
    drive = draw("stage", 7, 3005)
    rng = np.random.default_rng([3005, 7, 1, *b"stage"])
    logger = Logger.drawn("stage", rng)
    logger.write(drive, tmp_path, rng)
    hidden = ["bent_viscous_friction", "coulomb_friction"]
    d = plants.explain(
        load_model(tmp_path / "model.toml"),
        tmp_path / "logs",
        columns=logger.columns,
        effects=[*hidden, "stribeck_friction"],
    )
    assert sorted(effect.name for effect in d.effects) == hidden
    found = {effect.name: effect.parameters for effect in d.effects}
    dry = found["coulomb_friction"]["torque_Nm"]
    assert dry.value == pytest.approx(drive.numbers["dry"], rel=0.01)


def resting(seed, rate_Hz=250.0, seconds=20.0):
    """A motor that sticks through slow ramps of its torque, and turns fast in between."""
    rng, substeps = np.random.default_rng(seed), 20
    t = np.arange(round(seconds * rate_Hz)) / rate_Hz
    ramp = 2.0 * np.abs(2.0 * ((0.1 * t + 0.1 * seed) % 1.0) - 1.0) - 1.0
    torque = 0.055 * ramp + np.where(t % 10.0 > 6.0, 0.12 * np.sin(2.6 * np.pi * t), 0.0)
    angle, q, w, dt = np.empty(t.size), 0.0, 0.0, 1.0 / rate_Hz / substeps
    for k, effort in enumerate(torque.tolist()):
        angle[k] = q
        for _ in range(substeps):
            dry = 0.035 + 0.0105 * math.exp(-((w / 0.4) ** 2))
            free = (3e-4 * w + dt * effort) / (3e-4 + dt * 2e-4)
            most = dt * dry / (3e-4 + dt * 2e-4)
            w = 0.0 if abs(free) <= most else free - math.copysign(most, free)
            q += dt * w
    read = np.round(angle * 8192 / (2.0 * math.pi)) * 2.0 * math.pi / 8192
    effort = torque + 2e-4 * rng.standard_normal(t.size)
    return replace(open_loop(seed, rate_Hz, effort, angle_rad=read), loop="closed")


def found_in(first):
    """The parameters of the friction that is found in two records."""
    d = plants.explain(
        plants.servo(2.8e-4, 2.5e-4, sampling_Hz=250.0),
        [resting(n) for n in (first, first + 1)],
        effects=["coulomb_friction", "dahl_hysteresis", "stribeck_friction"],
    )
    assert [effect.name for effect in d.effects] == ["stribeck_friction"]
    return d.effects[0].parameters


@pytest.mark.parametrize("pairs", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_friction_that_holds_a_drive_most_of_the_time_is_found_as_it_is(pairs):
    # Such records hardly tell excess from velocity. Of sixty intervals of twenty pairs 56 hold.
    velocities, inside = [], []
    truth = {"coulomb_Nm": 0.035, "excess_Nm": 0.0105, "stribeck_rad_s": 0.4}
    for first in range(0, 2 * pairs, 2):
        found = found_in(first)
        inside += [found[name].low < true < found[name].high for name, true in truth.items()]
        assert found["coulomb_Nm"].value == pytest.approx(0.035, rel=0.01)
        assert found["excess_Nm"].value == pytest.approx(0.0105, rel=0.1)
        velocities.append(found["stribeck_rad_s"].value)
    assert np.mean(inside) > 0.85
    if pairs > 1:  # one fit is off by up to 40 %
        assert np.median(velocities) == pytest.approx(0.4, rel=0.25)
    assert velocities == pytest.approx([0.4] * pairs, rel=0.5)
