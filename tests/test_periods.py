"""Number of periods of a residual per turn of the drum."""

import numpy as np
import pytest

from plants.diagnosis.residual.angle_periods import ResidualOverAngle, per_turn

READ_rad = 2.0 * np.pi / 8192.0


def residual_over_angle(rng, per_turn, phase, extent_rad):
    """Wave with noise and a slope, over an angle that dwells at one end."""
    angle = extent_rad * np.concatenate([rng.random(1500), np.full(1000, 0.9)])
    angle = READ_rad * np.round(angle / READ_rad)
    noise = 0.5 * rng.standard_normal(angle.size)
    return ResidualOverAngle(angle, 3.0 - 2.0 * angle + np.sin(per_turn * angle + phase) + noise)


def test_period_is_found_in_records_of_different_phase():
    rng = np.random.default_rng(0)
    each = [residual_over_angle(rng, 46.0, phase, 2.0) for phase in (0.0, 1.5, 3.0, 4.5)]
    assert per_turn(each, READ_rad)[0] == pytest.approx(46.0, abs=0.5)


def test_period_of_few_repetitions_minimises_the_squared_error():
    one = residual_over_angle(np.random.default_rng(1), 70.0, 1.0, 0.15)
    line = np.stack([np.ones(one.angle_rad.size), one.angle_rad], axis=1)

    def squared_error(order):
        wave = np.exp(1j * order * one.angle_rad)
        columns = np.column_stack([line, wave.real, wave.imag])
        return np.linalg.lstsq(columns, one.residual, rcond=None)[1][0]

    orders = np.linspace(45.0, 300.0, 500)
    best = orders[np.argmin([squared_error(order) for order in orders])]
    assert per_turn([one], READ_rad)[0] == pytest.approx(best, abs=6.0)


def test_period_is_missing_for_a_drum_at_rest():
    assert per_turn([], READ_rad) == []
    assert per_turn([ResidualOverAngle(np.zeros(9), np.ones(9))], READ_rad) == []
