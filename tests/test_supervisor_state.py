"""The supervision of a rig, state by event, without rig, clock or disk."""

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.daemon.supervisor_state import (
    COMMANDS,
    TABLE,
    Ending,
    GainSet,
    Goal,
    Happening,
    Impossible,
    Life,
    Link,
    Mode,
    step,
)
from estune.errors import InvalidInput

LIVES = [
    Life(goal, home, "why", link, 0, "", paused, ending)
    for goal, home, link, paused, ending in product(
        Goal, (GainSet.ORIGINAL, GainSet.ACCEPTED), Link, ("", "told to"), Ending
    )
]
"""Every state there can be."""


def outcome(life: Life, happening: Happening) -> Life | None:
    try:
        return step(life, happening, "words")
    except InvalidInput:
        assert happening in COMMANDS
    except Impossible:
        assert happening not in COMMANDS
    return None


def moves():
    for life, happening in product(LIVES, Happening):
        after = outcome(life, happening)
        if after is not None:
            yield life, happening, after


def test_every_cell_of_the_table_is_filled_in():
    assert set(TABLE) == set(Happening)
    assert all(set(row) == set(Mode) for row in TABLE.values())
    assert {life.mode for life in LIVES} == set(Mode)


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
            assert happening in (Happening.ACCEPT, Happening.ADOPTED)
        if after.home is GainSet.ORIGINAL and life.home is GainSet.ACCEPTED:
            assert happening in (Happening.REVERT, Happening.UNSAFE)


def test_a_stop_is_heeded_wherever_it_comes():
    for life in LIVES:
        if life.ending is not Ending.STOPPED:
            assert step(life, Happening.STOP, "words").mode is Mode.STOPPING


def test_while_stopping_only_the_rig_and_the_end_are_heeded():
    for life, happening, after in moves():
        if life.mode is Mode.STOPPING:
            assert after.ending is not Ending.NO or happening is Happening.BOOT


def test_home_gains_that_change_are_put_on_the_rig_before_anything_else():
    for life, happening, after in moves():
        if after.home is not life.home:
            assert after.link is not Link.READY, (life, happening)


@given(st.lists(st.sampled_from(Happening), max_size=40))
def test_killed_at_any_instant_a_daemon_leaves_gains_that_were_at_home(happenings):
    """The rig as the keeper leaves it: written to while readying and stopping, and never else.

    A kill may come before the rig is written to or after. Trials are not in it: they are the rig's
    to undo.
    """
    life = step(Life(), Happening.BOOT)
    live, homes = GainSet.ORIGINAL, {GainSet.ORIGINAL}
    for happening in happenings:
        after = outcome(life, happening)
        if after is None:
            continue
        if happening in (Happening.READIED, Happening.ENDED):
            live = life.home
        homes.add(after.home)
        assert live in homes - {GainSet.CANDIDATE}
        if after.link is Link.READY and not after.paused and after.ending is Ending.NO:
            assert live is after.home
        life = after


def test_a_start_goes_on_with_what_was_being_done():
    for life in LIVES:
        after = step(life, Happening.BOOT)
        assert after.mode is Mode.WAITING
        expected = Goal.TUNE if life.goal is Goal.CONFIRM else life.goal
        assert (after.goal, after.home, after.paused) == (expected, life.home, life.paused)


def test_nothing_but_a_command_ends_a_pause():
    for life, happening, after in moves():
        if life.paused and not after.paused:
            assert happening is Happening.RESUME


@pytest.mark.parametrize("happening", [Happening.LOST, Happening.FAILED])
def test_failures_are_counted_until_the_rig_is_ready(happening):
    life = Life()
    for count in (1, 2, 3):
        life = step(life, happening, "gone")
        assert (life.failures, life.trouble) == (count, "gone")
    life = step(step(life, Happening.FOUND), Happening.READIED)
    assert (life.failures, life.trouble) == (0, "")


def test_a_whole_life():
    life = Life()
    for happening, mode in (
        (Happening.BOOT, Mode.WAITING),
        (Happening.FOUND, Mode.READYING),
        (Happening.READIED, Mode.TUNING),
        (Happening.SEARCHED, Mode.CONFIRMING),
        (Happening.PROPOSED, Mode.HOLDING),
        (Happening.ACCEPT, Mode.READYING),
        (Happening.READIED, Mode.WATCHING),
        (Happening.DRIFTED, Mode.TUNING),
        (Happening.LOST, Mode.WAITING),
        (Happening.FOUND, Mode.READYING),
        (Happening.READIED, Mode.TUNING),
        (Happening.SEARCHED, Mode.CONFIRMING),
        (Happening.KEPT, Mode.WATCHING),
        (Happening.PAUSE, Mode.PAUSED),
        (Happening.RESUME, Mode.READYING),
        (Happening.READIED, Mode.WATCHING),
        (Happening.STOP, Mode.STOPPING),
        (Happening.ENDED, Mode.STOPPED),
        (Happening.BOOT, Mode.WAITING),
    ):
        life = step(life, happening, "words")
        assert life.mode is mode
    assert (life.goal, life.home) == (Goal.WATCH, GainSet.ACCEPTED)


@pytest.mark.parametrize(
    ("happening", "words"),
    [
        (Happening.ACCEPT, "no candidate"),
        (Happening.REJECT, "no candidate"),
        (Happening.RESUME, "not paused"),
    ],
)
def test_a_command_without_a_place_is_refused_in_words(happening, words):
    watching = Life(Goal.WATCH, link=Link.READY)
    with pytest.raises(InvalidInput, match=words):
        step(watching, happening)
