"""Trials of different gains that show different loops, and modes whose damping is not resolved."""

import control
import numpy as np
import pytest

from estune.core.gains import Gains
from estune.loop_model.agreement import contradicting_sensitivities
from estune.loop_model.damping import with_mean_damping
from estune.loop_model.fit_signals import signals_of
from estune.loop_model.fitting import fit_loop
from estune.loop_model.identification import PoleFit, improve
from experiments.loop_claims import true_sensitivity
from tests.test_loop_model import COST, GAINS, SAMPLING_HZ, SYSTEM, linear, record_of

OTHER = Gains(0.6, 9.0, 0.015, 0.01)
SETTLING_S = COST.settling_time_s


SLOWER = SYSTEM * control.tf([1.0], [0.01, 1.0])


def fit_of(*pairs):
    records = [record_of(plant, gains, n) for n, (plant, gains) in enumerate(pairs * 2)]
    return fit_loop(records, SAMPLING_HZ, SETTLING_S), records


def test_trials_of_one_plant_agree_whatever_their_gains():
    plant = linear()
    fit, records = fit_of((plant, GAINS), (plant, OTHER))
    fit = fit._replace(is_white=False)  # so that it is judged
    assert contradicting_sensitivities(fit, records, OTHER, plant.controller) == ()


def test_gains_that_meet_another_plant_show_each_their_own_sensitivity():
    plants = linear(), linear(system=SLOWER)  # another gain alone is one plant's that changes
    fit, records = fit_of((plants[0], GAINS), (plants[1], OTHER))
    found = contradicting_sensitivities(fit, records, OTHER, plants[0].controller)
    assert found == pytest.approx([true_sensitivity(one, OTHER) for one in plants], rel=0.05)


def test_one_set_of_gains_contradicts_nothing():
    plants = linear(), linear(system=SLOWER)
    fit, records = fit_of((plants[0], GAINS), (plants[1], GAINS))
    assert contradicting_sensitivities(fit, records, OTHER, plants[0].controller) == ()


MODE_HZ, DAMPING = 10.0, 1e-3


def modal(damping):
    v = 2.0 * np.pi * MODE_HZ
    return linear(system=SYSTEM * (0.9 + 0.1 * control.tf([v * v], [1, 2 * damping * v, v * v])))


def dampings(damping, seeds):
    """Damping of the mode by least squares, and its posterior mean, from two steps each."""
    v, found = 2.0 * np.pi * MODE_HZ / SAMPLING_HZ, []
    for seed in seeds:
        records = [record_of(modal(damping), GAINS, 100 + 2 * seed + i) for i in range(2)]
        settling = SETTLING_S * SAMPLING_HZ
        signals = signals_of(records, settling)
        start = np.log([2.0 * np.pi * 5.0 / SAMPLING_HZ, 0.3, v, max(damping, 1e-3)])
        fit = improve(signals, PoleFit(0.0, start, 2))
        ends = fit, with_mean_damping(signals, fit)
        found.append([np.exp(one.coordinates[3]) for one in ends])
    return np.array(found).T


def test_damping_that_the_records_do_not_resolve_is_never_none():
    fitted, mean = dampings(DAMPING, range(12))
    assert fitted.min() < 1e-6  # by least squares some modes have none
    assert mean.min() > 0.1 * DAMPING
    assert mean.max() < 10.0 * DAMPING


def test_damping_that_the_records_resolve_is_that_of_least_squares():
    fitted, mean = dampings(0.05, range(3))
    assert mean == pytest.approx(fitted, rel=0.01)
