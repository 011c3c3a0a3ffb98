"""The loop model that records identify."""

from collections.abc import Iterator, Sequence

import numpy as np

from estune.loop_model.beginning import first_starts
from estune.loop_model.bend import unbent
from estune.loop_model.bend_fit import Fits, with_bend
from estune.loop_model.contradiction import (
    APART,
    foretold_by_others,
    power_of,
    prediction_error,
    standing_out,
    with_all,
)
from estune.loop_model.criterion import criterion, criterion_of
from estune.loop_model.damping import with_mean_damping
from estune.loop_model.fit_signals import FitSignals, signals_of
from estune.loop_model.friction import fit_with_friction
from estune.loop_model.growing_poles import growing_fit
from estune.loop_model.identification import PoleFit, searched_dead_time
from estune.loop_model.loop_fit import LoopFit, summarise
from estune.loop_model.order import at_least_two, is_enough, select_order, without_spare_pole
from estune.loop_model.poles import mirrored
from estune.loop_model.records import LoopRecord
from estune.loop_model.slow_poles import is_resolved, without_slowest_pole
from estune.loop_model.strength_fit import with_strengths
from estune.loop_model.whiteness import beyond_chance, is_white

GROWTH_GAIN, GROWTH_SHARE = 10.0, 0.5
"""Decrease of the criterion, very strong evidence, from which on a plant is taken to grow, and the
share of the squared errors that such a fit may leave where it is not white. Of a plant that is not
linear, or that changes, a growing pole explains a little more."""

GROWN = 0.1
"""Logarithm of the growth over the longest record below which a pole is an integrator to it."""

FRICTION_DONE = 0.002
"""Misfit with friction up to which no further poles are tried. One timid trial of the reference
reel with 0.05 N m is white with four poles, which foretell an unstable loop."""

TRIED_WITH = (1, 2, 4, 8)
"""Numbers of records with which friction is tried again where it was not found with fewer, and
another bend where one leaves errors that are not white: it takes half a second."""


def fit_loop(
    records: Sequence[LoopRecord],
    sampling_Hz: float,
    settling_time_s: float,
    last: LoopFit | None = None,
    starts: Sequence[PoleFit] = (),
) -> LoopFit:
    """The loop model that fits records best.

    A record that the others contradict is left out: a trial that was disturbed spoils the fit.
    Where no linear model explains trials from rest, one with a bend may (`bend_fit`), or one whose
    gain is not the same in all (`strength_fit`).

    Args:
        records: At least one, of any setpoints, lengths and gains.
        sampling_Hz: Sampling rate.
        settling_time_s: Settling time asked for, which sets the scale of the search.
        last: An earlier fit to start from.
        starts: Where the search begins, as `best_scale` found it.
    """
    candidates = _candidates(records, settling_time_s * sampling_Hz, last, starts)
    return next(fit for fit in candidates if fit is not None)


def _candidates(
    records: Sequence[LoopRecord],
    settling: float,
    last: LoopFit | None,
    starts: Sequence[PoleFit],
) -> Iterator[LoopFit | None]:
    """What is tried in turn until one explains the records: None is one that does not.

    A bend or strengths that the last fit had come first, then a linear model or friction, which
    stand where they explain the records, then a bend and strengths that are found anew.
    """

    def by_two_poles(straight: Sequence[LoopRecord]) -> LoopFit:
        signals = signals_of(straight, settling)
        two = searched_dead_time(signals, first_starts(straight, settling))
        return _summarised(straight, signals, two)

    def fitted(straight: Sequence[LoopRecord], before: LoopFit | None) -> LoopFit:
        begin = [_start_of(before)] if before else first_starts(straight, settling)
        return _fit_of_those_that_agree(straight, settling, begin, before)

    fits = Fits(by_two_poles, fitted)
    if last is not None and not last.model.bend.is_straight:
        bend = last.model.bend
        straight = fitted([unbent(record, bend) for record in records], last)
        bent = with_bend(straight, records, fits, bend)
        if bent is not None and (bent.is_white or len(records) not in TRIED_WITH):
            yield bent
    if last is not None and last.strengths:
        found = with_strengths(None, records, fits)
        if found is not None and found.is_white:
            yield found
    if last is not None and not last.noise.is_white:
        last = None  # a load of the first trial would hide the friction that more trials show
    if last is not None:
        starts = [_start_of(last)]
    starts = starts or first_starts(records, settling)
    fit = _fit_of_those_that_agree(records, settling, starts, last)
    plain = fit.is_white and fit.noise.is_white
    if plain or (fit.model.friction and fit.misfit < FRICTION_DONE):
        yield fit
    yield with_bend(fit, records, fits)
    yield with_strengths(fit, records, fits)
    yield fit


def _fit_of_those_that_agree(
    records: Sequence[LoopRecord], settling: float, starts: Sequence[PoleFit], last: LoopFit | None
) -> LoopFit:
    """The fit of all records but those that the others contradict."""
    again = last is None or len(records) in TRIED_WITH
    fit = _fit(records, settling, starts, last, again=again)
    suspects = standing_out(fit)
    if suspects and foretold_by_others(fit, records, suspects):
        return fit
    while suspects:
        others = [i for i in range(len(records)) if i not in suspects]
        kept = [records[i] for i in others]
        # Anew: the poles that took up the disturbance would stay, and foretell unstable loops.
        without = _fit(kept, settling, first_starts(kept, settling), None, again=True)
        most = APART**2 * max(power_of(errors) for errors in without.errors)
        out = [i for i in suspects if power_of(prediction_error(without, records[i])) > most]
        if out == suspects:
            return with_all(without, records, others, tuple(out))
        suspects = out
    return fit


def fit_with_excitations(
    steps: Sequence[LoopRecord],
    excitations: Sequence[LoopRecord],
    sampling_Hz: float,
    settling_time_s: float,
    last: LoopFit | None = None,
) -> tuple[LoopFit, tuple[LoopRecord, ...]]:
    """The fit of step trials and excitations, and the excitations that are fitted: all or none.

    An excitation moves the effort faster than a step, perhaps beyond what the plant follows. Where
    they spoil the fit of the steps they are left out. A mode that only excitations show spoils
    nothing, for poles are added.
    """
    fit = fit_loop((*steps, *excitations), sampling_Hz, settling_time_s, last)
    if not excitations or (fit.is_white and not fit.strengths):
        return fit, tuple(excitations)
    of_steps = last if last is not None and len(last.errors) == len(steps) else None
    alone = of_steps or fit_loop(steps, sampling_Hz, settling_time_s)
    if fit.is_white and (alone.strengths or not alone.is_white):  # it is not the excitations
        return fit, tuple(excitations)
    if fit.is_white:  # with another gain than the steps, which have one: a rate limit does so
        return alone, ()
    spoilt, own = (np.concatenate(one.errors[: len(steps)]) for one in (fit, alone))
    most = beyond_chance(own.size) * power_of(own)
    return (alone, ()) if power_of(spoilt) > most else (fit, tuple(excitations))


def _fit(
    records: Sequence[LoopRecord],
    settling: float,
    starts: Sequence[PoleFit],
    last: LoopFit | None,
    *,
    again: bool,
) -> LoopFit:
    """The model of all records: of low order if that explains them, else by the criterion."""
    signals = signals_of(records, settling)
    # With one pole from the start no spare one has to be taken off (`without_spare_pole`).
    if last is not None and last.order == 1 and not last.noise.load:
        single = searched_dead_time(signals, [_start_of(last, least=1)])
        if is_enough(signals, single):
            return _summarised(records, signals, single)
    first = searched_dead_time(signals, starts)
    first = without_slowest_pole(signals, first)
    begun = _begun(signals, first) if again else [first]
    fits = [_explaining(records, signals, one, last, again=again) for one in begun]
    fit = min(fits, key=lambda one: _criterion(one, signals) + GROWTH_GAIN * one.model.grows)
    # In records of service a load may take the place of a pole.
    if fit.order != 2 or fit.model.friction or signals.in_motion or not fit.noise.is_white:
        return fit
    return _summarised(records, signals, without_spare_pole(signals, fit.poles))


def _begun(signals: FitSignals, first: PoleFit) -> list[PoleFit]:
    """The fits of low order to begin from: a first one, or one with poles that grow, or both.

    Those are sought in trials from rest that the first does not explain, or explains by a pole
    that they do not resolve.
    """
    white = is_white(signals, first.solution(signals).residual)
    if signals.in_motion or (white and is_resolved(signals, first.coordinates)):
        return [first]
    growing = growing_fit(signals)
    if growing is None:
        return [first]
    if not is_resolved(signals, growing.coordinates, GROWN):
        integrator = growing._replace(coordinates=mirrored(growing.coordinates))
        found = searched_dead_time(signals, [integrator])
        return [min(first, found, key=lambda one: criterion_of(signals, one))]
    at, before = growing.solution(signals), first.solution(signals)
    if is_white(signals, at.residual):
        gained = criterion_of(signals, first) - criterion_of(signals, growing)
        if gained <= GROWTH_GAIN:
            return [first]
        # With as many poles, or fewer, growth explains them; with more, further poles may do so.
        return (
            [growing] if growing.coordinates.size <= first.coordinates.size else [first, growing]
        )
    return [growing, first] if at.squares < GROWTH_SHARE * before.squares else [first]


def _explaining(
    records: Sequence[LoopRecord],
    signals: FitSignals,
    first: PoleFit,
    last: LoopFit | None,
    *,
    again: bool,
) -> LoopFit:
    """The model that explains all records, of two poles or more."""
    low = _summarised(records, signals, first)
    earlier = last if last is not None and last.model.friction else None
    # What did not help with a record less will hardly help now.
    if (low.is_white and not signals.in_motion) or not (
        again or earlier or (last and last.is_white)
    ):
        return low
    found = fit_with_friction(records, low, earlier) if earlier else None
    if found is not None and found.misfit < FRICTION_DONE:
        return found
    # Of two poles more one may be spare: it ends as an integrator of either sign.
    selected = without_slowest_pole(signals, select_order(signals, first))
    linear = _summarised(records, signals, selected)
    # Further poles explain the friction of one timid trial, and foretell another loop: of three of
    # the reference reel each, at gains of Ms 1.79, they state 4.0 to 4.3 with 0.02 N m and an
    # unstable loop with 0.05; friction states 1.6 to 1.8, and 1.1 to 1.7.
    if linear.is_white and not signals.in_motion and linear.order == low.order:
        return linear
    if not (again or earlier) or linear.model.grows:
        return linear
    found = found or fit_with_friction(records, low)
    if found is None or _criterion(found, signals) >= _criterion(linear, signals):
        return linear
    return found


def _criterion(fit: LoopFit, signals: FitSignals) -> float:
    squares = sum(float(e @ e) for e in fit.fitted(fit.errors))
    further = int(fit.model.friction > 0.0)
    return criterion(signals, squares, fit.order, fit.noise, further)


def _start_of(last: LoopFit, least: int = 2) -> PoleFit:
    """The fit that a search begins from where there is an earlier one, of so many poles."""
    start = last.poles
    return start._replace(coordinates=at_least_two(start.coordinates)) if least == 2 else start


def _summarised(records: Sequence[LoopRecord], signals: FitSignals, found: PoleFit) -> LoopFit:
    at = with_mean_damping(signals, found).solution(signals)
    return summarise(records, signals, at, at.slopes(signals))
