"""The gains of least predicted cost within limits of sensitivity and overshoot."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.core.setting import Setting, check_settings, documented
from estune.loop_model.half_widths import HalfWidths
from estune.loop_model.identification import remembered
from estune.loop_model.intervals import Interval, PredictedMargins
from estune.loop_model.model import LoopModel
from estune.loop_model.prediction import Prediction, StepTrial, predictions
from estune.loop_model.sobol import sobol_points

SENSITIVITY_MAX = 1.6
"""Largest Ms by default; 1.4 is robust, 2 aggressive."""

KEPT = 0.01
"""Share of a limit by which it may be exceeded and still counts as kept. With none the median cost
of `experiments.batch` was 1.1 % above the optimum, with it 0.3 %, and Ms up to 1.603 for 1.6."""

_NONE = "no limit"


@documented
@dataclass(frozen=True, slots=True)
class RobustnessLimits:
    """Limits that gains have to keep; None is no limit.

    Raises:
        InvalidInput: a value is out of its range.
    """

    max_sensitivity: Annotated[
        float | None,
        Setting(
            "Largest Ms, the peak of the sensitivity",
            none=_NONE,
            above=1.0,
            most=100.0,
        ),
    ] = SENSITIVITY_MAX
    max_overshoot: Annotated[
        float | None,
        Setting(
            "Largest overshoot, as a share of the step",
            share=True,
            none=_NONE,
            bare_most=0.3,  # 1 is more likely 1 % than an overshoot of the size of the step
            above=0.0,
            most=1.0,
        ),
    ] = 0.05
    min_phase_margin_deg: Annotated[
        float | None,
        Setting("Smallest phase margin", "degrees", none=_NONE, above=0.0, most=90.0),
    ] = None

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def _values(self) -> tuple[float | None, float | None, float | None]:
        return self.max_sensitivity, self.max_overshoot, self.min_phase_margin_deg

    def excess(self, p: Prediction) -> FloatArray:
        """By how much a prediction exceeds each limit, shape (3,).

        Sensitivity as a logarithm, overshoot as a share of the step, phase margin in radians.
        """
        Ms, overshoot, angle = self._values
        return np.array(
            [
                -1.0 if Ms is None else math.log(p.sensitivity / Ms),
                -1.0 if overshoot is None else p.overshoot - overshoot,
                -1.0 if angle is None else math.radians(angle - p.phase_margin_deg),
            ]
        )

    def excesses(self, found: Sequence[Prediction]) -> FloatArray:
        """The same with the sensitivity of each band, (predictions, bands + 2), without kinks."""
        Ms, overshoot, angle = self._values
        values = np.array([(*p.peaks, p.overshoot, p.phase_margin_deg) for p in found])
        values[:, :-2] = -1.0 if Ms is None else np.log(values[:, :-2] / Ms)
        values[:, -2] = -1.0 if overshoot is None else values[:, -2] - overshoot
        values[:, -1] = -1.0 if angle is None else np.radians(angle - values[:, -1])
        return values

    @property
    def tolerated(self) -> "RobustnessLimits":
        """The limits with what may exceed them and still counts as kept."""
        Ms, overshoot, angle = self._values
        return RobustnessLimits(
            None if Ms is None else min((1.0 + KEPT) * Ms, 100.0),
            None if overshoot is None else min((1.0 + KEPT) * overshoot, 1.0),
            None if angle is None else (1.0 - KEPT) * angle,
        )

    def broken_by(self, margins: PredictedMargins) -> str:
        """The limits that a loop breaks, whichever value of its intervals is true; or nothing."""

        def broken(limit: float | None, at: Interval, name: str, form: str) -> Iterator[str]:
            if limit is not None and at.low > (1.0 + KEPT) * limit:
                yield f"{name} {at.value:{form}}, above {limit:{form}}"

        least = self.min_phase_margin_deg
        angle = margins.phase_margin_deg
        return " and ".join(
            (
                *broken(self.max_sensitivity, margins.sensitivity, "a sensitivity Ms of", ".3g"),
                *broken(self.max_overshoot, margins.overshoot, "an overshoot of", ".1%"),
                *(
                    [f"a phase margin of {angle.value:.0f}°, below {least:.0f}°"]
                    if least is not None and angle.high < (1.0 - KEPT) * least
                    else []
                ),
            )
        )

    def aimed(self, beside: HalfWidths) -> "RobustnessLimits":
        """Limits of a search at whose optimum the intervals' ends count as keeping these.

        Half of a small overshoot and of the logarithm of a small Ms is left at least.
        """
        Ms, overshoot, angle = self._values
        wide, over, turn = beside
        over -= KEPT * (overshoot or 0.0)
        turn -= KEPT * (angle or 0.0)
        nearer = math.exp(-max(wide - math.log1p(KEPT), 0.0))
        return RobustnessLimits(
            None if Ms is None else max(Ms * nearer, math.sqrt(Ms)),
            None if overshoot is None else max(overshoot - max(over, 0.0), overshoot / 2.0),
            None if angle is None else min(angle + max(turn, 0.0), 90.0),
        )

    def loosened_to(self, p: Prediction) -> "RobustnessLimits":
        """The limits, widened where a prediction exceeds them."""
        Ms, overshoot, angle = self._values
        return RobustnessLimits(
            None if Ms is None else max(Ms, min(p.sensitivity, 100.0)),
            None if overshoot is None else max(overshoot, min(p.overshoot, 1.0)),
            None if angle is None else max(min(angle, p.phase_margin_deg), 1e-3),
        )


class Optimum(NamedTuple):
    """The best gains of a model within limits.

    Attributes:
        coordinates: Logarithms of the tuned parameters, shape (n,).
    """

    coordinates: FloatArray
    prediction: Prediction
    feasible: bool


TOLERANCE = 2e-3
"""Excess over a limit that still counts as kept: 0.2 % of Ms, 0.2 % of the step."""

PENALTY = 30.0
"""Logarithms of cost per unit of excess, by which solutions outside the limits are compared."""

EXCESS_MAX = 5.0
"""Excess of an unstable loop."""

INFEASIBLE = 10.0
"""Logarithm of the cost of an unstable loop."""

DESCENTS = 2
"""Descents that have to end within the limits, the best starts first; one for a loop of two poles.
Of 106 descents on such loops 2 ended more than 0.2 % above the best of six, 3 % at most; of 144 on
loops of four and six poles 2 did, 27 % and 31 % above it, and 3 outside the limits."""

DERIVATIVE, SLOW_FILTER = 0.05, 0.5
"""D over P, and the setpoint filter of one of two starts, in settling times, that have a descent
each. No slope leads from gains whose derivative is too small to matter to those with one that
does: on eight lags of 1 s the others ended 29 % above the optimum. On a double integrator a slow
filter with a large P costs 7 % less than a fast one with a small P."""

DESCENDED = 1e-4
"""Decrease of the log cost at which a descent ends: with a tenth of it the tuned gains
of 13 plants cost at most 0.04 % less, and runs take 6 % longer."""

SAME_START = 0.05
"""Largest difference in a logarithm between two starts of which one search is enough."""

SLOPE_STEP = 1e-4
"""Distance in a logarithm by which slopes of cost and limits are measured."""

GENTLER = np.array([-0.4, -0.6, -0.4, 0.2])
"""Step from gains at which a model is unstable, in logarithms of P, I, D and the filter."""


@dataclass(frozen=True, slots=True)
class RegionSearch:
    """Minimises the predicted cost over a box of logarithms of the tuned parameters.

    Attributes:
        limits: What the gains have to keep.
        low: Least coordinates, shape (n,).
        noise_std: Standard deviation of the measurement noise.
        corrected: From coordinates and what the model predicts there to what is expected.
    """

    model: LoopModel
    trial: StepTrial
    limits: RobustnessLimits
    gains_of: Callable[[FloatArray], Gains]
    low: FloatArray
    high: FloatArray
    noise_std: float = 0.0
    corrected: Callable[[FloatArray, Prediction], Prediction] | None = None
    _known: dict[bytes, Prediction] = field(default_factory=dict, repr=False, compare=False)

    def minimise(
        self,
        starts: Sequence[FloatArray],
        *,
        iterations: int = 40,
        scattered: int = 0,
        apart: Sequence[FloatArray] = (),
    ) -> Optimum:
        """The best of sequential quadratic programmes from several starts.

        Args:
            starts: Where searches begin, each of shape (n,).
            iterations: Greatest number of iterations of each.
            scattered: Number of low-discrepancy points of which the best is one more start.
            apart: Further starts, from each of which a search begins whatever the others find.
        """
        starts = [*starts, *([self._best_of(scattered)] if scattered else [])]
        self.all_predicted([np.clip(x, self.low, self.high) for x in (*starts, *apart)])
        stable = self._stable(starts)
        if not stable:
            middle = (self.low + self.high) / 2.0
            return Optimum(middle, self.predicted(middle), feasible=False)
        asked, found = DESCENTS if self.model.order > 2 else 1, list[Optimum]()
        for x in stable:
            found.append(self._descend(x, iterations))
            if sum(one.feasible for one in found) == asked:
                break
        found += [self._descend(x, iterations) for x in self._stable(apart)]
        return min(found, key=self._rank)

    def _stable(self, starts: Sequence[FloatArray]) -> list[FloatArray]:
        """Starts at which the model is stable, the best first, of those close to another one."""
        stable: list[FloatArray] = []
        for start in starts:
            x = self._stabilised(start)
            if x is not None and all(np.abs(x - other).max() > SAME_START for other in stable):
                stable.append(x)
        return sorted(stable, key=lambda x: self._penalised(x, 1.0))

    def ends(self, x: FloatArray) -> list[FloatArray]:
        """The point with each coordinate by itself at either end of the box.

        No slope leads away from a gain that is too small to matter.
        """
        moves = np.diag(np.concatenate([self.low - x, self.high - x]))
        return list(x + moves[:, : x.size] + moves[:, x.size :])

    def predicted(self, x: FloatArray) -> Prediction:
        """The expected cost and constraints at some coordinates."""
        return self.all_predicted([x])[0]

    def all_predicted(self, points: Sequence[FloatArray]) -> list[Prediction]:
        """The expected cost and constraints at several coordinates, at once."""
        new = {key: x for x in points if (key := x.tobytes()) not in self._known}
        if new:
            gains = [self.gains_of(x) for x in new.values()]
            found = predictions([self.model], self.trial, gains, self.noise_std)
            for (key, x), one in zip(new.items(), found, strict=True):
                self._known[key] = self.corrected(x, one) if self.corrected else one
        return [self._known[x.tobytes()] for x in points]

    def _descend(self, start: FloatArray, iterations: int) -> Optimum:
        from scipy.optimize import minimize  # noqa: PLC0415  slow to import

        linear = remembered(self._linearised)  # copied, for SLSQP writes into the slopes
        found = minimize(
            lambda x: (float(linear(x)[0][0]), linear(x)[1][0].copy()),
            start,
            method="SLSQP",
            jac=True,
            bounds=list(zip(self.low, self.high, strict=True)),
            constraints={
                "type": "ineq",
                "fun": lambda x: -linear(x)[0][1:],
                "jac": lambda x: -linear(x)[1][1:],
            },
            options={"maxiter": iterations, "ftol": DESCENDED},
        )
        x = np.clip(found.x, self.low, self.high)
        kept = bool(self._excesses([self.predicted(x)]).max() < TOLERANCE)
        return Optimum(x, self.predicted(x), feasible=kept)

    def _linearised(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log cost and excesses, (values,), and slopes of each along the coordinates, (values, n).

        Nearly every point whose values are asked for has its slopes asked for next.
        """
        steps = np.where(x + SLOPE_STEP <= self.high, SLOPE_STEP, -SLOPE_STEP)
        found = self.all_predicted([x, *(x + np.diag(steps))])
        values = np.column_stack([_log_costs(found), self._excesses(found)])
        return values[0], (values[1:] - values[0]).T / steps

    def _objective(self, x: FloatArray) -> float:
        return float(_log_costs([self.predicted(x)])[0])

    def _excesses(self, found: Sequence[Prediction]) -> FloatArray:
        return _bounded(self.limits.excesses(found))

    def _penalised(self, x: FloatArray, penalty: float) -> float:
        beyond = np.maximum(_bounded(self.limits.excess(self.predicted(x))) - TOLERANCE, 0.0)
        return self._objective(x) + penalty * float(beyond.sum())

    def _rank(self, one: Optimum) -> float:
        return self._penalised(one.coordinates, PENALTY)

    def _best_of(self, count: int) -> FloatArray:
        points: FloatArray = self.low + (self.high - self.low) * sobol_points(self.low.size, count)
        self.all_predicted(list(points))
        return min(points, key=lambda x: self._penalised(x, 1.0))

    def _stabilised(self, start: FloatArray) -> FloatArray | None:
        """The start, moved to lower gains until the model is stable there."""
        x = np.clip(start, self.low, self.high)
        for _ in range(20):
            if math.isfinite(self.predicted(x).cost):
                return x
            x = np.clip(x + GENTLER[: x.size], self.low, self.high)
        return None


def _log_costs(found: Sequence[Prediction]) -> FloatArray:
    """Logarithms of costs, with a largest value, that of an unstable loop."""
    costs = np.array([one.cost for one in found])
    return np.where(np.isfinite(costs), np.log(costs), INFEASIBLE)


def _bounded(excess: FloatArray) -> FloatArray:
    """Excesses with a largest value, that of an unstable loop too."""
    return np.where(np.isfinite(excess), np.minimum(excess, EXCESS_MAX), EXCESS_MAX)
