"""A gain schedule tuned as a whole, by trials on reels of several cable lengths.

Every gain but I is constant; I = a + b L, as in the paper's Fig. 14, is given by its values at the
two ends of the range, so that all parameters have logarithms and I is positive in between. Each
proposal is tried once at every length. With eta_j the cost at the j-th of m lengths, the tuner
receives the geometric mean ln eta = (1/m) sum_j ln eta_j: the level of a single length only adds a
constant to it, so that no length needs a weight. An unsafe trial ends its round at once.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count

from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES, Gains
from estune.core.schedule import GainCurve, GainSchedule
from estune.run.session import UNSAFE_RATIO
from estune.trial import Outcome, Rig, TrialRequest
from estune.trial.scoring import constraint_margin, cost_of
from estune.tuners import create_tuner
from estune.tuners.observation import Observation
from estune.tuners.search_space import Directions, Point, SearchSpace

NAMES = ("P", "I_short", "I_long", "D", "setpoint_filter_s")


@dataclass(frozen=True, slots=True)
class ScheduleSpace(SearchSpace):
    """The parameters `NAMES` of a schedule over a range of lengths, m."""

    length_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def over(cls, gains: Gains, length_m: tuple[float, float]) -> "ScheduleSpace":
        """The schedules around gains that are the same at every length."""
        start = (gains.P, gains.I, gains.I, gains.D, gains.setpoint_filter_s)
        low, high = (tuple(value * factor for value in start) for factor in (0.01, 100.0))
        return cls(NAMES, start, low, high, length_m=length_m)

    @property
    def directions(self) -> tuple[Directions, ...]:
        """Directions of the parameters at the least and at the greatest length."""
        return tuple(
            tuple(
                tuple(float(name in (gain, gain + end)) for gain in GAIN_NAMES) for name in NAMES
            )
            for end in ("_short", "_long")
        )

    def gains_at(self, point: Point, length_m: float) -> Gains:
        """The gains at a length within the range, m."""
        P, I_short, I_long, D, setpoint_filter_s = point
        short, long = self.length_m
        share = (length_m - short) / (long - short)
        return Gains(P, (1.0 - share) * I_short + share * I_long, D, setpoint_filter_s)

    def gains(self, point: Point) -> Gains:
        """The gains in the middle of the range."""
        return self.gains_at(point, sum(self.length_m) / 2.0)

    def schedule(self, point: Point, tension_N: float) -> GainSchedule:
        """The schedule over the range, at one tension."""
        curves = dict(zip(GAIN_NAMES, self.gains(point).as_tuple(), strict=True))
        constant = {name: GainCurve("constant", value) for name, value in curves.items()}
        slope = (point[2] - point[1]) / (self.length_m[1] - self.length_m[0])
        line = GainCurve("linear", point[1] - slope * self.length_m[0], slope)
        tension = (tension_N, tension_N)
        return GainSchedule(**{**constant, "I": line}, length_m=self.length_m, tension_N=tension)

    def _check_names(self) -> None:
        """The names are always `NAMES`."""


def tune_jointly(
    rigs: Mapping[float, Rig], tuner_name: str, trials: int, start: Gains, cost: StepCost
) -> GainSchedule:
    """Tunes the schedule.

    Args:
        rigs: The rigs by cable length, m; at least two.
        tuner_name: Name of the tuner.
        trials: Number of search trials over all lengths.
        start: Initial gains at every length.
        cost: The cost of the step that the first rig suggests.
    """
    space = ScheduleSpace.over(start, (min(rigs), max(rigs)))
    tuner = create_tuner(tuner_name, space)
    numbers = count()
    step = next(iter(rigs.values())).describe().step

    def trial(length: float, gains: Gains, eta_max: float) -> Observation:
        rig = rigs[length]
        description = rig.describe()
        record = rig.run(TrialRequest("joint", next(numbers), gains, step))
        eta = cost_of(record, step, cost, description.newtons_per_ampere)
        censored = record.outcome is not Outcome.DONE or not eta <= eta_max
        return Observation(eta, censored, constraint_margin(record, description))

    # The guard of a tuning run, at each length: the initial gains must not diverge.
    eta_max = {n: UNSAFE_RATIO * trial(n, start, math.inf).cost for n in rigs}
    state = tuner.start()
    for _ in range(trials // len(rigs)):
        point = tuner.ask(state)
        observations = []
        for length in rigs:
            observations.append(trial(length, space.gains_at(point, length), eta_max[length]))
            if observations[-1].censored:
                break
        censored = observations[-1].censored
        margin = min(o.margin for o in observations)
        eta = math.nan
        if not censored:
            eta = math.exp(math.fsum(math.log(o.cost) for o in observations) / len(observations))
        state = tuner.tell(state, Observation(eta, censored, margin))
    return space.schedule(tuner.recommend(state), step.preload_N)
