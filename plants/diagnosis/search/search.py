"""Fits of models with missing effects: single ones, then pairs with the best of them.

Nothing is decided here. Every fit is kept; `decide` says which model is believed.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.progress import Progress, portion, silent
from plants.diagnosis.result import explained_share, family_of
from plants.diagnosis.search.decide import best_of, relative
from plants.diagnosis.search.fitted_models import FittedModels, is_named, summarise
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.diagnosis.search.score_context import ScoreContext
from plants.diagnosis.search.screening import Directions, Screening, ScreeningResult
from plants.diagnosis.search.starts import fit_added
from plants.effects import Effect, RecordScale, Role


def search(
    fitter: ModelFitter,
    models: FittedModels,
    screening: Screening,
    scale: RecordScale,
    progress: Progress = silent,
) -> FittedModels:
    """The base model, models with one effect, and pairs with the best of those."""
    if CONSTANTS.nothing >= models.base.J:
        return models
    fits = fit_promising(fitter, models.base, screening, portion(progress, 0.2, 0.6))
    models = models.adding(fits)
    single = leading_single(fitter, models)
    # A second effect is looked for beside one that explains something, and leaves something.
    if single is None or CONSTANTS.nothing >= single.J:
        return models
    if explained_share(models.base.J, single.J) < 1.0 - CONSTANTS.named_share:
        return models
    progress("screening second effects", 0.6)
    beside = screen_beside(fitter, screening, single, scale)
    fits = fit_promising(fitter, single, beside, portion(progress, 0.7, 0.95))
    models = models.adding(fits)
    # Whether an effect is of a size that matters shows beside the right partner.
    _, *summaries = relative(models.summaries(fitter.scale))
    pair = best_of([s._replace(eligible=True) for s in summaries])
    # The fuller law of a family may stand for a simpler one and another effect.
    if pair is not None and len(pair.names) < 2 and single.effects[0].extends is not None:
        pairs = [s for s in summaries if s.named and len(s.names) == 2]
        pair = min(pairs, key=lambda s: s.J, default=None)
    if pair is None or len(pair.names) < 2:
        return models
    progress("comparing pairs", 0.95)
    best_pair = models.with_effects[pair.names]
    return models.adding(fit_exchanged(fitter, best_pair, screening.declared))


def leading_single(fitter: ModelFitter, models: FittedModels) -> CandidateFit | None:
    """The best named effect of the family of the first that could be believed, if there is."""
    named = [fit for fit in models.singles if is_named(fit)]
    eligible = [fit for fit in named if summarise(fit, fitter.scale).eligible]
    families = {family_of(fit.effects[0]) for fit in (eligible or named)[:1]}
    return next((fit for fit in named if family_of(fit.effects[0]) in families), None)


def fit_promising(
    fitter: ModelFitter, current: CandidateFit, screening: Screening, progress: Progress
) -> list[CandidateFit]:
    """Fits of a model with each promising effect, its family, and nameless laws as promising."""
    ranked = sorted(screening.declared.values(), key=lambda s: -s.screening_R2)
    best = max((s.screening_R2 for s in ranked), default=0.0)
    least_R2 = best * (CONSTANTS.aimed_beside if current.effects else CONSTANTS.aimed)
    promising = [s for s in ranked if s.screening_R2 > least_R2][:5]
    families = {family_of(s.effect) for s in promising}
    if not current.effects:
        families |= {family_of(s.effect) for s in ranked if s.effect.resists and s.effect.family}
    chosen = [s for s in ranked if family_of(s.effect) in families]
    # The most promising family first, of it the simpler ones: others begin with their fit.
    aim = {family_of(s.effect): s.screening_R2 for s in reversed(chosen)}
    chosen.sort(key=lambda s: (-aim[family_of(s.effect)], _depth(s.effect), -s.screening_R2))
    chosen += [s for s in screening.nameless.values() if s.screening_R2 >= CONSTANTS.aimed * best]
    fits: list[CandidateFit] = []
    least = math.inf
    for n, candidate in enumerate(chosen):
        progress(f"fitting {candidate.effect.title}", n / len(chosen))
        # Once a model leaves nothing, only effects with a similar direction compete with it.
        if max(least, 1.0) <= CONSTANTS.floor and candidate.screening_R2 < CONSTANTS.aimed * best:
            continue
        simpler = _simpler(candidate.effect, fits)
        fit = fit_added(fitter, current, candidate, simpler, least=least)
        if least > fit.J:
            fit = fitter.refine(fit, 40)
        fits.append(fit)
        least = min(least, _least(fitter, [fit]))
    return _finished(fitter, fits)


def fit_exchanged(
    fitter: ModelFitter, pair: CandidateFit, members: Mapping[str, ScreeningResult]
) -> list[CandidateFit]:
    """A pair with each effect left out, and exchanged for each other member of its family."""
    singles, exchanged = [], []
    for effect in pair.effects:
        remaining = tuple(e for e in pair.effects if e is not effect)
        row = fitter.predictor(remaining).row(pair.values)
        singles.append(fitter.fit(remaining, row))
        partner = fitter.fit(remaining, row, 0)
        family = [s for s in members.values() if family_of(s.effect) == family_of(effect)]
        fits = [pair]
        for candidate in sorted(family, key=lambda s: len(s.effect.parameters())):
            if candidate.effect is not effect:
                simpler = _simpler(candidate.effect, fits)
                fits.append(fit_added(fitter, partner, candidate, simpler))
        exchanged += fits[1:]
    return [*singles, *_finished(fitter, exchanged, pair.J)]


def screen_beside(
    fitter: ModelFitter, screening: Screening, current: CandidateFit, scale: RecordScale
) -> Screening:
    """Directions beside a model of the effects of other families, and of the nameless laws.

    All are screened without the effects of the model first, which takes little time, and the most
    promising then with them: these may change the direction of an effect.
    """
    family = family_of(current.effects[0])
    declared = [s.effect for s in screening.declared.values() if family_of(s.effect) != family]
    nameless = [e for e in NAMELESS if fitter.model.unavailable(e) is None]
    context = ScoreContext.of(fitter, current, scale)

    def screened(effect: type[Effect], beside: tuple[type[Effect], ...]) -> ScreeningResult:
        return Directions(effect, fitter.predictor((*beside, effect)), context).screened()

    # A resonance shows only with the effects that drive and damp it.
    resonant = [e for e in declared if e.named(Role.FREQUENCY)]
    others = [e for e in (*declared, *nameless) if e not in resonant]
    alone = {e.name: screened(e, ()) for e in others}
    others.sort(key=lambda e: -alone[e.name].screening_R2)
    named = [e for e in others if e not in NAMELESS][:5]
    first = others[: others.index(named[-1]) + 1] if named else []
    directions = alone | {e.name: screened(e, current.effects) for e in (*resonant, *first)}
    unnamed = {e.name: directions.pop(e.name) for e in nameless}
    return Screening(directions, unnamed)


def _depth(effect: type[Effect]) -> int:
    """Number of effects that an effect begins with, one within the other."""
    return 0 if effect.extends is None else 1 + _depth(effect.extends)


def _simpler(effect: type[Effect], fits: Sequence[CandidateFit]) -> CandidateFit | None:
    return next((f for f in fits if effect.extends in f.effects), None)


def _least(fitter: ModelFitter, fits: Iterable[CandidateFit]) -> float:
    """J of the best of the fits that could be believed: no other stands in another's way."""
    eligible = (f for f in fits if is_named(f) and summarise(f, fitter.scale).eligible)
    return min((f.J for f in eligible), default=math.inf)


def _finished(
    fitter: ModelFitter, fits: Sequence[CandidateFit], least: float = math.inf
) -> list[CandidateFit]:
    ranked = sorted(fits, key=lambda f: f.J)
    finished: list[CandidateFit] = []
    for fit in ranked:
        limit = min(least, _least(fitter, finished))
        limit = limit if math.isfinite(limit) else fit.J
        leads = CONSTANTS.behind * limit > fit.J
        rounds = 40 if fit is ranked[0] else 15
        finished.append(fitter.refine(fit, rounds) if leads else fit)
    return finished
