"""Numbers of the model as it was given that are wrong: one alone, or its calibrations."""

from collections.abc import Sequence

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.search.fitted_models import FittedModels
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.effects import Effect
from plants.remedies.calibration import OFFSET_NOISES, OFFSET_SHARE, has_moved


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


def settle_calibrations(
    fitter: ModelFitter, models: FittedModels, effects: Sequence[type[Effect]]
) -> CandidateFit:
    """The refitted model whose calibrations are as given, or moved as effects that are found.

    A calibration that moves by more than its tolerance hides what acts alike: it is a finding
    where the records need it, and as given where the other numbers explain as much without it.
    """
    base, noise = models.base, fitter.floor.channels.get("tension_N")
    tolerance_N = None
    if noise is not None:
        tolerance_N = max(OFFSET_NOISES * noise.rms, OFFSET_SHARE * fitter.scale.reading_max_N)
    given = {f.name: f.start for f in fitter.base.free}
    moved = [
        e
        for e in effects
        if e.base_parameter in given
        and has_moved(
            e.base_parameter,
            given[e.base_parameter],
            base.values[e.base_parameter],
            tolerance_N,
        )
    ]
    if not moved or CONSTANTS.nothing >= models.given.J:
        return base
    held = [e.base_parameter for e in moved]
    as_given = fitter.fit((), fitter.base.start, 40, held=held)
    if max(CONSTANTS.nothing, CONSTANTS.floor * base.J) >= as_given.J:
        return as_given
    predictor = fitter.predictor(tuple(moved))
    sizes = {}
    for effect in moved:
        name, (size,) = effect.base_parameter, effect.parameters()
        by = base.values[name] / given[name] if name == "torque_gain" else base.values[name]
        sizes[f"{effect.name}.{size}"] = by - (1.0 if name == "torque_gain" else given[name])
    others = {f.name: base.values[f.name] for f in fitter.base.free if f.name not in held}
    return fitter.fit(tuple(moved), predictor.row(others | sizes), 40, held=held)
