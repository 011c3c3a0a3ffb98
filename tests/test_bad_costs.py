"""Runs on uninformative costs: they end regularly, with safe gains."""

import math

import numpy as np
import pytest

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.run.planning import make_plan
from estune.run.results.summary import summarise
from estune.run.session import Session, after_trial, new_session, next_request
from estune.trial import Outcome
from estune.tuners import DEFAULT_TUNER
from tests.support_runs import START, description


def run_to_end(cost, *, tuner=DEFAULT_TUNER, noise=0.0, seed=0, **changes) -> Session:
    """Session after a complete run on a cost of the gains with proportional noise."""
    about = description(gains=START)
    options = {"start": None, "bounds": None, "step": None, "cost": StepCost(0.1), **changes}
    session = new_session(make_plan(about, "run", tuner=tuner, **options))
    random = np.random.default_rng(seed)
    while (request := next_request(session)) is not None:
        value = cost(request.gains) * (1.0 + noise * random.standard_normal())
        session = after_trial(session, Outcome.DONE, value)
    return session


TUNERS = (DEFAULT_TUNER, "least_squares_gradient", "otis")


@pytest.mark.parametrize("tuner", TUNERS)
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_constant_cost_keeps_initial_gains(tuner, noise):
    session = run_to_end(lambda _: 2.0, tuner=tuner, noise=noise)
    summary = summarise(session)
    assert summary.complete
    assert not summary.improved
    assert summary.gains == START
    assert summary.unsafe == 0


@pytest.mark.parametrize("tuner", TUNERS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0, 1e9])
def test_search_ends_soon_where_only_the_start_is_safe(tuner, bad):
    session = run_to_end(lambda gains: 2.0 if gains == START else bad, tuner=tuner)
    summary = summarise(session)
    assert summary.complete
    assert "consecutive" in summary.message
    assert summary.gains == START
    assert summary.unsafe < 20


def bowl(gains: Gains, *which: str) -> float:
    """Cost with its minimum at twice the initial values of the named gains; flat in the others."""
    return math.exp(sum(math.log(getattr(gains, n) / getattr(START, n) / 2.0) ** 2 for n in which))


@pytest.mark.parametrize("seed", range(3))
def test_gains_without_effect_get_wider_intervals(seed):
    session = run_to_end(lambda g: bowl(g, "P", "I"), noise=0.02, seed=seed)
    summary = summarise(session)
    assert summary.improved
    assert bowl(summary.gains, "P", "I") < 1.05
    width = {name: high / low for name, low, high in summary.intervals}
    assert max(width["P"], width["I"]) < min(width["D"], width["setpoint_filter_s"])


@pytest.mark.parametrize("seed", range(3))
def test_gains_with_an_effective_product_converge_to_it(seed):
    def cost(gains):
        return math.exp(math.log(gains.P * gains.I / (START.P * START.I) / 4.0) ** 2)

    summary = summarise(run_to_end(cost, noise=0.02, seed=seed))
    assert summary.improved
    assert cost(summary.gains) < 1.05


def test_smallest_costs_are_compared_like_others():
    summary = summarise(run_to_end(lambda g: 1e-12 * bowl(g, "P", "I"), noise=0.02))
    assert summary.improved
    assert summary.cost == pytest.approx(1e-12, rel=0.1)
