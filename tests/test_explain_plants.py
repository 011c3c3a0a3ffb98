"""A plant that is no reel, given as a system of python-control: told in its own units."""

import math
import re

import control
import numpy as np
import pytest

import plants
from experiments.sticking_actuators import draw
from plants.diagnosis.interval import Interval
from plants.diagnosis.report.plant_units import in_own_units
from plants.effects import CoulombFriction
from plants.effects.plant_scale import written_unit
from tests.support_measurements import open_loop

MASS_kg, DAMPING_Ns_m, STIFFNESS_N_m = 2.0, 10.0, 5e4
"""Of a stage that moves by a millimetre: its numbers are far from a reel's."""
BELIEVED = control.tf([1.0], [1.1 * MASS_kg, 1.3 * DAMPING_Ns_m, 0.9 * STIFFNESS_N_m])
RATE_Hz, SUBSTEPS, NOISE_m = 750.0, 20, 8e-6
FRICTION_N, HUM_m = 5.0, 1e-4


def moved(force_N, friction_N, stiffness_N_m=STIFFNESS_N_m):
    """Displacement of the stage, m, by semi-implicit steps; friction is a proximal step."""
    h = 1.0 / (RATE_Hz * SUBSTEPS)
    x = v = 0.0
    out = np.empty(force_N.size)
    for n, force in enumerate(force_N.tolist()):
        out[n] = x
        for _ in range(SUBSTEPS):
            v += h * (force - DAMPING_Ns_m * v - stiffness_N_m * x) / MASS_kg
            v = math.copysign(max(abs(v) - h * friction_N / MASS_kg, 0.0), v)
            x += h * v
    return out


def forces(rng):
    """Two seconds of noise of 1 to 150 Hz four times, the second as the first, then a sweep, N."""
    t = np.arange(round(2.0 * RATE_Hz)) / RATE_Hz
    lines = np.arange(1.0, 150.0, 0.5)
    for size in (50.0, 50.0, 50.0, 20.0):
        wave = np.cos(2.0 * np.pi * np.outer(lines, t) + rng.uniform(0.0, 6.28, (lines.size, 1)))
        yield size * wave.sum(axis=0) / wave.sum(axis=0).std()
    yield 40.0 * np.sin(2.0 * np.pi * (20.0 + 10.0 * t) * t)


def records(friction_N=0.0, hum_m=0.0, step_m=0.0, stiffness_N_m=STIFFNESS_N_m):
    """Records of the stage; readings in steps have no other noise."""
    rng = np.random.default_rng(3)
    for n, force in enumerate(forces(rng)):
        t = np.arange(force.size) / RATE_Hz
        x = moved(force, friction_N, stiffness_N_m)
        hum = hum_m * np.sin(2.0 * np.pi * 50.2 * t + n)
        if step_m:
            read = step_m * np.rint(x / step_m)
        else:
            read = x + hum + NOISE_m * rng.standard_normal(t.size)
        yield open_loop(n, RATE_Hz, force, tension_N=read)


@pytest.mark.parametrize(
    ("hidden", "name", "truth"),
    [
        pytest.param(
            *({"friction_N": FRICTION_N}, "coulomb_friction", FRICTION_N), marks=pytest.mark.slow
        ),
        ({"hum_m": HUM_m}, "mains_interference", HUM_m),
        pytest.param({}, None, None, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_effect_of_a_control_system_is_reported_in_its_units(hidden, name, truth):
    found = plants.explain(BELIEVED, list(records(**hidden)))
    if name is None:
        assert found.verdict == "none"
        return
    assert (found.verdict, [effect.name for effect in found.effects]) == ("named", [name])
    said = re.search(r"([\d.e-]+) in the (?:input|output)'s unit", found.sentence)
    assert float(said[1]) == pytest.approx(truth, rel=0.05)
    assert found.after.ratio < 1.2
    parameter = next(iter(found.effects[0].parameters.values()))
    assert parameter.value == pytest.approx(truth, rel=0.05)
    assert parameter.unit == ("input" if name == "coulomb_friction" else "output")


def test_plant_that_states_its_units_is_told_of_in_them():
    plant = plants.linear_plant(BELIEVED, measurement="position, m", command="force, N")
    friction = CoulombFriction(2.0)
    said = friction.sentence(vars(friction), plant)
    assert said.startswith("Your plant has dry friction: 2 N against the motion")
    for name, unit in {"torque_Nm": "N", "creep_rad_s": "m/s"}.items():
        declared = CoulombFriction.parameters()[name].unit
        own = in_own_units(CoulombFriction, name, Interval(2.0, 1.0, 3.0, declared), plant)
        assert own == Interval(2.0, 1.0, 3.0, unit)
    assert written_unit("N", plant) == "m"


@pytest.mark.parametrize(
    ("friction_N", "verdict"),
    [pytest.param(0.0, "none", marks=pytest.mark.slow), (FRICTION_N, "named")],
)
def test_horizon_of_a_free_stage_exceeds_its_noise(friction_N, verdict):
    believed = control.tf([1.0], [1.1 * MASS_kg, 1.3 * DAMPING_Ns_m, 0.0])
    found = plants.explain(believed, list(records(friction_N, step_m=1e-6, stiffness_N_m=0.0)))
    assert found.verdict == verdict
    assert found.floor < 5e-6
    assert found.after.ratio < 1.2
    assert [effect.name for effect in found.effects] == ["coulomb_friction"] * bool(friction_N)
    for effect in found.effects:
        assert effect.parameters["torque_Nm"].value == pytest.approx(friction_N, rel=0.01)


@pytest.mark.parametrize("sticks", [True, False])
def test_sticking_actuator_of_a_linear_plant_is_named_with_its_band(sticks):
    believed, logs, loop = draw(6, sticks=sticks)
    found = plants.explain(believed, logs)
    if not sticks:
        assert found.verdict == "none"
        return
    (effect,) = found.effects
    assert (found.verdict, effect.name) == ("named", "sticking_actuator")
    band = effect.parameters["band_A"]
    assert band.low <= loop.band <= band.high
    assert band.value == pytest.approx(loop.band, rel=0.1)
