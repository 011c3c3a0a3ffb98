"""The session as a journal has it, where its own next trial differs from the recorded one.

What was run counts, whichever gains this program would have asked for: an earlier version may have
ended its repeats by another statistic, and the optimum of a model depends on the last bits of
sums, which depend on where numbers lie in memory. Records without noise show them.
"""

from dataclasses import replace

from estune.core.gains import Gains
from estune.run.confirmation import confirming
from estune.run.phase import Phase
from estune.run.session import Session, known_costs
from estune.tuners.interface import RecordUsingTuner


def with_recorded(session: Session, gains: Gains) -> Session:
    """The session whose next trial has these gains; unchanged where it cannot be that."""
    repeats = session.confirmation
    if repeats is not None and gains in repeats.gains:
        recorded = repeats._replace(ahead=repeats.gains.index(gains))
        return replace(session, confirmation=recorded)
    tuner, space = session.plan.tuner, session.plan.tuner.space
    point = space.point_of(gains)
    ends = zip(point, space.low, space.high, strict=True)
    inside = all(low <= value <= high for value, low, high in ends)
    if not (inside and isinstance(tuner, RecordUsingTuner)):
        return session
    if session.phase is Phase.SEARCH and session.excitation is None:
        return replace(session, tuner_state=session.tuner_state._replace(proposal=point))
    if session.phase is Phase.CONFIRM and repeats is not None and not repeats.costs[1]:
        other = confirming(session.plan, gains, known_costs(session))
        return replace(session, confirmation=other._replace(ahead=1) if other else None)
    return session
