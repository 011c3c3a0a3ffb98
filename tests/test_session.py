"""The state machine of a run, without any rig."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.core.comparison import InterleavedRepeats
from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES
from estune.errors import InvalidInput
from estune.run.confirmation import confirming, extended
from estune.run.phase import Phase
from estune.run.plan import CONFIRMATION_REPEATS_MAX, Plan
from estune.run.planning import make_plan, plan_from_json, plan_to_json
from estune.run.results.summary import summarise
from estune.run.session import (
    CONSECUTIVE_CENSORED_MAX,
    after_trial,
    new_session,
    next_request,
    predict_next,
)
from estune.run.tally import UNSAFE_RATIO
from estune.trial import Outcome
from estune.trial.profiles import StepProfile
from estune.tuners.search_space import SearchSpace
from tests.support_runs import START, Seer, description


def plan(**changes) -> Plan:
    plan = make_plan(
        description(gains=START),
        "run",
        tuner="least_squares_gradient",
        start=None,
        bounds=None,
        step=StepProfile(10.0, 10.0, 0.1, 0.5),
        cost=StepCost(0.1),
        trials=10,
        repeats=3,
    )
    return replace(plan, **changes)


def advance(session, costs):
    """Session after the given costs, and its requests."""
    requests = []
    for cost in costs:
        request = next_request(session)
        assert request is not None
        requests.append((session.phase, request))
        session = after_trial(session, Outcome.DONE, cost)
    return session, requests


def test_phases_follow_one_another_and_number_every_trial():
    session, requests = advance(new_session(plan()), [1.0] * 3 + [0.9] * 10)
    assert [phase for phase, _ in requests] == [Phase.BASELINE] * 3 + [Phase.SEARCH] * 10
    assert [request.number for _, request in requests] == list(range(13))
    assert all(request.gains == START for _, request in requests[:3])
    while next_request(session) is not None:
        assert session.phase is (Phase.CHOOSE if session.confirmation is None else Phase.CONFIRM)
        session = after_trial(
            session, Outcome.DONE, 1.0 if next_request(session).gains.P == START.P else 0.5
        )
    assert {len(costs) for costs in session.confirmation.costs} == {session.plan.repeats}


def test_initial_gains_but_for_a_rounding_are_not_confirmed_against_themselves():
    session, _ = advance(new_session(plan()), [1.0] * 13)
    recommended, best = session.choice.gains
    assert recommended != START
    assert recommended.P == START.P
    for _ in range(6):
        session = after_trial(
            session, Outcome.DONE, 1.0 if next_request(session).gains == best else 0.5
        )
    assert (session.phase, session.confirmation) == (None, None)


def test_void_trial_is_only_repeated_under_a_new_id():
    session, _ = advance(new_session(plan()), [1.0] * 3)
    before = next_request(session)
    again = next_request(after_trial(session, Outcome.CANCELLED, math.nan))
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
def test_consecutive_unsafe_trials_end_search_and_keep_initial_gains(outcome, cost):
    session, _ = advance(new_session(plan(trials=100)), [1.0] * 3)
    for _ in range(CONSECUTIVE_CENSORED_MAX):
        assert session.phase is Phase.SEARCH
        session = after_trial(session, outcome, cost)
    assert "unsafe" in session.search_end
    while next_request(session) is not None:
        session = after_trial(session, outcome, cost)
    assert summarise(session).gains == START
    assert not summarise(session).improved


def test_unsafe_start_fails_the_run_with_a_sentence():
    session = after_trial(new_session(plan(eta_max=0.5)), Outcome.DONE, 1.0)
    assert next_request(session) is None
    assert "eta_max = 0.5" in session.failure
    assert summarise(session).message == session.failure


def test_insignificant_improvement_is_not_reported_as_one():
    session, _ = advance(new_session(plan()), [1.0, 1.1, 0.9] + [1.0] * 10)
    while next_request(session) is not None:
        session = after_trial(session, Outcome.DONE, 0.98)
    assert not summarise(session).improved
    assert summarise(session).gains == START


def to_the_end(session, cost_of):
    """Session after its repeats, and their requests."""
    requests = []
    while (request := next_request(session)) is not None:
        requests.append((session.phase, request.gains))
        session = after_trial(session, Outcome.DONE, cost_of(request.gains))
    return session, requests


def after_search(**changes):
    """Session after its search, with two candidates."""
    session, _ = advance(
        new_session(plan(**changes)), [1.0, 1.01, 0.99] + [0.9, 0.5, 0.95] + [0.9] * 7
    )
    assert session.phase is Phase.CHOOSE
    return session


def test_choice_and_confirmation_use_different_trials():
    session = after_search()
    first, second = session.choice.gains
    costs = {START: 1.0, first: 0.6, second: 0.4}
    session, requests = to_the_end(session, costs.get)
    assert [g for p, g in requests if p is Phase.CHOOSE] == [
        *(first, second, second, first, first, second)
    ]
    confirmed = [g for p, g in requests if p is Phase.CONFIRM]
    assert confirmed == [START, second, second, START, START, second]
    summary = summarise(session)
    assert summary.improved
    assert summary.gains == second != first
    assert summary.cost == pytest.approx(0.4)
    assert summary.change.estimate == pytest.approx(-0.6)


def test_drift_of_the_cost_is_no_improvement():
    # The plant drifts during the search: every cost falls by half.
    session, _ = to_the_end(after_search(), lambda gains: 0.5 if gains == START else 0.51)
    summary = summarise(session)
    assert not summary.improved
    assert (summary.start_cost, summary.gains) == (0.5, START)
    assert summary.change.estimate == pytest.approx(0.02)


def test_smaller_improvement_is_confirmed_by_more_repeats():
    def rounds(better):
        noise = iter([1.0, 1.03, 0.97, 1.02, 0.98] * 10)
        session = after_search()
        session, _ = to_the_end(session, lambda g: next(noise) * (1.0 if g == START else better))
        return session.confirmation.rounds

    assert rounds(0.3) == 3
    assert 3 < rounds(0.7) < rounds(0.9) == CONFIRMATION_REPEATS_MAX


@pytest.mark.parametrize(
    ("costs", "over"),
    [
        ((0.5, 0.501, 0.502), True),
        ((1.0, 1.001, 0.999), True),
        ((0.6, 0.8, 1.1), False),
        ((0.9, 1.0, 1.1), False),
        ((1.1, 1.15, 1.2), True),
    ],
    ids=["clearly better", "equal", "perhaps much better", "perhaps better", "no better"],
)
def test_repeats_go_on_until_the_improvement_is_known_or_none_is_possible(costs, over):
    repeats = InterleavedRepeats((START, replace(START, P=1.0)), 3, ((1.0, 1.001, 0.999), costs))
    assert (extended(repeats, plan(tolerance=0.02, precision=0.1)).next_index is None) is over


def test_both_gains_are_repeated_twice_at_the_least():
    other = replace(START, P=2.0 * START.P)
    assert [confirming(plan(repeats=n), other, ()).rounds for n in (1, 2, 3)] == [2, 2, 3]


def test_candidate_that_turns_out_unsafe_is_dropped():
    session = after_search()
    first, second = session.choice.gains
    one, _ = to_the_end(session, {START: 1.0, first: math.nan, second: 0.4}.get)
    assert summarise(one).gains == second
    none, _ = to_the_end(session, {START: 1.0, first: math.nan, second: 99.0}.get)
    assert summarise(none).gains == START
    assert "unsafe" in summarise(none).message
    assert (summarise(one).unsafe, summarise(none).unsafe) == (1, 2)


@pytest.mark.parametrize("cost", [0.0, -1.0, math.nan, math.inf])
def test_invalid_cost_fails_the_start_and_is_unsafe_later(cost):
    assert "cost" in after_trial(new_session(plan()), Outcome.DONE, cost).failure
    session, _ = advance(new_session(plan()), [1.0] * 3)
    assert after_trial(session, Outcome.DONE, cost).unsafe == 1


def test_constant_cost_is_no_improvement():
    session, _ = advance(new_session(plan()), [1.0] * 13)
    summary = summarise(to_the_end(session, lambda _: 1.0)[0])
    assert summary.complete
    assert not summary.improved
    assert summary.gains == START


def seer(**changes):
    return plan(tuner=Seer(SearchSpace.around(START)), **changes)


def test_search_ends_after_consecutive_trials_below_tolerance():
    session, _ = advance(new_session(seer()), [1.0] * 3 + [0.9] * 9)
    assert session.phase is not Phase.SEARCH
    assert session.search_trials == 9
    assert "remaining improvement" in session.search_end
    assert "is at most 1.0%, below" in session.search_end
    summary = summarise(session)
    assert summary.intervals == tuple(
        (name, min(0.1, gain), max(1.0, gain))  # the tuner's, and the gain that is recommended
        for name, gain in zip(GAIN_NAMES, summary.gains.as_tuple(), strict=True)
    )


@pytest.mark.parametrize(
    "options", [seer(tolerance=0.0), plan()], ids=["no tolerance", "no estimate"]
)
def test_search_without_convergence_estimate_uses_all_trials(options):
    session, _ = advance(new_session(options), [1.0] * 3 + [0.9] * 10)
    assert session.search_end == "the search used its 10 trials"


def test_predict_next_is_for_new_gains_only():
    session = new_session(seer(repeats=1))
    requests = []
    while next_request(session) is not None:
        requests.append(
            (session.phase, next_request(session).gains, predict_next(session) is not None)
        )
        session = after_trial(session, Outcome.DONE, 0.9 + 0.001 * session.number)
    new = [gains for _, gains, prediction in requests if prediction]
    assert len(new) == len(set(new))
    assert START not in new
    assert {gains for phase, gains, _ in requests if phase is Phase.SEARCH} <= {START, *new}


def test_declined_trials_are_avoided_and_not_unsafe():
    session, _ = advance(new_session(plan()), [1.0] * 3)
    session = after_trial(session, Outcome.DECLINED, math.nan)
    assert (session.declined, session.unsafe, session.search_trials) == (1, 0, 1)
    assert session.tuner_state.step_scale < 1.0


@given(st.lists(st.floats(0.8, 2.0), min_size=0, max_size=12), st.integers(0, 11))
def test_session_is_a_function_of_its_trials(costs, cut):
    straight, requests = advance(new_session(plan()), costs)
    first, _ = advance(new_session(plan()), costs[:cut])
    second, again = advance(first, costs[cut:])
    assert straight == second
    assert requests[cut:] == again


def test_plan_survives_json_exactly():
    original = plan(eta_max=1.7)
    assert plan_from_json(plan_to_json(original)) == original


@pytest.mark.parametrize(
    "wrong",
    [
        {"trials": 0},
        {"repeats": 0},
        {"eta_max": math.nan},
        {"tolerance": 1.0},
        {"tolerance": -0.1},
        {"tolerance": math.nan},
        {"ask_first": True},
    ],
)
def test_plan_refuses_unusable_values(wrong):
    words = r"^(trials|repeats|eta_max|tolerance) is|does not predict"
    with pytest.raises(InvalidInput, match=words):
        plan(**wrong)


def test_most_trials_to_come_count_every_repeat_and_do_not_grow():
    session = new_session(plan())
    assert session.most_left == session.plan.max_trials
    most = math.inf
    while session.is_open:
        assert session.number + session.most_left <= most
        most = session.number + session.most_left
        session = after_trial(session, Outcome.DONE, 1.0 / (1 + session.number))
    ended, _ = to_the_end(session, lambda g: 1.0 if g == START else 0.6)
    assert ended.number <= most


def test_max_trials_is_never_exceeded():
    for better in (0.3, 1.0):
        session, _ = to_the_end(after_search(), lambda g, b=better: 1.0 if g == START else b)
        assert session.number <= session.plan.max_trials
        assert session.trials_left == 0
