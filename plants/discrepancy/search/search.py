"""The search for missing effects: screen, fit jointly, rank on data not fitted, add, repeat."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from plants.discrepancy.search import thresholds
from plants.discrepancy.search.attempts import (
    bends,
    finished,
    reduced,
    roughly,
    with_one_more,
)
from plants.discrepancy.search.bench import Attempt, Bench, Numbers
from plants.discrepancy.search.rivals import beaten_by
from plants.discrepancy.search.score import (
    closure,
    does,
    family_of,
    leaves_a_gap,
    simplest,
    tied,
    worth_adding,
)
from plants.discrepancy.search.screen import Background, Screened, Suggest, orthonormal, screen
from plants.effects import Effect

SCREENED = 12_000
"""Entries that directions are compared over."""


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """One round of the search.

    Attributes:
        before: The model it began with.
        screened: Share of the residual explained in each effect's direction, by slug.
        attempts: What was fitted, best first.
        taken: What it ended with; `before` where nothing was worth adding.
        tied: Slugs that did as well as the one taken and are of another family, best first.
        rivals: Titles of laws without a name that did better than a named one, by its slug.
    """

    before: Attempt
    screened: Mapping[str, float]
    attempts: tuple[Attempt, ...]
    taken: Attempt
    tied: tuple[str, ...] = ()
    rivals: Mapping[str, str] = field(default_factory=dict)


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
    screened = _screened(bench, effects, seen)
    rounds: list[Round] = []
    current = base
    while len(rounds) < thresholds.DEEPEST:
        looked = screened
        if rounds and leaves_a_gap(current):
            # In the directions they have without the effects so far: those are soon worked out.
            seen = [_background(bench, current, suggest)]
            looked = _screened(bench, effects, seen)
        rounds.append(_round(bench, base, current, looked, seen))
        if rounds[-1].taken is current:
            break
        current = rounds[-1].taken
    return Found(base, _without_needless(bench, base, rounds), screened)


def _without_needless(bench: Bench, base: Attempt, rounds: list[Round]) -> tuple[Round, ...]:
    """The rounds without one whose effect a later one does as well: what was there was not it."""
    taken = [one for one in rounds if one.taken is not one.before]
    if len(taken) < thresholds.DEEPEST:
        return tuple(rounds)
    first, _, last = taken
    effects = (*first.taken.effects, last.taken.effects[-1])
    row = bench.predictor(effects).row(last.taken.values)
    rest = bench.attempt(effects, row[None, :])
    if worth_adding(rest, last.taken, base):
        return tuple(rounds)
    return (first, replace(last, before=first.taken, taken=rest))


def _screened(
    bench: Bench, effects: Sequence[type[Effect]], seen: Sequence[Background]
) -> dict[str, Screened]:
    """Each effect's direction, by slug."""
    return {e.name: screen(e, bench.predictor((e,)), seen) for e in effects}


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
    # A product over many entries is as well known from some of them.
    some = slice(None, None, max(1, fitted.entries.size // SCREENED))
    entries, residual = fitted.entries[some], fitted.residuals[some]
    moves = fitted.moved if moves is None else moves
    basis = orthonormal(fitted.predictor.linearise(fitted.values, moves, entries)[1].T)
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
    seen: Sequence[Background],
) -> Round:
    """Fits the most promising effects, and takes the best where it is worth adding."""
    there = {member for e in current.effects for member in family_of(e.name)}
    shares = {name: one.cosine2 for name, one in screened.items() if name not in there}
    if not leaves_a_gap(current):
        return Round(current, shares, (), current)
    many = thresholds.SHORTLIST_FURTHER if current.effects else thresholds.SHORTLIST
    promising = [n for n in sorted(shares, key=lambda n: -shares[n]) if shares[n] > 0.0][:many]
    attempts: list[Attempt] = []
    for name in sorted(shares, key=lambda n: family_of(n).index(n)):
        if _is_tried(name, promising, current, attempts):
            attempts.append(with_one_more(bench, current, screened[name], attempts))
    attempts = finished(bench, base, reduced(bench, attempts))
    best = simplest(attempts, current, bench.scale)
    if not current.effects and (best is None or not does(base, best)):
        again = [roughly(bench, one.effect) for one in screened.values() if bends(one)]
        attempts = finished(bench, base, [*attempts, *again])
        best = simplest(attempts, current, bench.scale)
    if best is None or not worth_adding(current, best, base):
        return Round(current, shares, tuple(attempts), current)
    rival = beaten_by(bench, current, best, seen)
    if rival is not None:
        beaten = {best.effects[-1].name: rival}
        return Round(current, shares, tuple(attempts), current, rivals=beaten)
    return Round(current, shares, tuple(attempts), best, tied(current, best, attempts))


def _is_tried(
    name: str, promising: Sequence[str], current: Attempt, attempts: Sequence[Attempt]
) -> bool:
    """Whether an effect is fitted: its direction says so, or its family.

    Calibrations that make up for a law that sticks hide its direction: the first of a family is
    always tried, and the others where it helps.
    """
    family = family_of(name)
    if set(family) & set(promising):
        return True
    if name == family[0]:
        return len(family) > 1 and not current.effects
    first = next((a for a in attempts if a.effects[-1].name == family[0]), None)
    return first is not None and closure(current.fit_J, first.fit_J) > thresholds.FIRST
