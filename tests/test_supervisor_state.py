"""State machine of the supervisor: every event in every state."""

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.daemon.supervisor_state import (
    COMMANDS,
    GainSet,
    Goal,
    InvalidTransition,
    RigLink,
    Shutdown,
    SupervisorEvent,
    SupervisorMode,
    SupervisorState,
    next_state,
)
from estune.errors import InvalidInput

STATES = [
    SupervisorState(goal, home, "why", link, 0, "", paused, ending)
    for goal, home, link, paused, ending in product(
        Goal, (GainSet.ORIGINAL, GainSet.ACCEPTED), RigLink, ("", "told to"), Shutdown
    )
]
"""Every possible state."""


def outcome(state: SupervisorState, event: SupervisorEvent) -> SupervisorState | None:
    try:
        return next_state(state, event, "words")
    except InvalidInput:
        assert event in COMMANDS
    except InvalidTransition:
        assert event not in COMMANDS
    return None


def moves():
    for state, event in product(STATES, SupervisorEvent):
        after = outcome(state, event)
        if after is not None:
            yield state, event, after


def test_events_all_lead_to_valid_states():
    plain_states = {replace(state, why="", failures=0, trouble="", paused="") for state in STATES}
    for state, event, after in moves():
        plain = replace(after, why="", failures=0, trouble="", paused="")
        assert plain in plain_states, (state, event)


def test_candidate_is_never_the_nominal_gains():
    for state, event, after in moves():
        assert after.home is not GainSet.CANDIDATE, (state, event)


def test_nominal_gains_change_only_by_accept_or_revert():
    for state, event, after in moves():
        if after.home is GainSet.ACCEPTED and state.home is GainSet.ORIGINAL:
            # Inherited gains are those that another daemon had accepted.
            assert event in (
                SupervisorEvent.ACCEPT,
                SupervisorEvent.ADOPTED,
                SupervisorEvent.INHERITED,
            )
        if after.home is GainSet.ORIGINAL and state.home is GainSet.ACCEPTED:
            assert event in (SupervisorEvent.REVERT, SupervisorEvent.UNSAFE)


def test_stop_is_taken_in_every_state():
    for state in STATES:
        if state.ending is not Shutdown.STOPPED:
            assert next_state(state, SupervisorEvent.STOP, "words").mode is SupervisorMode.STOPPING


def test_stopping_ends_only_by_the_end_or_a_boot():
    for state, event, after in moves():
        if state.mode is SupervisorMode.STOPPING:
            assert after.ending is not Shutdown.NO or event is SupervisorEvent.BOOT


def test_changed_nominal_gains_are_applied_before_anything_else():
    for state, event, after in moves():
        if after.home is not state.home:
            assert after.link is not RigLink.READY, (state, event)


@given(st.lists(st.sampled_from(SupervisorEvent), max_size=40))
def test_kill_at_any_instant_leaves_gains_that_were_nominal(events):
    """The supervisor changes the rig's gains while readying and stopping only.

    A kill may come before or after the change. Trials are left out: the rig restores its gains.
    """
    state = next_state(SupervisorState(), SupervisorEvent.BOOT)
    live, nominal = GainSet.ORIGINAL, {GainSet.ORIGINAL}
    for event in events:
        after = outcome(state, event)
        if after is None:
            continue
        if event in (SupervisorEvent.READIED, SupervisorEvent.ENDED):
            live = state.home
        nominal.add(after.home)
        assert live in nominal - {GainSet.CANDIDATE}
        if after.link is RigLink.READY and not after.paused and after.ending is Shutdown.NO:
            assert live is after.home
        state = after


def test_boot_continues_the_goal_and_keeps_a_pause():
    for state in STATES:
        after = next_state(state, SupervisorEvent.BOOT)
        assert after.mode is SupervisorMode.WAITING
        expected = Goal.TUNE if state.goal is Goal.CONFIRM else state.goal
        assert (after.goal, after.home, after.paused) == (expected, state.home, state.paused)


def test_pause_ends_only_by_resume():
    for state, event, after in moves():
        if state.paused and not after.paused:
            assert event is SupervisorEvent.RESUME


@pytest.mark.parametrize("event", [SupervisorEvent.LOST, SupervisorEvent.FAILED])
def test_failures_are_counted_until_the_rig_is_ready(event):
    state = SupervisorState()
    for count in (1, 2, 3):
        state = next_state(state, event, "gone")
        assert (state.failures, state.trouble) == (count, "gone")
    state = next_state(next_state(state, SupervisorEvent.FOUND), SupervisorEvent.READIED)
    assert (state.failures, state.trouble) == (0, "")


def test_supervision_from_first_tuning_to_stop_and_restart():
    state = SupervisorState()
    for event, mode in (
        (SupervisorEvent.BOOT, SupervisorMode.WAITING),
        (SupervisorEvent.FOUND, SupervisorMode.READYING),
        (SupervisorEvent.READIED, SupervisorMode.TUNING),
        (SupervisorEvent.SEARCHED, SupervisorMode.CONFIRMING),
        (SupervisorEvent.PROPOSED, SupervisorMode.HOLDING),
        (SupervisorEvent.ACCEPT, SupervisorMode.READYING),
        (SupervisorEvent.READIED, SupervisorMode.WATCHING),
        (SupervisorEvent.DRIFTED, SupervisorMode.TUNING),
        (SupervisorEvent.LOST, SupervisorMode.WAITING),
        (SupervisorEvent.FOUND, SupervisorMode.READYING),
        (SupervisorEvent.READIED, SupervisorMode.TUNING),
        (SupervisorEvent.SEARCHED, SupervisorMode.CONFIRMING),
        (SupervisorEvent.KEPT, SupervisorMode.WATCHING),
        (SupervisorEvent.PAUSE, SupervisorMode.PAUSED),
        (SupervisorEvent.RESUME, SupervisorMode.READYING),
        (SupervisorEvent.READIED, SupervisorMode.WATCHING),
        (SupervisorEvent.STOP, SupervisorMode.STOPPING),
        (SupervisorEvent.ENDED, SupervisorMode.STOPPED),
        (SupervisorEvent.BOOT, SupervisorMode.WAITING),
    ):
        state = next_state(state, event, "words")
        assert state.mode is mode
    assert (state.goal, state.home) == (Goal.WATCH, GainSet.ACCEPTED)


@pytest.mark.parametrize(
    ("event", "words"),
    [
        (SupervisorEvent.ACCEPT, "no candidate"),
        (SupervisorEvent.REJECT, "no candidate"),
        (SupervisorEvent.RESUME, "not paused"),
    ],
)
def test_command_not_allowed_is_refused_with_the_reason(event, words):
    watching = SupervisorState(Goal.WATCH, link=RigLink.READY)
    with pytest.raises(InvalidInput, match=words):
        next_state(watching, event)
