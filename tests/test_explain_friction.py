"""Friction and lag as other people's simulators write them down."""

import math
from dataclasses import replace

import numpy as np
import pytest

import plants
from experiments.hidden_scores import DiagnosisTask, diagnose
from plants.models.unloaded_reel import UnloadedReel
from tests.support_hidden import skip_without_compiler
from tests.support_lanes import first_by_day
from tests.support_measurements import open_loop

RATE_Hz, SUBSTEPS, COUNTS = 500.0, 16, 8192
INERTIA_kg_m2, DAMPING_Nms, TORQUE_Nm_A, FRICTION_Nm = 2.1e-3, 0.0085, 0.5, 0.02
BELIEVED = UnloadedReel(sampling_Hz=RATE_Hz, dead_time_s=0.0, encoder_counts=COUNTS)
STEP_s = 1.0 / (RATE_Hz * SUBSTEPS)


def smoothed(velocity, z):
    """No step at zero: `F tanh(omega/omega_0)`, 1 mm/s at the rim."""
    return FRICTION_Nm * math.tanh(velocity / 0.04), z


def bristles_that_fade(velocity, z):
    """Canudas de Wit's bristles (1995) with the curve of Stribeck."""
    stiffness = FRICTION_Nm / 1e-4
    most = FRICTION_Nm * (1.0 + 0.6 * math.exp(-(velocity**2)))
    after = (z + STEP_s * velocity) / (1.0 + STEP_s * stiffness * abs(velocity) / most)
    settling = 3e-3 * math.exp(-((velocity / 0.05) ** 2)) * (after - z) / STEP_s
    return stiffness * after + settling, after


def bristles(velocity, z):
    """Dahl's bristles (1968), long ones."""
    after = (z + STEP_s * velocity) / (1.0 + STEP_s * abs(velocity) / 0.01)
    return FRICTION_Nm * after / 0.01, after


def turned(current_A, friction):
    """The drum's angle, rad, by semi-implicit steps."""
    angle = velocity = z = 0.0
    out = np.empty(current_A.size)
    for n, torque in enumerate((TORQUE_Nm_A * current_A).tolist()):
        out[n] = angle
        for _ in range(SUBSTEPS):
            held, z = friction(velocity, z)
            velocity += STEP_s * (torque - DAMPING_Nms * velocity - held) / INERTIA_kg_m2
            angle += STEP_s * velocity
    return out


def currents(rng):
    """Noise of 1 to 40 Hz, steps, a slow triangle, a sweep, and some of it once more, A."""

    def noise(size, seconds):
        t, lines = np.arange(round(seconds * RATE_Hz)) / RATE_Hz, np.arange(1.0, 40.0)
        phase = rng.uniform(0.0, 6.28, (lines.size, 1))
        waves = np.cos(2.0 * np.pi * np.outer(lines, t) + phase)
        wave = waves.T @ (1.0 / np.hypot(1.0, lines / 6.0))
        return size * wave / wave.std()

    t = np.arange(round(4.0 * RATE_Hz)) / RATE_Hz
    yield noise(0.12, 3.0)
    yield np.repeat([0.0, 0.12, -0.12, 0.08, 0.0], 300)
    yield 0.15 * 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * 0.6 * t))
    yield 0.12 * np.sin(2.0 * np.pi * (0.5 + 2.0 * t) * t)
    yield noise(0.08, 2.0)
    yield np.repeat([0.0, 0.1, -0.1, 0.06, 0.0], 300)


def records(friction):
    """Open-loop records; each counts from where the drum stood when it was switched on."""
    rng, count = np.random.default_rng(3), 2.0 * np.pi / COUNTS
    for n, current in enumerate(currents(rng)):
        angle = np.floor(turned(current, friction) / count + rng.random()) * count
        yield open_loop(n, RATE_Hz, current, angle_rad=angle)


@pytest.mark.parametrize(
    ("friction", "name", "size"),
    [
        pytest.param(smoothed, "coulomb_friction", "torque_Nm", marks=pytest.mark.slow),
        pytest.param(
            *(bristles_that_fade, "stribeck_friction", "coulomb_Nm"), marks=pytest.mark.slow
        ),
        (bristles, "dahl_hysteresis", "torque_Nm"),
    ],
)
def test_friction_is_identified_in_the_notation_of_other_simulators(friction, name, size):
    found = plants.explain(BELIEVED, list(records(friction)))
    assert (found.verdict, [effect.name for effect in found.effects]) == ("named", [name])
    assert found.effects[0].parameters[size].value == pytest.approx(FRICTION_Nm, rel=0.05)


@pytest.mark.parametrize("guess", [1.2, 10.0])
def test_friction_is_all_that_is_missing_where_a_noisy_speed_was_integrated(guess):
    rng, size = np.random.default_rng(5), 0.005  # 8 % of the usual torque

    def dry(velocity, z):
        return size * math.tanh(velocity / 0.01), z

    def measured(n, current):
        speed = np.gradient(turned(current, dry)) * RATE_Hz
        speed += 0.02 * speed.std() * rng.standard_normal(speed.size)
        angle = np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1])) / RATE_Hz)
        return replace(open_loop(n, RATE_Hz, current, angle_rad=angle), speed_rad_s=speed)

    believed = replace(BELIEVED, drum_inertia_kg_m2=guess * INERTIA_kg_m2)
    found = plants.explain(believed, [measured(n, c) for n, c in enumerate(currents(rng))])
    assert [e.name for e in found.effects] == ["coulomb_friction"]
    assert found.verdict == "named"
    assert 0.7 < found.after.ratio < 1.3  # the floor is what the noise adds up to
    at = found.effects[0].parameters["torque_Nm"]
    assert at.low < size < at.high


def test_a_friction_that_falls_while_a_machine_runs_is_no_coulomb_friction():
    def warming(velocity, time_s):
        size = FRICTION_Nm * (0.3 + math.exp(-time_s / 0.8))
        return size * math.tanh(velocity / 0.04), time_s + STEP_s

    found = plants.explain(BELIEVED, list(records(warming)))
    assert (found.verdict, found.effects) == ("unknown", ())
    assert "a dry friction that changes with time" in found.sentence


def test_friction_of_a_gear_grows_with_its_torque():
    rng, count = np.random.default_rng(4), 2.0 * np.pi / COUNTS

    def geared(current_A):
        angle = velocity = 0.0
        for torque in (TORQUE_Nm_A * current_A).tolist():
            yield angle
            for _ in range(SUBSTEPS):
                held = 0.3 * abs(torque) * math.tanh(velocity / 0.04)
                velocity += STEP_s * (torque - DAMPING_Nms * velocity - held) / INERTIA_kg_m2
                angle += STEP_s * velocity

    found = plants.explain(
        BELIEVED,
        [
            open_loop(n, RATE_Hz, i, angle_rad=np.round(np.array(list(geared(i))) / count) * count)
            for n, i in enumerate(currents(rng))
        ],
    )
    assert [effect.name for effect in found.effects] == ["load_friction"]
    assert found.effects[0].parameters["load_share"].value == pytest.approx(0.3, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "variant", "effect", "size"),
    [
        (31001, "unloaded", "directional_friction", "difference_Nms"),
        (31004, "unloaded", "link_gravity", "torque_Nm"),
        pytest.param(31000, "plain", "load_friction", "load_share", marks=pytest.mark.nightly),
    ],
)
def test_effect_of_a_real_drive_is_identified_in_a_hidden_machine(seed, variant, effect, size):
    skip_without_compiler()
    row = diagnose(DiagnosisTask(seed, variant, effect))
    assert (row.verdict, row.found) == ("named", (effect,))
    (held,) = row.intervals
    assert held.name == f"{effect}.{size}"
    assert held.value == pytest.approx(held.true, rel=0.05)


@pytest.mark.slow
def test_lag_and_dead_time_of_a_drive_that_differ_by_less_than_the_noise_are_told_together():
    skip_without_compiler()
    row = diagnose(DiagnosisTask(31005, "unloaded", "dead_time"))
    assert (row.verdict, set(row.ambiguous)) == ("ambiguous", {"current_lag", "dead_time"})


@pytest.mark.parametrize("truth", first_by_day("current_lag", "dead_time"))
def test_lag_and_dead_time_of_a_drive_that_differ_by_half_the_noise_are_told_apart(truth):
    skip_without_compiler()
    row = diagnose(DiagnosisTask(31003, "unloaded", truth))
    assert (row.verdict, row.found) == ("named", (truth,))
    (held,) = row.intervals
    assert held.value == pytest.approx(held.true, rel=0.05)
