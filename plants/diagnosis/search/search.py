"""The search for missing effects.

The best single one, pairs with it, each effect of a pair dropped or swapped for another of its
family. Every fit is kept; `decide` says which model is believed.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from plants.diagnosis.progress import Progress, portion, silent
from plants.diagnosis.result import ModelSummary
from plants.diagnosis.search.constants import CONSTANTS
from plants.diagnosis.search.decide import best_of, relative
from plants.diagnosis.search.model_fitter import (
    CandidateFit,
    ModelFitter,
    family_of,
    simpler_of,
)
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.diagnosis.search.score_context import ScoreContext
from plants.diagnosis.search.screening import ScreeningResult, screen
from plants.diagnosis.search.starts import coarse_fit, fit_added, may_be_nonlinear
from plants.effects import Effect, RecordScale, Role

BESIDE = 5
"""Further effects whose direction is looked at once more beside those there are, and as many laws
without a name as have one no worse."""
SHORTLIST = 5
"""Effects fitted jointly, by their direction."""
AIMED, AIMED_BESIDE = 0.5, 0.2
"""A law is fitted whose direction explains this share of what the best's does: on 22 development
seeds that of the effect hidden explained 0.76 or more, of a second effect 0.22 or more."""
DISTORTED = 16.0
"""Power left from which on directions are looked for from the model as given, too."""
LEADING, BEHIND = 4, 3.0
"""Fits that are finished, and ratio of powers left beyond which none is."""


@dataclass(eq=False)
class SearchResult:
    """All the fits of a search.

    Attributes:
        base: The base model.
        given: The model as given.
        fits: The best fit of each set of effects, by their slugs.
        screened: Each effect's direction from the base model, by slug.
        beside: Each further effect's direction beside the best single one.
    """

    base: CandidateFit
    given: CandidateFit
    fits: dict[frozenset[str], CandidateFit] = field(default_factory=dict)
    screened: dict[str, ScreeningResult] = field(default_factory=dict)
    beside: dict[str, ScreeningResult] = field(default_factory=dict)

    def add(self, fits: Iterable[CandidateFit]) -> None:
        """Keeps each fit that is the best of its effects."""
        for one in fits:
            if one.names not in self.fits or one.J < self.fits[one.names].J:
                self.fits[one.names] = one

    def summaries(self, fitter: ModelFitter) -> list[ModelSummary]:
        """Every model as a verdict is decided from, the base model first."""
        scale = fitter.scale
        return [summarise(one, scale) for one in (self.base, *self.fits.values())]

    def of(self, effects: int) -> list[CandidateFit]:
        """The fits with so many effects, the best first."""
        some = (f for f in self.fits.values() if len(f.effects) == effects)
        return sorted(some, key=lambda f: f.J)


def summarise(one: CandidateFit, scale: RecordScale) -> ModelSummary:
    """The properties of a fit that a decision rests on."""
    values, rank = one.values, sum(len(e.parameters()) for e in one.effects)
    return ModelSummary(
        names=one.names,
        families=frozenset(map(family_of, one.effects)),
        rank=rank,
        J=one.J,
        # A law without a name may stand for another where a value of it is at a bound.
        values=one.own_values if is_named(one) else rank,
        eligible=all(
            e.matters({n: values[f"{e.name}.{n}"] for n in e.parameters()}, scale)
            and not one.at_bound(e)
            for e in one.effects
        ),
        named=is_named(one),
        known_apart=any(e.known_apart for e in one.effects),
    )


def is_named(one: CandidateFit) -> bool:
    """Whether a model has no law without a name."""
    return not any(e in NAMELESS for e in one.effects)


def power(one: CandidateFit) -> float:
    """P: mean square of the whitened residuals, no less than the noise floor's."""
    return max(one.J, 1.0)


def search(
    fitter: ModelFitter,
    base: CandidateFit,
    effects: Sequence[type[Effect]],
    records: RecordScale,
    progress: Progress = silent,
) -> SearchResult:
    """Looks for the effects that are missing."""
    effects = list(effects)
    progress("screening effects", 0.0)
    found = SearchResult(base, fitter.given())
    nameless = [e for e in NAMELESS if fitter.model.unavailable(e) is None]
    seen = [ScoreContext.of(fitter, base, records)]
    found.screened = {e.name: screen(e, fitter.predictor((e,)), seen) for e in effects}
    best = max((s.screening_R2 for s in found.screened.values()), default=0.0)
    if base.J > DISTORTED and best < AIMED:
        # Base parameters may have bent far to make up for what is missing.
        seen.append(ScoreContext.of(fitter, found.given, records))
        found.screened = {
            name: s.merged(screen(s.effect, s.predictor, seen[1:]))
            for name, s in found.screened.items()
        }
    if power(base) <= CONSTANTS.nothing:
        return found
    unnamed = {e.name: screen(e, fitter.predictor((e,)), seen) for e in nameless}
    _fit_all(fitter, found, base, (found.screened, unnamed), portion(progress, 0.2, 0.6))
    single = _leading(fitter, found)
    if single is None or power(single) > 1.0 + (1.0 - CONSTANTS.named_share) * (power(base) - 1.0):
        _fit_rest(fitter, found)
        single = _leading(fitter, found)
    # A second effect is looked for beside one that explains something, and leaves something.
    some = 1.0 + CONSTANTS.named_share * (power(base) - 1.0)
    if single is None or power(single) > some:
        return found
    if CONSTANTS.nothing >= single.J:
        return found
    progress("screening second effects", 0.6)
    there = family_of(single.effects[0])
    rest = [e for e in effects if family_of(e) != there]
    found.beside = _screen_beside(fitter, [*rest, *nameless], single, records)
    unnamed = {e.name: found.beside.pop(e.name) for e in nameless}
    _fit_all(fitter, found, single, (found.beside, unnamed), portion(progress, 0.7, 0.95))
    _, *models = relative(found.summaries(fitter))
    # Whether an effect of it is of a size that matters shows after the moves.
    pair = best_of([m._replace(eligible=True) for m in models])
    if pair is not None and len(pair.names) == 2:
        progress("comparing pairs", 0.95)
        _moves(fitter, found, found.fits[pair.names])
    return found


def _leading(fitter: ModelFitter, found: SearchResult) -> CandidateFit | None:
    """The best of the named effects, with its family: one that could be believed, if there is."""
    named = [one for one in found.of(1) if is_named(one)]
    sized = [one for one in named if summarise(one, fitter.scale).eligible]
    families = {family_of(one.effects[0]) for one in (sized or named)[:1]}
    return next((one for one in named if family_of(one.effects[0]) in families), None)


def _fit_all(
    fitter: ModelFitter,
    found: SearchResult,
    current: CandidateFit,
    looked_at: tuple[dict[str, ScreeningResult], dict[str, ScreeningResult]],
    progress: Progress,
) -> None:
    """Fits the most promising effects with their families, and nameless laws that aim as well."""
    screened, nameless = looked_at
    ranked = sorted(screened.values(), key=lambda s: -s.screening_R2)
    best = max((s.screening_R2 for s in ranked), default=0.0)
    least_R2 = best * (AIMED_BESIDE if current.effects else AIMED)
    promising = [s for s in ranked if s.screening_R2 > least_R2][:SHORTLIST]
    families = {family_of(s.effect) for s in promising}
    if not current.effects:
        families |= {family_of(s.effect) for s in ranked if s.effect.resists and s.effect.family}
    chosen = [s for s in ranked if family_of(s.effect) in families]
    # The most promising family first, of it the simpler ones: others begin with their fit.
    aim = {family_of(s.effect): s.screening_R2 for s in reversed(chosen)}
    chosen.sort(key=lambda s: (-aim[family_of(s.effect)], _depth(s.effect), -s.screening_R2))
    chosen += [s for s in nameless.values() if s.screening_R2 >= AIMED * best]
    fits: list[CandidateFit] = []
    least = math.inf
    for n, one in enumerate(chosen):
        progress(f"fitting {one.effect.title}", n / len(chosen))
        # Beside a model that leaves nothing only those count that point the same way.
        if max(least, 1.0) <= CONSTANTS.floor and one.screening_R2 < AIMED * best:
            continue
        fitted = fit_added(fitter, current, one, _simpler(one.effect, fits), least=least)
        if least > fitted.J:
            fitted = fitter.refine(fitted, 40)
        fits.append(fitted)
        least = min(least, _least(fitter, [fitted]))
    found.add(_finished(fitter, fits))


def _depth(effect: type[Effect]) -> int:
    """Number of effects that an effect begins with, one within the other."""
    return 0 if effect.extends is None else 1 + _depth(effect.extends)


def _simpler(effect: type[Effect], fits: Sequence[CandidateFit]) -> CandidateFit | None:
    source = simpler_of(effect)
    return next((f for f in fits if source in f.names), None)


def _fit_rest(fitter: ModelFitter, found: SearchResult) -> None:
    """Fits effects whose direction may not show them."""
    fits = [
        coarse_fit(fitter, one.effect)
        for name, one in found.screened.items()
        if frozenset({name}) not in found.fits and may_be_nonlinear(one)
    ]
    found.add(_finished(fitter, fits, _least(fitter, found.of(1))))


def _least(fitter: ModelFitter, fits: Iterable[CandidateFit]) -> float:
    """J of the best of the fits that could be believed: no other stands in another's way."""
    scale = fitter.scale
    sized = (one for one in fits if is_named(one) and summarise(one, scale).eligible)
    return min((one.J for one in sized), default=math.inf)


def _finished(
    fitter: ModelFitter, fits: Sequence[CandidateFit], least: float = math.inf
) -> list[CandidateFit]:
    """The fits, those that lead fitted to the end."""
    ranked = sorted(fits, key=lambda f: f.J)
    done: list[CandidateFit] = []
    for one in ranked:
        limit = min(least, _least(fitter, done))
        limit = limit if math.isfinite(limit) else one.J
        near = BEHIND * limit > one.J and len(done) < LEADING
        done.append(fitter.refine(one, 40 if one is ranked[0] else 15) if near else one)
    return done


def _moves(fitter: ModelFitter, found: SearchResult, pair: CandidateFit) -> None:
    """Each effect of a pair dropped, and swapped for each other member of its family."""
    fits = []
    for effect in pair.effects:
        rest = tuple(e for e in pair.effects if e is not effect)
        row = fitter.predictor(rest).row(pair.values)
        alone = fitter.fit(rest, row)
        found.add([alone])
        held = fitter.fit(rest, row, 0)
        family = family_of(effect)
        members = [s for s in found.screened.values() if family_of(s.effect) == family]
        there = [pair]
        for one in sorted(members, key=lambda s: len(s.effect.parameters())):
            if one.effect is not effect:
                there.append(fit_added(fitter, held, one, _simpler(one.effect, there)))
        fits += there[1:]
    found.add(_finished(fitter, fits, pair.J))


def _screen_beside(
    fitter: ModelFitter,
    effects: Sequence[type[Effect]],
    current: CandidateFit,
    records: RecordScale,
) -> dict[str, ScreeningResult]:
    """Each further effect's direction beside a model's, by slug.

    All are looked at alone first, which is soon worked out; then the most promising beside the
    effects there are. What those do not let through, or bend, has another direction without them.
    """
    seen = [ScoreContext.of(fitter, current, records)]
    # A resonance shows only with the effects that drive and damp it.
    rings = [e for e in effects if e.named(Role.FREQUENCY)]
    rest = [e for e in effects if e not in rings]
    alone = {e.name: screen(e, fitter.predictor((e,)), seen) for e in rest}
    rest.sort(key=lambda e: -alone[e.name].screening_R2)
    named = [e for e in rest if e not in NAMELESS][:BESIDE]
    first = rest[: rest.index(named[-1]) + 1] if named else []
    return alone | {
        e.name: screen(e, fitter.predictor((*current.effects, e)), seen) for e in (*rings, *first)
    }
