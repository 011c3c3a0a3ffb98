"""What a claim of some gains rests on, and how far inside its limits a search aims."""

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.loop_model.fitting import fit_loop
from estune.loop_model.half_widths import HalfWidths, half_widths
from estune.loop_model.intervals import margins_by_records
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.peak import shown_overshoot
from estune.loop_model.plant_error import band_powers
from estune.loop_model.prediction import expected_response
from tests.test_loop_model import COST, SAMPLING_HZ, around, linear, record_of, trial_of

GAINS = Gains(0.5, 16.0, 0.015, 0.005)
"""They overshoot."""


@pytest.fixture(scope="module")
def tried():
    """A plant, the records of gains about `GAINS` and two of them, and the fit."""
    plant = linear()
    gains = [*around(GAINS, 2), GAINS, GAINS]
    records = [record_of(plant, one, number) for number, one in enumerate(gains)]
    return plant, records, fit_loop(records, SAMPLING_HZ, COST.settling_time_s)


def test_interval_of_an_overshoot_holds_a_peak_that_the_model_does_not_have(tried):
    plant, records, fit = tried
    trial = trial_of(plant)
    told = margins_by_records(fit, records, trial, GAINS).overshoot
    assert told.value > 0.03
    agreed = shown_overshoot(fit, records, trial, GAINS, told)
    assert agreed.high - told.value < 0.01
    at = int(np.argmax(expected_response(fit.model, trial, GAINS)))
    missed = [
        one._replace(measurement=one.measurement + 0.03 * (abs(np.arange(one.samples) - at) < 12))
        for one in records
    ]
    shown = shown_overshoot(fit, missed, trial, GAINS, told)
    assert shown.low <= told.value < told.value + 0.02 < shown.high


def test_half_width_of_sensitivity_falls_with_the_trials_to_come(tried):
    plant, records, fit = tried
    now, later = (
        half_widths(fit, records, trial_of(plant), GAINS, repeats=count).sensitivity
        for count in (0, 8)
    )
    assert 0.005 < later < now < 0.05


def test_search_aims_at_a_limit_while_the_interval_exceeds_it_by_a_hundredth_at_most():
    limits = RobustnessLimits(1.6, 0.05)
    assert limits.aimed(HalfWidths(0.009, 0.0004, 0.0)) == limits
    inside = limits.aimed(HalfWidths(0.03, 0.01, 0.0))
    assert inside.max_sensitivity * np.exp(0.03) == pytest.approx(1.616)
    assert inside.max_overshoot + 0.01 == pytest.approx(0.0505)


def test_noise_at_the_ends_of_trials_is_not_taken_for_something_unexplained(tried):
    _, records, fit = tried
    powers = band_powers(fit, records)
    assert (powers.left / powers.noise)[:3].max() < 5.0
