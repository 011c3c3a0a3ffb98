"""Several sets of gains within one log, as of a schedule or of somebody who tunes."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.recordings.loop_log import LoopLog
from estune.service_records.controller_search import AS_WELL, FITS
from estune.service_records.replay import Replay, apart, error_of, plain_error, replay
from estune.service_records.stretches import Stretch, find_stretches

FEWEST = 8
"""Samples of the shortest stretch that may tell of other gains: three gains and three states that
it begins with leave two to contradict them."""

OTHERS_LEAVE = 4.0
"""What other gains leave at least, over what explains the effort."""

EXACT = 0.01
"""Least share of what may be left that tells a change of gains: the rounding of a log."""

MOST = 6
"""Sets in one log, at most; more are no sets but a form that is not known."""


class GainSet(NamedTuple):
    """Gains that ran in a part of a log.

    Attributes:
        replay: What they leave of the effort there.
        stretches: Where they are seen to run.
    """

    replay: Replay
    stretches: tuple[Stretch, ...]
    stop_s: float


def gain_sets(
    log: LoopLog, settings: ControllerSettings, stated: Gains | None
) -> tuple[GainSet, ...]:
    """The sets of gains that ran in a log one after the other; empty where no effort shows any.

    More than one is found only where each explains its part and none those of its neighbours.
    """
    P = stated.P if stated else None
    stretches = find_stretches(log, P)[0]
    if not stretches or any(s.effort is None for s in stretches):
        return ()
    end_s = float(log.parts[-1]["time"][-1])
    whole = GainSet(replay(stretches, settings, stated), tuple(stretches), end_s)
    pieces = find_stretches(log, P, FEWEST)[0]
    span = whole.replay.range
    if whole.replay.explained and not any(_is_other(s, whole.replay, settings) for s in pieces):
        return (whole,)
    own = whole.replay.controller if whole.replay.explained else None
    found = _in_turn(pieces, own or settings, log.sampling_Hz, span)
    if len(found) < 2:
        return (whole,)
    last = found[-1]
    return (*found[:-1], last._replace(replay=replay(last.stretches, settings, stated)))


def _is_other(stretch: Stretch, known: Replay, settings: ControllerSettings) -> bool:
    """Whether the known gains leave more of a stretch than any may that ran in it."""
    own, most = known.controller or settings, OTHERS_LEAVE * FITS * known.range
    if known.ran is None or error_of([stretch], own, known.ran) <= most:
        return False
    here = replay([stretch], own, known.ran)
    return here.stated_error * here.range > most and here.explained


def _in_turn(
    pieces: Sequence[Stretch], settings: ControllerSettings, rate: float, span: float
) -> list[GainSet]:
    """Sets in the order of time, each of the longest run of samples that one set explains."""
    sets, waiting = [list[Stretch]()], list(pieces)
    while waiting:
        piece = waiting.pop(0)
        if plain_error([*sets[-1], piece], settings) <= FITS * span:
            sets[-1].append(piece)
            continue
        fits = _same_gains(piece, sets[-1], settings, FITS * span)
        if fits:
            sets[-1].append(piece.part(slice(0, fits), rate))
        if not sets[-1] or len(sets) == MOST:
            return []
        sets.append([])
        if piece.samples - fits >= FEWEST:
            waiting.insert(0, piece.part(slice(fits, piece.samples), rate))
    found = [_gain_set(members, settings, rate) for members in sets if members]
    ran = [one.replay.ran for one in found if one.replay.explained and one.replay.ran]
    if len(ran) < len(found) or not all(apart(*pair) for pair in pairwise(ran)):
        return []
    return found


def _gain_set(members: Sequence[Stretch], settings: ControllerSettings, rate: float) -> GainSet:
    stop_s = members[-1].start_s + (members[-1].samples - 1) / rate
    return GainSet(replay(members, settings, None), tuple(members), stop_s)


def _same_gains(
    piece: Stretch, members: Sequence[Stretch], settings: ControllerSettings, most: float
) -> int:
    """Samples of a stretch up to a change of gains; zero where they are too few.

    By bisection, and again with what a part that is surely before the change leaves: up to the
    error allowed some samples of other gains bend those before.
    """
    longest = _longest_beginning(piece, members, settings, most)
    if longest < FEWEST:
        return 0
    sure = max(longest // 2, FEWEST)
    left = plain_error([*members, piece.part(slice(0, sure))], settings)
    within = min(max(AS_WELL * left, EXACT * most), most)
    return _longest_beginning(piece.part(slice(0, longest)), members, settings, within)


def _longest_beginning(
    piece: Stretch, members: Sequence[Stretch], settings: ControllerSettings, most: float
) -> int:
    """Samples of the beginning of a stretch that leaves so much at most with other stretches."""
    fits, fails = 0, piece.samples + 1
    while fails - fits > 1:
        middle = (fits + fails) // 2
        here = [*members, piece.part(slice(0, middle))]
        if middle < FEWEST or plain_error(here, settings) <= most:
            fits = middle
        else:
            fails = middle
    return fits


def cut(stretch: Stretch, sets: Sequence[GainSet], rate: float) -> list[tuple[Stretch, int]]:
    """A stretch in parts of one set each, and the number of its set.

    The part behind a change of gains is named after the time from which they are seen.
    """
    ends = [one.stop_s for one in sets[:-1]]
    time = stretch.start_s + np.arange(stretch.samples) / rate
    of = np.searchsorted(np.array(ends) + 0.5 / rate, time)
    parts = list[tuple[Stretch, int]]()
    for number in np.unique(of).tolist():
        rows = np.flatnonzero(of == number)
        part = stretch.part(slice(int(rows[0]), int(rows[-1]) + 1), rate)
        name = f"{stretch.log} from {ends[number - 1]:.4g} s" if number else stretch.log
        parts.append((part._replace(log=name), number))
    return parts
