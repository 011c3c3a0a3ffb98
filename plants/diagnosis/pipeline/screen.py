"""Step 5: the share of what the base model leaves that each effect's direction explains."""

from collections.abc import Sequence

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.pipeline.fit import BaseFit
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.diagnosis.search.score_context import ScoreContext
from plants.diagnosis.search.screening import Screening, ScreeningResult, screen_effect
from plants.effects import Effect


def screen(fitted: BaseFit) -> Screening:
    """Directions of all effects to choose from, and of the laws without a name."""
    fitter, models = fitted.fitter, fitted.models
    contexts = [ScoreContext.of(fitter, models.base, fitted.scale)]

    def screened(effect: type[Effect], contexts: Sequence[ScoreContext]) -> ScreeningResult:
        return screen_effect(effect, fitter.predictor((effect,)), contexts)

    declared = {e.name: screened(e, contexts) for e in fitted.choices.structural}
    best = max((s.screening_R2 for s in declared.values()), default=0.0)
    if CONSTANTS.distorted < models.base.J and best < CONSTANTS.aimed:
        contexts.append(ScoreContext.of(fitter, models.given, fitted.scale))
        declared = {n: s.merged(screened(s.effect, contexts[1:])) for n, s in declared.items()}
    if CONSTANTS.nothing >= models.base.J:
        return Screening(declared, {})
    nameless = [e for e in NAMELESS if fitter.model.unavailable(e) is None]
    return Screening(declared, {e.name: screened(e, contexts) for e in nameless})
