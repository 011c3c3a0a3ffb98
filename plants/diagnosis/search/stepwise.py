"""The search for missing effects: screen, fit jointly, rank on data not fitted, add, repeat."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from plants.diagnosis.search import thresholds
from plants.diagnosis.search.alternative_laws import better_alternative, is_closed
from plants.diagnosis.search.cable_block import block_of
from plants.diagnosis.search.candidate_fits import (
    coarse_fit,
    finished,
    fit_added_effect,
    may_be_nonlinear,
    reduced,
)
from plants.diagnosis.search.model_comparison import (
    at_bound,
    explained_fraction,
    family_of,
    indistinguishable,
    is_sufficient,
    leaves_a_gap,
    open_block,
    select_flexible,
    select_parsimonious,
    worth_adding,
    worth_adding_there,
)
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.score_context import InitialGuesses, ScoreContext
from plants.diagnosis.search.score_test import ScreeningResult, screen
from plants.diagnosis.search.screening import (
    background,
    has_resonance,
    screen_effects,
    screened_further,
)
from plants.effects import Effect


@dataclass(frozen=True, slots=True, eq=False)
class SearchRound:
    """One round of the search.

    Attributes:
        before: The model it began with.
        screened: Share of the residual explained in each effect's direction, by slug.
        attempts: What was fitted, best first.
        taken: What it ended with; `before` where nothing was worth adding.
        tied: Slugs that did as well as the one taken and are of another family, best first.
        rivals: Titles of laws without a name that did better than a named one, by its slug.
    """

    before: CandidateFit
    screened: Mapping[str, float]
    attempts: tuple[CandidateFit, ...]
    taken: CandidateFit
    tied: tuple[str, ...] = ()
    rivals: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """What the search found.

    Attributes:
        base: The base model.
        rounds: Round by round; the last one added nothing, unless there were as many as may be.
        screened: Each effect's direction from the base model, by slug.
        stages: The models with one effect after the other, of all that were worth adding.
    """

    base: CandidateFit
    rounds: tuple[SearchRound, ...]
    screened: Mapping[str, ScreeningResult]
    stages: tuple[CandidateFit, ...]

    @property
    def best(self) -> CandidateFit:
        """The model with all effects that were worth adding."""
        return self.stages[-1] if self.stages else self.base


def search(
    bench: ModelFitter,
    base: CandidateFit,
    effects: Sequence[type[Effect]],
    suggest: InitialGuesses,
) -> SearchResult:
    """Looks for the effects that are missing, one after the other.

    Args:
        bench: Model and records.
        base: The base model's fit.
        effects: The effects to choose from.
        suggest: What the data suggest for their parameters.
    """
    seen = [background(bench, base, suggest)]
    if base.fit_J > thresholds.DISTORTED**2:
        nobody: frozenset[str] = frozenset()
        given = bench.attempt((), bench.base.start[None, :], owners=nobody)
        there = background(bench, given, suggest, bench.moves(bench.base))
        # Where calibrations had to move far for good, the model as given is no place to look from.
        seen = [there] if given.fit_J < thresholds.NEAR * base.fit_J else [*seen, there]
    first = screen_effects(bench, effects, seen)
    rounds: list[SearchRound] = []
    current = base
    while len(rounds) < thresholds.DEEPEST:
        looked = first
        if rounds and leaves_a_gap(current):
            # In the directions they have without the effects so far: those are soon worked out.
            recalled = _recalled(suggest, rounds[0].attempts)
            seen = [background(bench, current, recalled)]
            looked = screened_further(bench, effects, seen, current, recalled)
        one = _round(bench, base, current, looked, seen)
        again = _refit_without_last(bench, base, one)
        if again is not None:
            if rounds[-1].taken is current:
                rounds[-1] = _ended(rounds[-1], again)
            current = again
            continue
        rounds.append(one)
        if one.taken is current:
            break
        current = select_flexible(one.taken, one.attempts)
    if current.effects and len(current.effects) < thresholds.DEEPEST:
        rounds += _mode_beside(bench, current, effects, suggest)
    if current is base and rounds:
        rounds = [*_pair(bench, base, rounds[0], effects, suggest)] or rounds
    kept = _drop_redundant(bench, base, rounds)
    stages = tuple(one.taken for one in kept if one.taken is not one.before)
    return SearchResult(base, kept, first, _families_again(bench, base, first, stages))


def _recalled(suggest: InitialGuesses, attempts: Sequence[CandidateFit]) -> InitialGuesses:
    """What the data suggest, and the frequencies that effects were fitted with as the first one.

    A narrow resonance lies between those that are tried, and its line shows less beside what is
    left by another's law.
    """
    found = {
        f"{effect.name}.{name}": a.values[f"{effect.name}.{name}"]
        for a in attempts
        for effect in a.effects
        for name, p in effect.parameters().items()
        if p.unit == "Hz"
    }
    return lambda key: [*suggest(key), *([found[key]] if key in found else [])]


def _families_again(
    bench: ModelFitter,
    base: CandidateFit,
    screened: Mapping[str, ScreeningResult],
    stages: tuple[CandidateFit, ...],
) -> tuple[CandidateFit, ...]:
    """The stages with each family's member chosen again where more was added after it.

    What was missing then bent the law: its member was chosen under what others explain now. A law
    that was only gone on with has no name of its own.
    """
    named = {one.effects[-1] for one in stages}
    for effect in stages[-1].effects[:-1] if stages else ():
        family = [screened[n] for n in family_of(effect.name) if n in screened]
        if len(family) < 2:
            continue
        best = stages[-1]
        rest = tuple(e for e in best.effects if e is not effect)
        held = _from(bench, rest, best, rounds=0)
        attempts = [_from(bench, (*rest, effect), best)]
        for one in family:  # its own, too: the others' fits may lead where it has not been
            attempts.append(fit_added_effect(bench, held, one, attempts))
        attempts = finished(bench, base, reduced(bench, attempts))
        again = select_parsimonious(attempts, held, bench.scale)
        if again is None:
            continue
        better = max(again.rank_J - best.rank_J, again.fit_J - best.fit_J) < 0.0
        if better or effect not in named:
            stages = (*(_from(bench, rest[:n], best) for n in range(1, len(best.effects))), again)
    return stages


def _from(
    bench: ModelFitter, effects: tuple[type[Effect], ...], best: CandidateFit, rounds: int = 15
) -> CandidateFit:
    """A model with some of another's effects, fitted from its values."""
    row = bench.predictor(effects).row(best.values)
    return bench.attempt(effects, row[None, :], rounds)


def _refit_without_last(
    bench: ModelFitter, base: CandidateFit, one: SearchRound
) -> CandidateFit | None:
    """The model before a round, fitted on from where the effect added led.

    A fit that was stuck goes on when one more value moves: what was added is not there.

    Returns:
        None where the effect added is worth adding to that, too.
    """
    before, taken = one.before, one.taken
    if taken is before or not before.effects:
        return None
    again = _from(bench, before.effects, taken)
    stuck = again.fit_J < thresholds.STUCK * before.fit_J
    return again if stuck and not _is_worth(again, taken, base) else None


def _ended(one: SearchRound, taken: CandidateFit) -> SearchRound:
    """The same round with another fit of what it ended with."""
    attempts = tuple(taken if a is one.taken else a for a in one.attempts)
    return replace(one, attempts=attempts, taken=taken)


def _is_worth(before: CandidateFit, after: CandidateFit, base: CandidateFit) -> bool:
    """Whether the last effect of a model is worth adding to the others."""
    block = block_of(after.effects[-1])
    return worth_adding(before, after, base) or (
        open_block(before) == block and worth_adding_there(before, after, block)
    )


def _pair(
    bench: ModelFitter,
    base: CandidateFit,
    first: SearchRound,
    effects: Sequence[type[Effect]],
    suggest: InitialGuesses,
) -> tuple[SearchRound, ...]:
    """Two rounds, of effects that do together what neither does alone; none if there are none."""
    leading = [
        family_of(a.effects[-1].name) for a in sorted(first.attempts, key=lambda a: a.fit_J)
    ]
    pairs = []
    for family in list(dict.fromkeys(leading))[: thresholds.LEADING]:
        members = [a for a in first.attempts if a.effects[-1].name in family]
        # The most it can be it may be for what else is missing: beside that it is less.
        one = select_parsimonious(members, base, bench.scale) or members[0]
        if explained_fraction(base.fit_J, one.fit_J) < thresholds.FIRST:
            continue
        seen = [background(bench, one, suggest)]
        looked = screened_further(bench, effects, seen, one, suggest)
        second = _round(bench, base, one, looked, seen)
        # A law without a name did better alone: with what else is missing none may need to.
        beaten = one.effects[-1].name in first.rivals and not is_closed(second.taken)
        if second.taken is one or at_bound(second.taken, one.effects[-1]) or beaten:
            continue
        if _does_together(bench, base, second.taken):
            pairs.append((replace(first, taken=one), second))
    return min(pairs, key=lambda pair: pair[1].taken.rank_J, default=())


def _mode_beside(
    bench: ModelFitter,
    current: CandidateFit,
    effects: Sequence[type[Effect]],
    suggest: InitialGuesses,
) -> list[SearchRound]:
    """A round with a mode beside effects that leave no gap, or none.

    What rings fills a narrow band, which a mean over everything hides; its direction shows it.
    """
    if leaves_a_gap(current):
        return []
    there = {member for e in current.effects for member in family_of(e.name)}
    further = {e.name: e for e in effects if e.name not in there}
    seen = [background(bench, current, suggest)]

    def looked(e: type[Effect]) -> ScreeningResult:
        return screen(e, bench.predictor((*current.effects, e)), seen)

    modes = {name: looked(e) for name, e in further.items() if has_resonance(e)}
    shown = [n for n, one in modes.items() if one.screening_R2 >= 0.5 * thresholds.NARROW]
    wanted = {m for name in shown for m in family_of(name) if m in further}
    attempts: list[CandidateFit] = []
    for name in sorted(wanted, key=lambda n: family_of(n).index(n)):
        one = modes[name] if name in modes else looked(further[name])
        attempts.append(bench.refine(fit_added_effect(bench, current, one, attempts)))
    attempts.sort(key=lambda a: a.rank_J)
    best = select_parsimonious(attempts, current, bench.scale)
    if best is None or not has_resonance(best.effects[-1]):
        return []
    left = max(best.rank_J / current.rank_J, best.fit_J / current.fit_J)
    if left > 1.0 - thresholds.NARROW:
        return []
    shares = {name: one.screening_R2 for name, one in modes.items()}
    return [SearchRound(current, shares, tuple(attempts), best)]


def _does_together(bench: ModelFitter, base: CandidateFit, pair: CandidateFit) -> bool:
    """Whether two effects leave next to nothing, and the second alone does not."""
    splits = (base.fit_J, pair.fit_J), (base.rank_J, pair.rank_J)
    if max(after for _, after in splits) > thresholds.GAP**2:
        return False
    if min(explained_fraction(*split) for split in splits) < thresholds.CLOSURE_OF_MUCH:
        return False
    return worth_adding(_from(bench, pair.effects[1:], pair), pair, base)


def _drop_redundant(
    bench: ModelFitter, base: CandidateFit, rounds: list[SearchRound]
) -> tuple[SearchRound, ...]:
    """The rounds without one whose effect a later one does as well: what was there was not it."""
    taken = [one for one in rounds if one.taken is not one.before]
    if len(taken) < thresholds.DEEPEST:
        return tuple(rounds)
    first, _, last = taken
    rest = _from(bench, (last.taken.effects[0], last.taken.effects[-1]), last.taken)
    if worth_adding(rest, last.taken, base):
        return tuple(rounds)
    return (first, replace(last, before=first.taken, taken=rest))


def _round(
    bench: ModelFitter,
    base: CandidateFit,
    current: CandidateFit,
    screened: Mapping[str, ScreeningResult],
    seen: Sequence[ScoreContext],
) -> SearchRound:
    """Fits the most promising effects, and takes the best where it is worth adding."""
    there = {member for e in current.effects for member in family_of(e.name)}
    shares = {name: one.screening_R2 for name, one in screened.items() if name not in there}
    if not leaves_a_gap(current):
        return SearchRound(current, shares, (), current)
    many = thresholds.SHORTLIST_FURTHER if current.effects else thresholds.SHORTLIST
    promising = [n for n in sorted(shares, key=lambda n: -shares[n]) if shares[n] > 0.0][:many]
    attempts: list[CandidateFit] = []
    for name in sorted(shares, key=lambda n: family_of(n).index(n)):
        if _is_tried(name, promising, current, attempts):
            attempts.append(fit_added_effect(bench, current, screened[name], attempts))
    attempts = finished(bench, base, reduced(bench, attempts))
    best = select_parsimonious(attempts, current, bench.scale)
    if not current.effects and (best is None or not is_sufficient(base, best)):
        again = [
            coarse_fit(bench, one.effect) for one in screened.values() if may_be_nonlinear(one)
        ]
        again += [
            fit_added_effect(bench, current, one, again)
            for one in screened.values()
            if one.effect.extends is not None
            and one.effect.extends.name not in family_of(one.effect.name)
        ]
        attempts = finished(bench, base, [*attempts, *again])
        best = select_parsimonious(attempts, current, bench.scale)
    if best is None or not worth_adding(current, best, base, attempts):
        best = _by_its_block(bench, current, attempts)
    if best is None:
        return SearchRound(current, shares, tuple(attempts), current)
    # Further effects may have been looked at in their own block.
    share = 0.0 if current.effects else shares[best.effects[-1].name]
    rival = better_alternative(bench, current, best, seen, share)
    if rival is not None:
        beaten = {best.effects[-1].name: rival}
        return SearchRound(current, shares, tuple(attempts), current, rivals=beaten)
    return SearchRound(
        current, shares, tuple(attempts), *_likeliest(bench, current, best, attempts)
    )


def _likeliest(
    bench: ModelFitter, current: CandidateFit, best: CandidateFit, attempts: Sequence[CandidateFit]
) -> tuple[CandidateFit, tuple[str, ...]]:
    """The best, or of those as good the first that an owner would not know of; the others."""
    alike = indistinguishable(current, best, attempts, bench.scale)
    rest = [a for a in attempts if a.effects[-1].name in alike]
    if not best.effects[-1].known_apart or not rest:
        return best, alike
    name = best.effects[-1].name
    return rest[0], tuple(name if n == alike[0] else n for n in alike)


def _by_its_block(
    bench: ModelFitter, current: CandidateFit, attempts: Sequence[CandidateFit]
) -> CandidateFit | None:
    """The effect that does the most in a block without one, if it is worth adding."""
    block = open_block(current)
    if block is None:
        return None
    ranked = sorted(
        (a for a in attempts if block_of(a.effects[-1]) == block),
        key=lambda a: float(getattr(a.rank_blocks, block)),
    )
    best = select_parsimonious(ranked, current, bench.scale)
    return best if best is not None and worth_adding_there(current, best, block) else None


def _is_tried(
    name: str, promising: Sequence[str], current: CandidateFit, attempts: Sequence[CandidateFit]
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
    return first is not None and explained_fraction(current.fit_J, first.fit_J) > thresholds.FIRST
