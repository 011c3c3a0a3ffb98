"""Whether one wrong number of the model as it was given explains all there is."""

import math
from collections.abc import Sequence

from plants.diagnosis.search import thresholds
from plants.diagnosis.search.model_comparison import is_significantly_better
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter
from plants.effects import Effect

NOBODY: frozenset[str] = frozenset()


def find_wrong_parameter(
    bench: ModelFitter, base: CandidateFit, effects: Sequence[type[Effect]]
) -> tuple[CandidateFit, CandidateFit] | None:
    """The one calibration that is wrong in the model as given, if one alone is.

    All calibrations are free in the base fit, so that none of them is ever missing after it. But
    if the model as given leaves a gap, and changing one number alone closes it to where changing
    all of them does, that number is what is wrong, unless another one does as well.

    Args:
        bench: Model and records.
        base: The fit with all calibrations free.
        effects: The effects that stand for single calibrations.

    Returns:
        The model as given, and that with the calibration; None where there is no such one.
    """
    given = bench.attempt((), bench.base.start[None, :], owners=NOBODY)
    if math.sqrt(given.rank_J) < thresholds.GAP:
        return None
    attempts = []
    for effect in effects:
        start = bench.predictor((effect,)).start
        attempts.append(bench.attempt((effect,), start[None, :], owners=frozenset({effect.name})))
    best = min(attempts, key=lambda a: a.rank_J, default=None)
    most = max(thresholds.CLOSED**2, thresholds.AS_GOOD * base.rank_J)
    if best is None or best.rank_J > most:
        return None
    if not thresholds.large_enough(best.effects[0], best.values, bench.scale):
        return None
    numbers = [f for f in bench.base.free if f.owner == "base"]
    own = best.effects[0].base_parameter
    if own not in [f.name for f in numbers]:
        # It does what all the others do together, which are wrong only where one is far off.
        moved = [abs(base.values[f.name] / f.start - 1.0) for f in numbers if f.start]
        return (given, best) if max(moved, default=0.0) > thresholds.RECKONED else None
    for f in numbers:
        if f.name != own:
            only = frozenset({f.name})
            other = bench.attempt((), bench.base.start[None, :], owners=only)
            if other.rank_J <= most and not is_significantly_better(best, other):
                return None
    return given, best
