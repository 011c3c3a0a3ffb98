"""The run as a pure fold, without any rig."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core.cost import StepCost
from estune.errors import InvalidInput
from estune.planning import make_plan, plan_from_json, plan_to_json
from estune.profiles import StepProfile
from estune.session import (
    UNSAFE_IN_A_ROW,
    UNSAFE_RATIO,
    Phase,
    Plan,
    begin,
    next_request,
    told,
    verdict,
)
from estune.trial import Outcome
from tests.support_runs import START, description


def plan(**changes) -> Plan:
    made = make_plan(
        description(gains=START),
        "run",
        tuner="least_squares_gradient",
        start=None,
        bounds=None,
        step=StepProfile(10.0, 10.0, 0.1, 0.5),
        cost=StepCost(0.1),
        trials=10,
    )
    return replace(made, **changes)


def advance(session, costs):
    """The session after the given costs, and what it asked for."""
    asked = []
    for cost in costs:
        request = next_request(session)
        assert request is not None
        asked.append((session.phase, request))
        session = told(session, Outcome.DONE, cost)
    return session, asked


def test_the_phases_follow_one_another_and_number_every_trial():
    session, asked = advance(begin(plan()), [1.0] * 3 + [0.9] * 10)
    assert [phase for phase, _ in asked] == [Phase.BASELINE] * 3 + [Phase.SEARCH] * 10
    assert [request.number for _, request in asked] == list(range(13))
    assert all(request.gains == START for _, request in asked[:3])
    while next_request(session) is not None:
        assert session.phase is Phase.CONFIRM
        session = told(session, Outcome.DONE, 0.5)
    assert {len(costs) for costs in session.confirmed} == {session.plan.repeats}


def test_a_void_trial_is_asked_again_under_a_new_id_and_changes_nothing_else():
    session, _ = advance(begin(plan()), [1.0] * 3)
    before = next_request(session)
    again = next_request(told(session, Outcome.CANCELLED, math.nan))
    assert before is not None
    assert again is not None
    assert again.gains == before.gains
    assert again.number == before.number
    assert again.trial_id != before.trial_id


@pytest.mark.parametrize(
    ("outcome", "cost"),
    [
        (Outcome.GUARD, math.nan),
        (Outcome.DIVERGED, math.nan),
        (Outcome.DONE, math.inf),
        (Outcome.DONE, UNSAFE_RATIO * 1.01),
    ],
)
def test_unsafe_trials_end_the_search_and_the_start_is_kept(outcome, cost):
    session, _ = advance(begin(plan(trials=100)), [1.0] * 3)
    for _ in range(UNSAFE_IN_A_ROW):
        assert session.phase is Phase.SEARCH
        session = told(session, outcome, cost)
    assert "unsafe" in session.search_end
    while next_request(session) is not None:
        session = told(session, outcome, cost)
    assert verdict(session).gains == START
    assert not verdict(session).improved


def test_an_unsafe_start_fails_the_run_with_a_sentence():
    session = told(begin(plan(eta_max=0.5)), Outcome.DONE, 1.0)
    assert next_request(session) is None
    assert "eta_max = 0.5" in session.failure
    assert verdict(session).message == session.failure


def test_an_improvement_within_the_scatter_is_not_called_one():
    session, _ = advance(begin(plan()), [1.0, 1.1, 0.9] + [1.0] * 10)
    while next_request(session) is not None:
        session = told(session, Outcome.DONE, 0.98)
    assert not verdict(session).improved
    assert verdict(session).gains == START


def test_the_lower_of_the_confirmed_candidates_is_recommended():
    costs = iter([1.0] * 3 + [0.9, 0.5, 0.95] + [0.9] * 7)
    session = begin(plan())
    while session.phase is not Phase.CONFIRM:
        session = told(session, Outcome.DONE, next(costs))
    first, second = session.candidates
    while (request := next_request(session)) is not None:
        session = told(session, Outcome.DONE, 0.4 if request.gains == second else 0.6)
    found = verdict(session)
    assert found.improved
    assert found.gains == second
    assert found.cost == pytest.approx(0.4)
    assert first != second


@given(st.lists(st.floats(0.8, 2.0), min_size=0, max_size=12), st.integers(0, 11))
def test_the_session_is_a_function_of_what_it_was_told(costs, cut):
    straight, asked = advance(begin(plan()), costs)
    first, _ = advance(begin(plan()), costs[:cut])
    second, again = advance(first, costs[cut:])
    assert straight == second
    assert asked[cut:] == again


def test_a_plan_survives_json_exactly():
    made = plan(eta_max=1.7)
    assert plan_from_json(plan_to_json(made)) == made


@pytest.mark.parametrize("wrong", [{"trials": 0}, {"repeats": 0}, {"eta_max": math.nan}])
def test_a_plan_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(InvalidInput, match=r"at least 1|eta_max"):
        plan(**wrong)


def test_a_start_that_is_repeated_takes_turns_with_the_candidates_and_is_what_they_are_held_to():
    # The plant drifts during the search: everything costs twice as much after it.
    session, _ = advance(begin(plan(repeat_start=True)), [1.0] * 3 + [0.9] * 10)
    asked = []
    while (request := next_request(session)) is not None:
        asked.append(request.gains)
        session = told(session, Outcome.DONE, 2.0 if request.gains == START else 1.6)
    assert asked == list(session.candidates) * 3
    assert asked[0] == START
    found = verdict(session)
    assert (found.start_cost, found.cost) == pytest.approx((2.0, 1.6))
    assert found.improved


def test_plans_written_before_the_start_could_be_repeated_do_not_repeat_it():
    written = plan_to_json(plan())
    del written["repeat_start"]
    assert plan_from_json(written) == plan()
