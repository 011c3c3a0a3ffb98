"""Whether one wrong number of the model as it was given explains all there is."""

import math
from collections.abc import Sequence

from plants.discrepancy.search import thresholds
from plants.discrepancy.search.bench import Attempt, Bench
from plants.effects import Effect


def one_wrong_number(
    bench: Bench, base: Attempt, effects: Sequence[type[Effect]]
) -> tuple[Attempt, Attempt] | None:
    """The one calibration that is wrong in the model as given, if one alone is.

    All calibrations are free in the base fit, so that none of them is ever missing after it. But
    if the model as given leaves a gap, and changing one number alone closes it to where changing
    all of them does, that number is what is wrong.

    Args:
        bench: Model and records.
        base: The fit with all calibrations free.
        effects: The effects that stand for single calibrations.

    Returns:
        The model as given, and that with the calibration; None where there is no such one.
    """
    nobody: frozenset[str] = frozenset()
    given = bench.attempt((), bench.base.start[None, :], owners=nobody)
    if math.sqrt(given.rank_J) < thresholds.GAP:
        return None
    attempts = []
    for effect in effects:
        start = bench.predictor((effect,)).start
        attempts.append(bench.attempt((effect,), start[None, :], owners=frozenset({effect.name})))
    best = min(attempts, key=lambda a: a.rank_J, default=None)
    if best is None or best.rank_J > max(thresholds.CLOSED**2, thresholds.AS_GOOD * base.rank_J):
        return None
    if not thresholds.large_enough(best.effects[0], best.values, bench.scale):
        return None
    return given, best
