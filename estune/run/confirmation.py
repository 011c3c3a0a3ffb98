"""The repeats that confirm an improvement: of which gains, and until when."""

from estune.core.comparison import Change, InterleavedRepeats
from estune.core.gains import Gains
from estune.run.plan import CONFIRMATION_REPEATS_MAX, Plan


def confirming(
    plan: Plan, gains: Gains, known_costs: tuple[float, ...]
) -> InterleavedRepeats | None:
    """The repeats of the initial gains and of others; None if those are the initial ones.

    Known costs of the initial gains count as repeats.
    """
    space = plan.tuner.space
    if space.is_same(space.point_of(gains), space.point_of(plan.start)):
        return None
    return InterleavedRepeats.new((plan.start, gains), max(plan.repeats, 2), known_costs)


def extended(repeats: InterleavedRepeats, plan: Plan) -> InterleavedRepeats:
    """The repeats, over where the interval of the improvement is narrow.

    It is narrow enough at a share `precision` of the improvement, or where it excludes an
    improvement above the tolerance of the search.
    """

    def is_narrow(change: Change) -> bool:
        most = 2.0 * plan.precision * abs(change.estimate)
        return change.high - change.low <= most or change.low > -plan.tolerance

    most = max(CONFIRMATION_REPEATS_MAX, plan.repeats)
    return repeats.until(is_narrow, max(plan.repeats, 2), most)
