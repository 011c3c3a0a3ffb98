"""Step 5: the share of what the base model leaves that each effect's direction explains."""

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.pipeline.fit import BaseFit
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.diagnosis.search.score_context import ScoreContext
from plants.diagnosis.search.screening import Screening, ScreeningResult, screen_effect
from plants.effects import Effect


def screen(fitted: BaseFit) -> Screening:
    """Directions of all effects to choose from, and of the laws without a name."""
    fitter, base = fitted.fitter, fitted.models.base
    context = ScoreContext.of(fitter, base, fitted.scale)

    def screened(effect: type[Effect]) -> ScreeningResult:
        return screen_effect(effect, fitter.predictor((effect,)), context)

    declared = {e.name: screened(e) for e in fitted.choices.structural}
    if CONSTANTS.nothing >= base.J:
        return Screening(declared, {})
    nameless = [e for e in NAMELESS if fitter.model.unavailable(e) is None]
    return Screening(declared, {e.name: screened(e) for e in nameless})
