import math
from functools import cache

import pytest

from estune.errors import InvalidInput
from experiments.paper.identify import (
    Condition,
    Dependence,
    fit_second_order,
    multisine,
    open_loop_record,
    response_of_record,
)
from plants.models.reel import reference_reel
from tests.paper.support_identify import SAMPLING_HZ
from tests.paper.test_identify import TEN_SECONDS


@cache
def grid():
    excitation = multisine(SAMPLING_HZ, TEN_SECONDS, 40.0, slope=1.5, corner_Hz=20.0)
    return tuple(
        Condition(
            L,
            T,
            fit_second_order(
                response_of_record(
                    open_loop_record(reference_reel(L, T), excitation, seed=n), excitation
                )
            ),
        )
        for n, (L, T) in enumerate((L, T) for L in (0.5, 0.8, 1.1, 1.4) for T in (5.0, 12.0, 40.0))
    )


def test_dependence_interpolates_its_conditions_and_predicts_others():
    dependence = Dependence(grid())
    for condition in grid():
        model = dependence.at(condition.cable_length_m, condition.tension_N)
        own = condition.fit.model
        assert model.natural_frequency_rad_s == pytest.approx(own.natural_frequency_rad_s)
        assert model.damping == pytest.approx(own.damping)
        assert model.dead_time_s == pytest.approx(own.dead_time_s)
        assert dependence.estimates(condition.cable_length_m, condition.tension_N)[
            "natural_frequency_Hz"
        ].standard_error == pytest.approx(condition.fit.natural_frequency_Hz.standard_error)
    for L, T in ((0.65, 20.0), (0.95, 8.0), (1.25, 30.0)):
        reel, model = reference_reel(L, T), dependence.at(L, T)
        w = reel.natural_frequency_rad_s
        assert model.natural_frequency_rad_s == pytest.approx(w, rel=0.005)
        assert model.damping == pytest.approx((0.010 + 0.015 * L) / (4.0e-3 * w), rel=0.03)


def test_dependence_rejects_extrapolation():
    conditions = grid()
    dependence = Dependence(conditions)
    with pytest.raises(InvalidInput, match=r"outside the identified range of 0\.5 to 1\.4 m"):
        dependence.at(1.6, 10.0)
    with pytest.raises(InvalidInput, match="lies outside the identified range of 5 to 40 N"):
        dependence.at(0.8, math.nan)
    with pytest.raises(InvalidInput, match="three or more are needed"):
        Dependence(conditions[:2])
    with pytest.raises(InvalidInput, match="keep one of them"):
        Dependence([*conditions, conditions[0]])
    with pytest.raises(InvalidInput, match="vary together"):
        Dependence([c._replace(tension_N=1.0 / c.cable_length_m) for c in conditions[::3]])
    along = Dependence(conditions[::3])  # one tension: a model of length alone
    assert along.at(0.65, 5.0).damping > 0.0
    with pytest.raises(InvalidInput, match="range of 5 to 5 N"):
        along.at(0.65, 12.0)
