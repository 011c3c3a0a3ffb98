"""Step 5: the share of what the base model leaves that each effect's direction explains.

A base model that makes up for a missing effect by a number far from the one given is another
machine: a friction of 700 times that of a drive hides the limit of its current. Directions are
then looked at beside the model as given, too, and the one that explains more counts.
"""

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.pipeline.fit import BaseFit
from plants.diagnosis.search.limitations import has_moved
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.diagnosis.search.score_context import ScoreContext
from plants.diagnosis.search.screening import Directions, Screening, ScreeningResult
from plants.effects import Effect


def screen(fitted: BaseFit) -> Screening:
    """Directions of all effects to choose from, and of the laws without a name."""
    fitter, base = fitted.fitter, fitted.models.base
    origins = (base, fitted.models.given) if has_moved(base) else (base,)
    contexts = [ScoreContext.of(fitter, origin, fitted.scale) for origin in origins]

    def screened(effect: type[Effect]) -> ScreeningResult:
        predictor = fitter.predictor((effect,))
        results = (Directions(effect, predictor, c).screened() for c in contexts)
        return max(results, key=lambda result: result.screening_R2)

    declared = {e.name: screened(e) for e in fitted.choices.structural}
    if CONSTANTS.nothing >= base.J:
        return Screening(declared, {})
    nameless = [e for e in NAMELESS if fitter.model.unavailable(e) is None]
    return Screening(declared, {e.name: screened(e) for e in nameless})
