"""How attempts compare: what one closes, what it is better by, and whether it is worth adding."""

import math
from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.search import thresholds
from plants.diagnosis.search.cable_block import Block, block_of
from plants.diagnosis.search.model_fitter import CandidateFit
from plants.effects import EFFECTS, Effect, RecordScale, Role

BOUND = 1e-6
"""A value this near to a bound, relative to it, is at it."""


def explained_fraction(before_J: float, after_J: float, floor_J: float = 1.0) -> float:
    """Share of the power above the floor that was closed; 1 where all of it was.

    Args:
        before_J: Mean square of the whitened residuals before.
        after_J: After.
        floor_J: What noise and allowance alone give.
    """
    above = before_J - floor_J
    return (before_J - max(after_J, floor_J)) / above if above > 0.0 else 0.0


def leaves_a_gap(attempt: CandidateFit) -> bool:
    """Whether a model leaves anything that another effect could be added for."""
    return _gapes(attempt) or open_block(attempt) is not None


def open_block(attempt: CandidateFit) -> Block | None:
    """The block in which there is a gap that the effects so far have no part in, or None.

    Without an effect the cable and gauge block is as clean as before; the drum's is as soon as
    the effects of cable and gauge leave nothing in theirs.
    """
    if not attempt.effects:
        return None
    acting = set(map(block_of, attempt.effects))
    splits = attempt.fit_blocks, attempt.rank_blocks
    if acting == {"drum"}:
        return "cable" if max(s.cable for s in splits) > thresholds.CLOSED**2 else None
    if acting == {"cable"} and max(s.cable for s in splits) <= thresholds.CLOSED**2:
        return "drum" if max(s.drum for s in splits) >= thresholds.NOTHING**2 else None
    return None


def _gapes(attempt: CandidateFit) -> bool:
    return _gap(attempt) > (thresholds.CLOSED if attempt.effects else thresholds.NOTHING)


def _gap(attempt: CandidateFit) -> float:
    return math.sqrt(max(attempt.rank_J, attempt.fit_J))


def is_sufficient(base: CandidateFit, best: CandidateFit) -> bool:
    """Whether an attempt does so well that no other first effect has to be looked for."""
    if max(base.rank_J, best.rank_J) < thresholds.GAP**2:
        return True
    return explained_fraction(base.rank_J, best.rank_J) > thresholds.DONE


def worth_adding(
    before: CandidateFit,
    after: CandidateFit,
    base: CandidateFit,
    others: Sequence[CandidateFit] = (),
) -> bool:
    """Whether a model is so much better, on both splits, that what it adds is there.

    Args:
        before: The model so far.
        after: The same with one more effect.
        base: The model without effects.
        others: What else was tried in its stead, if that is known.
    """
    if not _gapes(before):
        return False
    least, small = thresholds.FIRST, _gap(before) < thresholds.GAP
    if before.effects:
        little = before.rank_J < thresholds.LITTLE * base.rank_J and not _stands_out(
            before, after, others
        )
        much_left = math.sqrt(after.rank_J) > thresholds.INCOMPLETE
        least = thresholds.CLOSURE if small or little or much_left else thresholds.FURTHER
    closed = [_closed(before.rank_J, after.rank_J), _closed(before.fit_J, after.fit_J)]
    gained = float((before.squares - after.squares).sum())
    if before.effects and small and not is_significantly_better(after, before):
        return False
    return min(closed) >= least and gained >= thresholds.SIGNIFICANT_GAIN


def _stands_out(before: CandidateFit, after: CandidateFit, others: Sequence[CandidateFit]) -> bool:
    """Whether no effect of another family closes nearly as much."""
    family = family_of(after.effects[-1].name)
    rest = [_closed(before.rank_J, a.rank_J) for a in others if a.effects[-1].name not in family]
    closed = _closed(before.rank_J, after.rank_J)
    return bool(rest) and max(rest) <= thresholds.SECOND * closed


def worth_adding_there(before: CandidateFit, after: CandidateFit, block: Block) -> bool:
    """Whether one more effect is there by what it does in a block without one.

    There it is judged as if it were alone, whatever the others' laws leave in their own block.

    Args:
        before: The model so far.
        after: The same with one more effect.
        block: The block, see `open_block`.
    """
    closed = [
        _closed(getattr(was, block), getattr(now, block))
        for was, now in (
            (before.rank_blocks, after.rank_blocks),
            (before.fit_blocks, after.fit_blocks),
        )
    ]
    gained = float((before.squares - after.squares).sum())
    better_fit = after.fit_J < before.fit_J and gained >= thresholds.SIGNIFICANT_GAIN
    return better_fit and min(closed) >= thresholds.FIRST


def _closed(before_J: float, after_J: float) -> float:
    """Share closed of what is above the floor, or of all there is where that is below it."""
    return explained_fraction(before_J, after_J) if before_J > 1.0 else 1.0 - after_J / before_J


def z_score(one: CandidateFit, other: CandidateFit) -> float:
    """By how many standard errors one model's squares are below the other's, block by block."""
    return _errors(other.squares - one.squares)


def is_significantly_better(one: CandidateFit, other: CandidateFit) -> bool:
    """Whether one model does better for sure, on the rank split or over both.

    Of two laws with as many numbers the fit split tells as much, and is much longer; so it does
    of one more effect that closes the most on the rank split, too.
    """
    return max(z_score(one, other), _likelier(one, other)) >= thresholds.SIGNIFICANT


def _errors(gained: FloatArray) -> float:
    total = float(gained.sum())
    return total / max(float(np.sqrt(np.sum(gained**2))), 1e-300)


def family_of(name: str) -> tuple[str, ...]:
    """Slugs of the family an effect belongs to, the simplest first; itself alone without one."""
    family = EFFECTS[name].family if name in EFFECTS else ""
    members = [e for e in EFFECTS.values() if family and e.family == family]
    return tuple(e.name for e in sorted(members, key=lambda e: len(e.parameters()))) or (name,)


def select_parsimonious(
    attempts: Sequence[CandidateFit], base: CandidateFit, scale: RecordScale
) -> CandidateFit | None:
    """The best attempt that matters, or a simpler one of its family that does as well."""
    for best in attempts:
        family = family_of(best.effects[-1].name)
        simpler = [
            a
            for name in family[: family.index(best.effects[-1].name)]
            for a in attempts
            if a.effects[-1].name == name
        ]
        kept = next(
            (
                n
                for n, a in enumerate(simpler)
                if _will_do(simpler[: n + 1], best, scale) or _well(a, best, base, scale)
            ),
            len(simpler),
        )
        # What is too small to be told from a simpler member of the family is that one.
        for n, a in reversed(list(enumerate([*simpler, best][: kept + 1]))):
            told = _told(a, simpler[:n], base)
            large = thresholds.large_enough(a.effects[-1], a.values, scale, told=told)
            if large and not at_bound(a, a.effects[-1]):
                return a
    return None


def _told(attempt: CandidateFit, simpler: Sequence[CandidateFit], base: CandidateFit) -> bool:
    """Whether a member of a family closes enough for a name, and none of the simpler ones does."""
    closed = max((explained_fraction(base.rank_J, a.rank_J) for a in simpler), default=1.0)
    reached = explained_fraction(base.rank_J, attempt.rank_J)
    return closed < thresholds.CLOSURE and reached >= thresholds.CLOSURE_OF_MUCH


def select_flexible(taken: CandidateFit, attempts: Sequence[CandidateFit]) -> CandidateFit:
    """The member of an attempt's family to look further from: the one that leaves least.

    What the law named leaves for being simple would be taken for something else, or hide it: dry
    friction has a name of its own where it gives a little before it slips, and gives all the same.
    """
    family = family_of(taken.effects[-1].name)
    fuller = [a for a in attempts if a.effects[-1].name in family and not _as_good(taken, a)]
    return min(fuller, key=lambda a: a.fit_J, default=taken)


def at_bound(attempt: CandidateFit, effect: type[Effect]) -> bool:
    """Whether an effect is the most it can be: then it stands for something else.

    Its size is, or a wave over the angle is as long as may be, which then is no ripple.
    """
    predictor = attempt.fitted.predictor
    waves = {f"{effect.name}.{name}" for name in effect.named(Role.PERIODS)}
    for f, value in zip(predictor.free, attempt.fitted.values.tolist(), strict=True):
        if f.owner == effect.name and (f.neutral is not None or f.name in waves):
            # Relative to themselves: a limit's range is a million times where it lies.
            at = [edge for edge in (f.low, f.high) if math.isclose(value, edge, rel_tol=BOUND)]
            if at and f.neutral not in at:
                return True
    return False


def _well(
    simpler: CandidateFit, other: CandidateFit, base: CandidateFit, scale: RecordScale
) -> bool:
    """Whether a member of a family that is more than the first of it does well enough.

    It does not where another closes what it leaves as surely as one effect more would have to.
    """
    effect = simpler.effects[-1]
    incomplete = math.sqrt(simpler.rank_J) > thresholds.INCOMPLETE
    if (
        incomplete
        and explained_fraction(simpler.rank_J, other.rank_J) >= thresholds.CLOSURE_OF_MUCH
    ):
        return False
    return (
        family_of(effect.name)[0] != effect.name
        and thresholds.large_enough(effect, simpler.values, scale)
        and explained_fraction(base.rank_J, simpler.rank_J) >= thresholds.WELL
    )


def _will_do(simpler: Sequence[CandidateFit], other: CandidateFit, scale: RecordScale) -> bool:
    """Whether the last of a family's simpler members need not give way to another.

    A law that is not quite the machine's leaves what any other takes off that is free to bend
    more. But one whose own part is too small to show stands for a simpler law yet, which had that
    to bend already: where that leaves a gap, the other has to be no more than likelier.
    """
    last = simpler[-1]
    if not _as_good(last, other):
        return False
    shows = thresholds.large_enough(last.effects[-1], last.values, scale)
    return shows or not _gapes(simpler[0]) or _likelier(other, last) < thresholds.LIKELIER


def _likelier(one: CandidateFit, other: CandidateFit) -> float:
    """Standard errors, over both splits, by which one model's squares are below the other's."""
    gained = other.squares - one.squares, other.fit_squares - one.fit_squares
    return _errors(np.concatenate(gained))


def _as_good(simpler: CandidateFit, other: CandidateFit) -> bool:
    """Whether a simpler model leaves hardly more."""
    return (
        simpler.rank_J <= thresholds.SIMPLER * other.rank_J
        and simpler.fit_J <= thresholds.SIMPLER * other.fit_J
    )


def indistinguishable(
    before: CandidateFit,
    best: CandidateFit,
    attempts: Sequence[CandidateFit],
    scale: RecordScale,
) -> tuple[str, ...]:
    """Slugs of other families that the records cannot tell from the best."""
    reached = explained_fraction(before.rank_J, best.rank_J)
    return tuple(
        a.effects[-1].name
        for a in attempts
        if a.effects[-1].name not in family_of(best.effects[-1].name)
        and explained_fraction(before.rank_J, a.rank_J) > reached - thresholds.TIE
        and a.rank_J <= thresholds.ALIKE * max(best.rank_J, 1.0)
        and not is_significantly_better(best, a)
        and thresholds.large_enough(a.effects[-1], a.values, scale)
    )
