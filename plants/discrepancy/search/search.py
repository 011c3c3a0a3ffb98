"""The search for missing effects: screen, fit jointly, rank on data not fitted, add, repeat."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estune.trial import FloatArray
from plants.discrepancy.data.floor import Floor
from plants.discrepancy.data.record import Measurement
from plants.discrepancy.models.models import Diagnosed
from plants.discrepancy.prediction.prediction import Prediction, Predictor
from plants.discrepancy.search import thresholds
from plants.discrepancy.search.fit import Fitted, fit, settled, switched_on
from plants.discrepancy.search.screen import (
    Background,
    Screened,
    Suggest,
    is_limit,
    orthonormal,
    screen,
)
from plants.discrepancy.search.splits import FIT, RANK, REPORT, Dealt, deal
from plants.effects import Effect, Port

SCREENED = 12_000
"""Entries that directions are compared over."""
SHIFTS = np.array([0.0, *(sign * 3.0**n for n in range(6) for sign in (-1, 1))])
"""Shifts of a record's own value, in floors of change, among which the best is begun with."""
SWITCHED = 0.3
"""Size a member of a family is switched on with to see its direction, by that it inherits."""
ROUGH = np.array([0.1, 0.3, 1.0, 2.0, 3.5, 6.0, 12.0])
"""Sizes tried of an effect that no direction shows, relative to the usual one."""
TRYOUT = 1
"""Rounds of each start before the best is gone on with."""
FIRST_ROUNDS = 3
"""Rounds of a fit before the attempts far behind are left where they are."""
FINISHED = 4
"""Attempts whose fits are finished."""

Effects = tuple[type[Effect], ...]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """A model with effects, fitted on the fit split.

    Attributes:
        effects: The effects added.
        fitted: The fit.
        fit_J: Mean square of the whitened residuals on the fit split; 1 is the floor.
        rank_J: The same on the rank split.
        squares: Sum of squares on the rank split, block by block.
    """

    effects: Effects
    fitted: Fitted
    fit_J: float
    rank_J: float
    squares: FloatArray

    @property
    def values(self) -> dict[str, float]:
        """The values by name."""
        return self.fitted.predictor.values(self.fitted.values)


class Bench:
    """Fits models with effects to the records, and judges them on the other splits.

    Attributes:
        model: The model as given.
        measurements: The records.
        dealt: What each residual entry is used for.
        base: The predictor without effects.
    """

    def __init__(
        self, model: Diagnosed, measurements: Sequence[Measurement], floor: Floor
    ) -> None:
        self.model, self.measurements, self.floor = model, tuple(measurements), floor
        self._predictors: dict[Effects, Predictor] = {}
        self.base = self.predictor(())
        self.dealt: Dealt = deal(measurements, self.base.index)
        self.entries = {split: self.dealt.where(split) for split in (FIT, RANK, REPORT)}

    @property
    def scale(self) -> thresholds.Scale:
        """What sizes of effects are measured against."""
        return thresholds.Scale(
            sample_s=1.0 / min(m.sampling_Hz for m in self.measurements),
            angle_rad=self.floor.angle_rad,
            tension_N=self.floor.tension_N,
        )

    def predictor(self, effects: Effects) -> Predictor:
        """The model with effects, compiled once."""
        if effects not in self._predictors:
            self._predictors[effects] = Predictor(
                self.model, effects, self.measurements, floor=self.floor
            )
        return self._predictors[effects]

    def attempt(
        self,
        effects: Effects,
        starts: FloatArray,
        rounds: int = 15,
        owners: frozenset[str] | None = None,
    ) -> Attempt:
        """The best fit of a model from several starts.

        Args:
            effects: The effects added.
            starts: Rows of values, shape (starts, free).
            rounds: Most rounds of each fit.
            owners: Whose values may move besides those of single records; None is all.
        """
        predictor = self.predictor(effects)
        moves = self.moves(predictor)
        if owners is not None:
            free = predictor.free
            moves = np.array(
                [
                    n
                    for n in moves
                    if free[n].owner in owners or _record(free[n].owner) is not None
                ],
                dtype=np.int64,
            )
        entries = self.entries[FIT]
        rows = self.placed(predictor, starts)
        if len(rows) == 1:
            return self._judged(effects, fit(predictor, rows[0], moves, entries, rounds))
        begun = [
            fit(predictor, row, moves, entries, TRYOUT)
            for row in self.best_starts(predictor, rows)
        ]
        best = min(begun, key=lambda f: f.mean_square(entries))
        return self._judged(effects, fit(predictor, best.values, moves, entries, rounds))

    def switched_on(
        self, predictor: Predictor, rows: FloatArray, size: int, step: float
    ) -> FloatArray:
        """Rows with a value that does nothing switched on; see `fit.switched_on`."""
        moves = self.moves(predictor)
        return switched_on(predictor, rows, size, step, moves=moves, entries=self.entries[FIT])

    def best_starts(self, predictor: Predictor, rows: FloatArray, most: int = 2) -> FloatArray:
        """The rows of values that leave the least on the fit split."""
        found = predictor.residuals(rows)[:, self.entries[FIT]]
        best: FloatArray = rows[np.einsum("ij,ij->i", found, found).argsort()[:most]]
        return best

    def placed(
        self, predictor: Predictor, rows: FloatArray, only: Numbers | None = None
    ) -> FloatArray:
        """Rows with each record's own values moved to where the residuals are least.

        An effect that bends the cable's law shifts the angle at which it is taut, further than
        a fit from elsewhere finds back.

        Args:
            predictor: The model.
            rows: Values, shape (rows, free).
            only: Numbers of the values that may move; None is all.
        """
        free = predictor.free
        bends = {Port.CABLE, Port.EYELET}
        if not any(bends & set(effect.ports()) for effect in self.effects_of(predictor)):
            return rows
        kinds: dict[str, dict[int, int]] = {}
        for n, f in enumerate(free):
            record = _record(f.owner)
            if record is not None and (only is None or n in only):
                kinds.setdefault(f.name.partition("[")[0], {})[record] = n
        measurement = predictor.index.measurement
        first = np.searchsorted(measurement, np.arange(len(self.measurements)))
        for own in kinds.values():
            records, places = np.array(list(own)), np.array(list(own.values()))
            _, slope = predictor.linearise(rows[0], places)
            steepness = np.sqrt(np.einsum("ij,ij->j", slope, slope) / measurement.size)
            if not steepness.all():
                continue
            shifted = np.repeat(rows, SHIFTS.size, axis=0)
            shifted[:, places] += np.tile(SHIFTS, len(rows))[:, None] / steepness
            squares = np.add.reduceat(predictor.residuals(shifted) ** 2, first, axis=1)
            best = squares.reshape(len(rows), SHIFTS.size, -1)[:, :, records].argmin(axis=1)
            rows = rows.copy()
            rows[:, places] += SHIFTS[best] / steepness
        return rows

    def further(self, attempt: Attempt) -> Attempt:
        """The same, fitted to the end."""
        f = attempt.fitted
        return self._judged(
            attempt.effects, fit(f.predictor, f.values, f.moved, self.entries[FIT])
        )

    def _judged(self, effects: Effects, found: Fitted) -> Attempt:
        held = self.settled(found, RANK)
        entries = self.entries[RANK] if self.entries[RANK].size else self.entries[FIT]
        squares = np.bincount(self.dealt.group[entries], weights=held.residuals[entries] ** 2)
        return Attempt(
            effects,
            found,
            found.mean_square(self.entries[FIT]),
            held.mean_square(entries),
            squares[np.unique(self.dealt.group[entries])].astype(np.float64),
        )

    def settled(self, found: Fitted, split: int) -> Fitted:
        """A fit with the held-out records' own values fitted to a split's entries of them."""
        own = self._own(found.predictor, split)
        if not own.size:
            return found
        row = self.placed(found.predictor, found.values[None, :], own)[0]
        return settled(replace(found, values=row), own, self.entries[split])

    def final(self, attempt: Attempt) -> Fitted:
        """The same model fitted to the fit and the rank split together."""
        predictor = attempt.fitted.predictor
        entries = self.dealt.where(FIT, RANK)
        moves = np.union1d(attempt.fitted.moved, self._own(predictor, RANK))
        return fit(predictor, attempt.fitted.values, moves, entries)

    def effects_of(self, predictor: Predictor) -> Effects:
        """The effects a predictor adds."""
        return next(e for e, p in self._predictors.items() if p is predictor)

    def free_run(self, fitted: Fitted) -> list[Prediction]:
        """Each record from its start, with nothing put right on the way."""
        effects = self.effects_of(fitted.predictor)
        values = fitted.predictor.values(self.settled(fitted, REPORT).values)
        running = Predictor(self.model, effects, self.measurements, None, self.floor)
        known = {f.name for f in running.free}
        row = running.row({name: value for name, value in values.items() if name in known})
        return running.predict(row[None, :])

    def moves(self, predictor: Predictor) -> Numbers:
        """Numbers of the values that the fit split can tell."""
        measured = set(np.unique(predictor.index.measurement[self.entries[FIT]]).tolist())
        return np.array(
            [n for n, f in enumerate(predictor.free) if _record(f.owner) in {None, *measured}],
            dtype=np.int64,
        )

    def _own(self, predictor: Predictor, split: int) -> Numbers:
        """Numbers of the values that belong to held-out records of a split."""
        measured = set(np.unique(predictor.index.measurement[self.entries[split]]).tolist())
        wanted = measured & self.dealt.records
        return np.array(
            [n for n, f in enumerate(predictor.free) if _record(f.owner) in wanted], dtype=np.int64
        )


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """One round of the search.

    Attributes:
        before: The model it began with.
        screened: Share of the residual explained in each effect's direction, by slug.
        attempts: What was fitted, best first.
        taken: What it ended with; `before` where nothing was worth adding.
        tied: Slugs that did as well as the one taken and are of another family, best first.
    """

    before: Attempt
    screened: Mapping[str, float]
    attempts: tuple[Attempt, ...]
    taken: Attempt
    tied: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What the search found.

    Attributes:
        base: The base model.
        rounds: Round by round; the last one added nothing, unless there were as many as may be.
        screened: Each effect's direction from the base model, by slug.
    """

    base: Attempt
    rounds: tuple[Round, ...]
    screened: Mapping[str, Screened]

    @property
    def best(self) -> Attempt:
        """The model with all effects that were worth adding."""
        return self.rounds[-1].taken if self.rounds else self.base


def closure(before_J: float, after_J: float, floor_J: float = 1.0) -> float:
    """Share of the power above the floor that was closed; 1 where all of it was.

    Args:
        before_J: Mean square of the whitened residuals before.
        after_J: After.
        floor_J: What noise and allowance alone give.
    """
    above = before_J - min(floor_J, after_J)
    return (before_J - max(after_J, min(floor_J, before_J))) / above if above > 0.0 else 0.0


def search(
    bench: Bench, base: Attempt, effects: Sequence[type[Effect]], suggest: Suggest
) -> Found:
    """Looks for the effects that are missing, one after the other.

    Args:
        bench: Model and records.
        base: The base model's fit.
        effects: The effects to choose from.
        suggest: What the data suggest for their parameters.
    """
    seen = [_background(bench, base, suggest)]
    if base.fit_J > thresholds.DISTORTED**2:
        nobody: frozenset[str] = frozenset()
        given = bench.attempt((), bench.base.start[None, :], owners=nobody)
        there = _background(bench, given, suggest, bench.moves(bench.base))
        # Where calibrations had to move far for good, the model as given is no place to look from.
        seen = [there] if given.fit_J < thresholds.NEAR * base.fit_J else [*seen, there]
    screened = {e.name: screen(e, bench.predictor((e,)), seen) for e in effects}
    rounds: list[Round] = []
    current = base
    while len(rounds) < thresholds.DEEPEST:
        seen_now = _background(bench, current, suggest) if rounds else seen[0]
        rounds.append(_round(bench, base, current, screened, seen_now))
        if rounds[-1].taken is current:
            break
        current = rounds[-1].taken
    return Found(base, tuple(rounds), screened)


def _background(
    bench: Bench, attempt: Attempt, suggest: Suggest, moves: Numbers | None = None
) -> Background:
    """What directions are compared with, at a fit.

    Args:
        bench: Model and records.
        attempt: The fit.
        suggest: What the data suggest for parameters.
        moves: Numbers of the values that calibrations may move; None is what the fit moved.
    """
    fitted = attempt.fitted
    entries = bench.entries[FIT]
    # A product over many entries is as well known from some of them.
    entries = entries[:: max(1, entries.size // SCREENED)]
    jacobian = fitted.predictor.linearise(fitted.values, fitted.moved if moves is None else moves)[
        1
    ]
    basis = orthonormal(jacobian.T[:, entries])
    residual = fitted.residuals[entries]
    return Background(
        values=attempt.values,
        residual=residual - (basis @ residual) @ basis,
        basis=basis,
        entries=entries,
        lowest_Hz=1.0 / max(m.duration_s for m in bench.measurements),
        highest_Hz=0.45 * min(m.sampling_Hz for m in bench.measurements),
        suggest=suggest,
    )


def _round(
    bench: Bench,
    base: Attempt,
    current: Attempt,
    screened: Mapping[str, Screened],
    seen: Background,
) -> Round:
    """Fits the most promising effects, and takes the best where it is worth adding."""
    shares = {}
    for name, one in screened.items():
        if set(_family(name)) & {e.name for e in current.effects}:
            continue
        shares[name] = one.cosine2
        if current.effects:  # in the direction it had before others were added
            shares[name] = seen.against(one.changes).explained(only_up=False)[0]
    few = current.effects or current.rank_J < thresholds.NOTHING**2
    many = thresholds.SHORTLIST_FURTHER if few else thresholds.SHORTLIST
    names = [n for n in sorted(shares, key=lambda n: -shares[n]) if shares[n] > 0.0][:many]
    names += [n for n in shares if n not in names and set(_family(n)) & set(names)]
    attempts: list[Attempt] = []
    for name in sorted(names, key=lambda n: _family(n).index(n)):
        attempts.append(_with(bench, current, screened[name], attempts))
    attempts = _finished(bench, _reduced(bench, attempts))
    best = _simplest(attempts, current, bench.scale)
    if not current.effects and (best is None or not _done(base, best)):
        again = [_roughly(bench, one) for one in screened.values() if _bends(one)]
        attempts = _finished(bench, [*attempts, *again])
        best = _simplest(attempts, current, bench.scale)
    if best is None or not worth_adding(current, best, base):
        return Round(current, shares, tuple(attempts), current, ())
    return Round(current, shares, tuple(attempts), best, _tied(current, best, attempts))


def _reduced(bench: Bench, attempts: Sequence[Attempt]) -> list[Attempt]:
    """The attempts, and a simpler one of its family beside each that is more than it needs to be.

    A fit with more values to move may find its way where the simpler one did not.
    """
    found = list(attempts)
    for a in attempts:
        effect = a.effects[-1]
        source, given = thresholds.INHERITED.get(effect.name, ("", {}))
        simpler = next((o for o in attempts if o.effects[-1].name == source), None)
        if simpler is None or thresholds.large_enough(effect, a.values, bench.scale):
            continue
        back = {f"{source}.{of}": a.values[f"{effect.name}.{to}"] for of, to in given.items()}
        row = simpler.fitted.predictor.row(a.values | back)
        found.append(bench.attempt(simpler.effects, row[None, :], FIRST_ROUNDS))
    return found


def _finished(bench: Bench, attempts: Sequence[Attempt]) -> list[Attempt]:
    """The best attempt with each effect, those that lead fitted to the end, the best first."""
    each: dict[str, Attempt] = {}
    for a in sorted(attempts, key=lambda a: a.fit_J):
        each.setdefault(a.effects[-1].name, a)
    # What is far behind after a few rounds is not worth more.
    leading = list(each.values())
    leading[:FINISHED] = [bench.further(a) for a in leading[:FINISHED]]
    return sorted(leading, key=lambda a: a.rank_J)


def _done(base: Attempt, best: Attempt) -> bool:
    """Whether no other effect has to be looked for."""
    if max(base.rank_J, best.rank_J) < thresholds.GAP**2:
        return True
    return closure(base.rank_J, best.rank_J) > thresholds.DONE


def _bends(one: Screened) -> bool:
    """Whether an effect may act so unlike a small one that no direction shows it."""
    bends = {Port.CABLE, Port.EYELET} & set(one.effect.ports())
    return bool(bends or is_limit(one.effect)) and one.reach >= thresholds.SHOWN


def _roughly(bench: Bench, one: Screened) -> Attempt:
    """The model as given with an effect of several sizes, each record's zero put right."""
    predictor = one.predictor
    rows = np.repeat(predictor.start[None, :], ROUGH.size, axis=0)
    for n, f in enumerate(predictor.free):
        if f.owner != one.effect.name or f.neutral is None:
            continue
        sizes = f.neutral + ROUGH * (f.start - f.neutral)
        if is_limit(one.effect):
            sizes = f.start * np.linspace(1.2, 0.5, ROUGH.size)
        rows[:, n] = np.clip(sizes, f.low, f.high)
    for most in (4, 3):  # some only find their zeros from near
        rows = bench.best_starts(predictor, bench.placed(predictor, rows), most)
    return bench.attempt((one.effect,), rows, FIRST_ROUNDS)


def _with(bench: Bench, current: Attempt, one: Screened, others: Sequence[Attempt]) -> Attempt:
    """The current model with one more effect, fitted from the starts that its screening found.

    Args:
        bench: Model and records.
        current: The current model.
        one: The effect's screening.
        others: Attempts with other effects; a simpler one of its family is begun with, too.
    """
    effects = (*current.effects, one.effect)
    predictor = bench.predictor(effects)
    rows = []
    for row in one.starts:
        values = one.predictor.values(row)
        if current.effects:  # its screening was at the base model
            values = {n: v for n, v in values.items() if n.startswith(f"{one.effect.name}.")}
        rows.append(predictor.row(current.values | values))
    source, _ = thresholds.INHERITED.get(one.effect.name, ("", {}))
    simpler = next((a for a in others if a.effects[-1].name == source), None)
    if simpler is not None:
        rows[1:] = _inherited(bench, predictor, one, simpler)
    return bench.attempt(effects, np.array(rows), FIRST_ROUNDS)


def _inherited(
    bench: Bench, predictor: Predictor, one: Screened, simpler: Attempt
) -> list[FloatArray]:
    """The best starts from the fit of a simpler member of the family."""
    name, declared = one.effect.name, one.effect.parameters()
    source, given = thresholds.INHERITED[name]
    own = {f"{name}.{to}": simpler.values[f"{source}.{of}"] for of, to in given.items()}
    sizes = [n for n, p in declared.items() if p.neutral is not None and n not in given.values()]
    own |= {f"{name}.{n}": declared[n].neutral or 0.0 for n in sizes}
    grids = {n: values for n, values in one.grids.items() if n not in given.values()}
    shapes = [dict(zip(grids, v, strict=True)) for v in itertools.product(*grids.values())]
    rows = np.array(
        [
            predictor.row(simpler.values | own | {f"{name}.{n}": v for n, v in shape.items()})
            for shape in shapes
        ]
    )
    for size in sizes:
        place = next(n for n, f in enumerate(predictor.free) if f.name == f"{name}.{size}")
        # As large as the size inherited is: a law that is bent shows its direction.
        step = SWITCHED * abs(simpler.values[f"{source}.{next(iter(given))}"])
        rows = bench.switched_on(predictor, rows, place, step)
    return list(bench.best_starts(predictor, rows))


def worth_adding(before: Attempt, after: Attempt, base: Attempt) -> bool:
    """Whether a model is so much better, on both splits, that what it adds is there.

    Args:
        before: The model so far.
        after: The same with one more effect.
        base: The model without effects.
    """
    least = thresholds.FIRST
    enough = thresholds.GAP if before.effects else thresholds.NOTHING
    if math.sqrt(max(before.rank_J, before.fit_J)) < enough:
        return False
    if before.effects:
        little = before.rank_J < thresholds.LITTLE * base.rank_J
        much_left = math.sqrt(after.rank_J) > thresholds.INCOMPLETE
        least = thresholds.CLOSURE if little or much_left else thresholds.FURTHER
    closed = [_closed(before.rank_J, after.rank_J), _closed(before.fit_J, after.fit_J)]
    gained = float((before.squares - after.squares).sum())
    return min(closed) >= least and gained >= thresholds.SIGNIFICANT_GAIN


def _closed(before_J: float, after_J: float) -> float:
    """Share closed of what is above the floor, or of all there is where that is below it."""
    return closure(before_J, after_J) if before_J > 1.0 else 1.0 - after_J / before_J


def better(one: Attempt, other: Attempt) -> float:
    """By how many standard errors one model's squares are below the other's, block by block."""
    gained = other.squares - one.squares
    total = float(gained.sum())
    return total / max(float(np.sqrt(np.sum(gained**2))), 1e-300)


def _family(name: str) -> tuple[str, ...]:
    return next((family for family in thresholds.FAMILIES if name in family), (name,))


def _simplest(
    attempts: Sequence[Attempt], base: Attempt, scale: thresholds.Scale
) -> Attempt | None:
    """The best attempt that matters, or a simpler one of its family that does as well."""
    for best in attempts:
        family = _family(best.effects[-1].name)
        simpler = [
            a
            for name in family[: family.index(best.effects[-1].name)]
            for a in attempts
            if a.effects[-1].name == name
        ]
        kept = next(
            (n for n, a in enumerate(simpler) if _as_good(a, best) or _well(a, base, scale)),
            len(simpler),
        )
        # What is too small to be told from a simpler member of the family is that one.
        for a in reversed([*simpler, best][: kept + 1]):
            if thresholds.large_enough(a.effects[-1], a.values, scale):
                return a
    return None


def _well(simpler: Attempt, base: Attempt, scale: thresholds.Scale) -> bool:
    """Whether a member of a family that is more than the first of it does well enough."""
    effect = simpler.effects[-1]
    return (
        _family(effect.name)[0] != effect.name
        and thresholds.large_enough(effect, simpler.values, scale)
        and closure(base.rank_J, simpler.rank_J) >= thresholds.WELL
    )


def _as_good(simpler: Attempt, other: Attempt) -> bool:
    """Whether a simpler model leaves hardly more."""
    return (
        simpler.rank_J <= thresholds.SIMPLER * other.rank_J
        or simpler.fit_J <= thresholds.SIMPLER * other.fit_J
    )


def _tied(before: Attempt, best: Attempt, attempts: Sequence[Attempt]) -> tuple[str, ...]:
    """Slugs of other families that the rank split cannot tell from the best."""
    reached = closure(before.rank_J, best.rank_J)
    return tuple(
        a.effects[-1].name
        for a in attempts
        if a.effects[-1].name not in _family(best.effects[-1].name)
        and closure(before.rank_J, a.rank_J) > reached - thresholds.TIE
        and a.rank_J <= thresholds.ALIKE * max(best.rank_J, 1.0)
        and better(best, a) < thresholds.SIGNIFICANT
    )


def _record(owner: str) -> int | None:
    """Number of the record that a free value belongs to, or None."""
    return int(owner.removeprefix("record ")) if owner.startswith("record ") else None
