"""The supervision of a rig, state by event, without rig, clock or disk."""

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.daemon.supervisor_state import (
    COMMANDS,
    TABLE,
    GainSet,
    Goal,
    InvalidTransition,
    Link,
    Shutdown,
    SupervisorEvent,
    SupervisorMode,
    SupervisorState,
    next_state,
)
from estune.errors import InvalidInput

LIVES = [
    SupervisorState(goal, home, "why", link, 0, "", paused, ending)
    for goal, home, link, paused, ending in product(
        Goal, (GainSet.ORIGINAL, GainSet.ACCEPTED), Link, ("", "told to"), Shutdown
    )
]
"""Every state there can be."""


def outcome(life: SupervisorState, happening: SupervisorEvent) -> SupervisorState | None:
    try:
        return next_state(life, happening, "words")
    except InvalidInput:
        assert happening in COMMANDS
    except InvalidTransition:
        assert happening not in COMMANDS
    return None


def moves():
    for life, happening in product(LIVES, SupervisorEvent):
        after = outcome(life, happening)
        if after is not None:
            yield life, happening, after


def test_every_cell_of_the_table_is_filled_in():
    assert set(TABLE) == set(SupervisorEvent)
    assert all(set(row) == set(SupervisorMode) for row in TABLE.values())
    assert {life.mode for life in LIVES} == set(SupervisorMode)


def test_no_event_leads_out_of_the_states_there_can_be():
    known = {replace(life, why="", failures=0, trouble="", paused="") for life in LIVES}
    for life, happening, after in moves():
        plain = replace(after, why="", failures=0, trouble="", paused="")
        assert plain in known, (life, happening)


def test_a_candidate_is_never_at_home():
    for life, happening, after in moves():
        assert after.home is not GainSet.CANDIDATE, (life, happening)


def test_gains_become_the_home_ones_only_by_being_accepted():
    for life, happening, after in moves():
        if after.home is GainSet.ACCEPTED and life.home is GainSet.ORIGINAL:
            assert happening in (SupervisorEvent.ACCEPT, SupervisorEvent.ADOPTED)
        if after.home is GainSet.ORIGINAL and life.home is GainSet.ACCEPTED:
            assert happening in (SupervisorEvent.REVERT, SupervisorEvent.UNSAFE)


def test_a_stop_is_heeded_wherever_it_comes():
    for life in LIVES:
        if life.ending is not Shutdown.STOPPED:
            assert next_state(life, SupervisorEvent.STOP, "words").mode is SupervisorMode.STOPPING


def test_while_stopping_only_the_rig_and_the_end_are_heeded():
    for life, happening, after in moves():
        if life.mode is SupervisorMode.STOPPING:
            assert after.ending is not Shutdown.NO or happening is SupervisorEvent.BOOT


def test_home_gains_that_change_are_put_on_the_rig_before_anything_else():
    for life, happening, after in moves():
        if after.home is not life.home:
            assert after.link is not Link.READY, (life, happening)


@given(st.lists(st.sampled_from(SupervisorEvent), max_size=40))
def test_killed_at_any_instant_a_daemon_leaves_gains_that_were_at_home(happenings):
    """The rig as the keeper leaves it: written to while readying and stopping, and never else.

    A kill may come before the rig is written to or after. Trials are not in it: they are the rig's
    to undo.
    """
    life = next_state(SupervisorState(), SupervisorEvent.BOOT)
    live, homes = GainSet.ORIGINAL, {GainSet.ORIGINAL}
    for happening in happenings:
        after = outcome(life, happening)
        if after is None:
            continue
        if happening in (SupervisorEvent.READIED, SupervisorEvent.ENDED):
            live = life.home
        homes.add(after.home)
        assert live in homes - {GainSet.CANDIDATE}
        if after.link is Link.READY and not after.paused and after.ending is Shutdown.NO:
            assert live is after.home
        life = after


def test_a_start_goes_on_with_what_was_being_done():
    for life in LIVES:
        after = next_state(life, SupervisorEvent.BOOT)
        assert after.mode is SupervisorMode.WAITING
        expected = Goal.TUNE if life.goal is Goal.CONFIRM else life.goal
        assert (after.goal, after.home, after.paused) == (expected, life.home, life.paused)


def test_nothing_but_a_command_ends_a_pause():
    for life, happening, after in moves():
        if life.paused and not after.paused:
            assert happening is SupervisorEvent.RESUME


@pytest.mark.parametrize("happening", [SupervisorEvent.LOST, SupervisorEvent.FAILED])
def test_failures_are_counted_until_the_rig_is_ready(happening):
    life = SupervisorState()
    for count in (1, 2, 3):
        life = next_state(life, happening, "gone")
        assert (life.failures, life.trouble) == (count, "gone")
    life = next_state(next_state(life, SupervisorEvent.FOUND), SupervisorEvent.READIED)
    assert (life.failures, life.trouble) == (0, "")


def test_a_whole_life():
    life = SupervisorState()
    for happening, mode in (
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
        life = next_state(life, happening, "words")
        assert life.mode is mode
    assert (life.goal, life.home) == (Goal.WATCH, GainSet.ACCEPTED)


@pytest.mark.parametrize(
    ("happening", "words"),
    [
        (SupervisorEvent.ACCEPT, "no candidate"),
        (SupervisorEvent.REJECT, "no candidate"),
        (SupervisorEvent.RESUME, "not paused"),
    ],
)
def test_a_command_without_a_place_is_refused_in_words(happening, words):
    watching = SupervisorState(Goal.WATCH, link=Link.READY)
    with pytest.raises(InvalidInput, match=words):
        next_state(watching, happening)
