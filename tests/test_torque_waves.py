"""Cogging in the current of a drive that turns at a steady speed."""

from dataclasses import replace

import numpy as np
import pytest

import plants
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.torque_waves import torque_waves
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


def test_drive_that_does_not_cog_has_no_waves():
    waves = found([turning(n, waves=()) for n in range(2)])
    assert waves is None or waves.share < 0.3


def test_diagnosis_names_the_cogging_of_a_drive_that_turns_one_way():
    d = plants.explain(SERVO, [turning(n) for n in range(2)], hold_out=[turning(5)])
    assert (d.verdict, [e.name for e in d.effects]) == ("named", ["cogging"])
    assert "one_direction" in [one.kind for one in d.limitations]
    assert "7 times a turn" in d.sentence
    (cogging,) = d.augmented.effects[:1]
    assert cogging.per_turn_1 == 7.0
