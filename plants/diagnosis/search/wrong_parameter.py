"""Whether one wrong number of the model as it was given explains all there is."""

from collections.abc import Sequence

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.search.fitted_models import FittedModels
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.effects import Effect


def find_wrong_parameter(
    fitter: ModelFitter, models: FittedModels, effects: Sequence[type[Effect]]
) -> CandidateFit | None:
    """The model as given with the one base-model parameter changed that alone is wrong.

    All are free in the base fit, so that none is ever missing after it. But where the model as
    given leaves an error, and changing one number alone explains as much of it as changing all,
    that number is what is wrong, unless another one does as well.
    """
    base = models.base
    if CONSTANTS.nothing >= models.given.J or not effects:
        return None
    fits = [
        fitter.fit((e,), fitter.predictor((e,)).start, owners=frozenset({e.name})) for e in effects
    ]
    best = min(fits, key=lambda f: f.J)
    effect, most = best.effects[0], CONSTANTS.floor * max(base.J, 1.0)
    values = {n: best.values[f"{effect.name}.{n}"] for n in effect.parameters()}
    if most < best.J or not effect.matters(values, fitter.scale):
        return None
    numbers = [f for f in fitter.base.free if f.owner == "base"]
    if effect.base_parameter not in [f.name for f in numbers]:
        # It does what all the others do together, which are wrong only where one is far off.
        moved = [abs(base.values[f.name] / f.start - 1.0) for f in numbers if f.start]
        # An inertia or a friction that was calculated from drawings may be a tenth off.
        return best if max(moved, default=0.0) > CONSTANTS.small else None
    unit = next(f.unit for f in numbers if f.name == effect.base_parameter)
    # What it is per length of cable is a part of it.
    per_length = f"{unit} per m"
    others = [f.name for f in numbers if f.name != effect.base_parameter and f.unit != per_length]
    others_alone = (fitter.fit((), fitter.base.start, owners=frozenset({n})).J for n in others)
    most = CONSTANTS.floor * best.J
    return best if all(most < J for J in others_alone) else None
