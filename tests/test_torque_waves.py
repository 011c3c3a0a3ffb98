"""Cogging in the current of a drive that turns at a steady speed."""

from dataclasses import replace

import numpy as np
import pytest

import plants
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.torque_waves import TorqueWaves, torque_waves
from tests.support_measurements import open_loop

RATE_Hz, TORQUE_Nm_A = 400.0, 0.05
WAVES = ((7.0, 6e-3, 0.4), (28.0, 2e-3, -1.0), (12.0, 1.5e-3, 2.0))
SERVO = plants.servo(2e-5, 1e-4, torque_constant_Nm_A=TORQUE_Nm_A, sampling_Hz=RATE_Hz)


def turning(seed, waves=WAVES, seconds=10.0):
    """Current and angle of a drive whose velocity loop gives a little to what it cannot follow."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_Hz)) / RATE_Hz
    pushed = np.cumsum(rng.normal(0.0, 1e-4, t.size))
    angle = rng.uniform(0.0, 6.0) + 0.7 * t + 0.02 * np.sin(5.0 * t) + pushed
    torque = 0.002 + sum(size * np.sin(order * angle + phi) for order, size, phi in waves)
    current = torque / TORQUE_Nm_A + rng.normal(0.0, 0.01, t.size)
    read = np.round(angle / 1e-3) * 1e-3
    return replace(open_loop(seed, RATE_Hz, current, angle_rad=read), loop="closed")


def found(records, held=()):
    return torque_waves(records, [BaseNumbers.of(SERVO, m) for m in records], 0.01, held)


@pytest.mark.parametrize("records", [1, 2, 3])
def test_orders_and_sizes_of_cogging_are_found_in_the_current(records):
    waves = found([turning(n) for n in range(records)], [turning(9)])
    assert waves.orders[:3] == (7.0, 28.0, 12.0)
    assert waves.share > 0.95
    assert waves.held_A[1] < 0.02
    for k, (_, size, phi) in enumerate(WAVES, 1):
        assert waves.parameters[f"amplitude_{k}_Nm"].value == pytest.approx(size, rel=0.05)
        assert waves.parameters[f"phase_{k}_rad"].value == pytest.approx(phi, abs=0.05)


def giving_way(w0_rad_s, inertia=3e-4, waves=((12.0, 6e-3, 1.0), (24.0, 3e-3, 2.0))):
    """A drive whose soft loop lets its speed swing with the cogging, by a third."""
    per_s = 4e3
    t = np.arange(round(20.0 * per_s)) / per_s
    angle, torque = np.empty(t.size), np.empty(t.size)
    x = v = total = 0.0
    for k in range(t.size):
        wanted = w0_rad_s if t[k] < 10.0 else -w0_rad_s
        total += 0.4 * (wanted - v) / per_s
        torque[k] = 0.02 * (wanted - v) + total
        pulled = sum(size * np.sin(order * x + phi) for order, size, phi in waves)
        v += (torque[k] - 1e-4 * v - pulled) / inertia / per_s
        x += v / per_s
        angle[k] = x
    every = round(per_s / RATE_Hz)
    read = np.round(angle[::every] / 8e-4) * 8e-4
    current = torque[::every] / TORQUE_Nm_A
    return replace(open_loop(1, RATE_Hz, current, angle_rad=read), loop="closed")


def test_inertia_of_a_drive_whose_speed_swings_is_not_taken_for_cogging():
    model = replace(SERVO, drum_inertia_kg_m2=3e-4)
    records = [giving_way(0.8), giving_way(0.6)]
    waves = torque_waves(records, [BaseNumbers.of(model, m) for m in records], 1e-3)
    assert waves.orders[:2] == (12.0, 24.0)
    for k, true in ((1, 6e-3), (2, 3e-3)):
        amplitude = waves.parameters[f"amplitude_{k}_Nm"]
        assert amplitude.value == pytest.approx(true, rel=0.05)
        assert amplitude.low < true < amplitude.high


def test_drive_that_does_not_cog_has_no_waves():
    waves = found([turning(n, waves=()) for n in range(2)])
    assert waves is None or waves.share < 0.3


@pytest.mark.slow
def test_diagnosis_names_the_cogging_of_a_drive_that_turns_one_way():
    d = plants.explain(SERVO, [turning(n) for n in range(2)], hold_out=[turning(5)])
    assert (d.verdict, [e.name for e in d.effects]) == ("named", ["cogging"])
    assert "one_direction" in [one.kind for one in d.limitations]
    assert "7 times a turn" in d.sentence
    (cogging,) = d.augmented.effects[:1]
    assert cogging.per_turn_1 == 7.0


def test_what_waves_leave_is_told_in_the_unit_of_the_command():
    waves = TorqueWaves({}, 0.0, 2.75, 0.17, 0.01, (7.0,), held_A=(2.5, 0.2))
    said = waves.sentence(plants.stage(mass_kg=6.0, viscous_friction_Ns_m=25.0).scale)
    assert "of the effort" in said
    assert "2.75 N rms, of which 0.17 N are left" in said
    assert "0.2 N of 2.5 N" in said
