"""Outcome of a matching: the record of each reel, and the spread before and after."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any, NamedTuple

from estune.core.comparison import interval_factor
from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES, Gains
from estune.studies.table import NOTHING, StudyRow, StudyTable
from estune.support.notebook_card import card
from estune.trial.profiles import StepProfile
from estune.trial.signals import REEL, Signals

if TYPE_CHECKING:
    import pandas as pd


class CostEstimate(NamedTuple):
    """Mean cost of some gains on one reel, with its 95 % confidence interval.

    Attributes:
        cost: Geometric mean over the repeats; infinite where one was unsafe.
        low: Lower end of the interval, Student's t on the logarithms.
    """

    cost: float
    low: float
    high: float
    repeats: int

    @property
    def half_width(self) -> float:
        """Half the width of the interval, relative to the cost."""
        return 0.5 * (self.high - self.low) / self.cost

    def __str__(self) -> str:
        return f"{self.cost:.4g} ({self.low:.4g} to {self.high:.4g})"


def estimate_cost(costs: Sequence[float]) -> CostEstimate:
    """The cost by its repeats; the interval of one alone, or with an unsafe one, is open upward.

    Args:
        costs: Costs of repeats, at least one; not finite where a trial was unsafe.
    """
    n = len(costs)
    if not all(map(math.isfinite, costs)):
        return CostEstimate(math.inf, 0.0, math.inf, n)
    logs = [math.log(cost) for cost in costs]
    mean = fmean(logs)
    if n < 2:
        return CostEstimate(math.exp(mean), 0.0, math.inf, n)
    half = interval_factor(n - 1) * stdev(logs) / math.sqrt(n)
    return CostEstimate(math.exp(mean), math.exp(mean - half), math.exp(mean + half), n)


class MatchOutcome(StrEnum):
    """Relation of a reel's cost to the target."""

    PASS = "pass"  # noqa: S105  no password
    OFF_TARGET = "off target"
    NOT_SHOWN = "not shown"
    OUT_OF_REACH = "out of reach"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class ReelMatch:
    """The record of one reel.

    Attributes:
        label: The user's name of it.
        outcome: Relation of its cost to the target.
        rig: The rig's own name; empty if it was never reached.
        cost: Their cost, from repeats that were not used to find them.
    """

    label: str
    outcome: MatchOutcome
    reason: str
    rig: str = ""
    cable_length_m: float | None = None
    tuned: Gains | None = None
    tuned_cost: CostEstimate | None = None
    gains: Gains | None = None
    cost: CostEstimate | None = None
    live: bool = False
    trials: int = 0

    @property
    def passed(self) -> bool:
        """Whether the reel meets the target."""
        return self.outcome is MatchOutcome.PASS

    def to_json(self) -> dict[str, Any]:
        """The record as JSON values."""
        values: dict[str, Any] = {
            "label": self.label,
            "rig": self.rig,
            "passed": self.passed,
            "standing": str(self.outcome),
            "reason": self.reason,
            "cable_length_m": self.cable_length_m,
            "live": self.live,
            "trials": self.trials,
        }
        pairs = ("tuned", self.tuned, self.tuned_cost), ("matched", self.gains, self.cost)
        for prefix, gains, cost in pairs:
            numbers = gains.as_tuple() if gains else (None,) * len(GAIN_NAMES)
            values |= {f"{prefix}_{n}": v for n, v in zip(GAIN_NAMES, numbers, strict=True)}
            etas = zip(("eta", "eta_low", "eta_high"), cost or (None,) * 3, strict=False)
            values |= {f"{prefix}_{n}": _finite(v) for n, v in etas}
        return values


@dataclass(frozen=True, slots=True, repr=False)
class Matching:
    """Several reels tuned to one cost.

    Attributes:
        by_worst: Whether it is that of the worst tuned reel; otherwise the user chose it.
        tolerance: Largest deviation from the target, relative to it.
        signals: What the first rig measures and commands.
    """

    target: float
    by_worst: bool
    tolerance: float
    step: StepProfile
    cost: StepCost
    reels: tuple[ReelMatch, ...]
    folder: Path | None
    signals: Signals = REEL

    @property
    def passed(self) -> bool:
        """Whether every reel meets the target."""
        return all(reel.passed for reel in self.reels)

    @property
    def spread_before(self) -> float:
        """Standard deviation of the tuned costs over the reels that could be matched."""
        return _spread([r.tuned_cost for r in self._matched])

    @property
    def spread_after(self) -> float:
        """Standard deviation of the matched costs over these reels."""
        return _spread([r.cost for r in self._matched])

    @property
    def worst_tuned(self) -> float:
        """Greatest tuned cost of a reel that could be matched; nan without any."""
        return max((r.tuned_cost.cost for r in self._matched if r.tuned_cost), default=math.nan)

    @property
    def _matched(self) -> Sequence[ReelMatch]:
        return [r for r in self.reels if r.cost is not None and math.isfinite(r.cost.cost)]

    def heading(self) -> str:
        """The outcome in one line."""
        passed = sum(reel.passed for reel in self.reels)
        text = f"{passed} of {len(self.reels)} reels pass at cost {self.target:.4g}"
        before, after = self.spread_before, self.spread_after
        if math.isfinite(before):
            text += f"; spread {before:.3g} before, {after:.2g} after"
        return text

    def table(self) -> StudyTable:
        """The reels, a row each."""
        rows = tuple(
            StudyRow(
                reel.label,
                (str(reel.tuned_cost or NOTHING), str(reel.cost or NOTHING)),
                reel.gains,
                f"{reel.outcome}, live" if reel.live else str(reel.outcome),
                reel.passed,
                "" if reel.passed else reel.reason,
            )
            for reel in self.reels
        )
        return StudyTable("reel", ("tuned cost", "matched cost"), self.signals.gain_units, rows)

    @property
    def _missed(self) -> list[str]:
        missed = (reel for reel in self.reels if reel.reason and not reel.passed)
        return [f"{reel.label}: {reel.reason}" for reel in missed]

    def __repr__(self) -> str:
        rows = [", ".join(row) for row in self.table().cells()]
        return "\n".join([self.heading(), *rows, *self._missed])

    def _repr_html_(self) -> str:
        table = self.table()
        tables = [(table.heads, *table.cells())]
        return card(self.heading(), good=self.passed, tables=tables, sentences=self._missed)

    def to_json(self) -> dict[str, Any]:
        """The outcome as JSON values."""
        return {
            "target": self.target,
            "target_by": "worst tuned reel" if self.by_worst else "user",
            "tolerance": self.tolerance,
            "passed": self.passed,
            "spread_before": _finite(self.spread_before),
            "spread_after": _finite(self.spread_after),
            "worst_tuned": _finite(self.worst_tuned),
            "settling_time_s": self.cost.settling_time_s,
            "move_weight": self.cost.move_weight,
            "preload_N": self.step.preload_N,
            "step_N": self.step.step_N,
            "folder": str(self.folder) if self.folder else None,
            "reels": [reel.to_json() for reel in self.reels],
        }

    def to_frame(self) -> "pd.DataFrame":
        """The records, one row for each reel, with the target and the tolerance."""
        import pandas as pd  # noqa: PLC0415  slow to import

        common = {"target": self.target, "tolerance": self.tolerance}
        return pd.DataFrame([{**reel.to_json(), **common} for reel in self.reels])


def classify(cost: CostEstimate, target: float, tolerance: float) -> tuple[MatchOutcome, str]:
    """The outcome of matched gains: they pass if the whole interval lies within the tolerance."""
    low, high = target * (1.0 - tolerance), target * (1.0 + tolerance)
    values = f"cost {cost}, allowed {low:.4g} to {high:.4g}"
    if not math.isfinite(cost.cost):
        return (
            MatchOutcome.FAILED,
            "a repeat of the matched gains was unsafe; see the run's trials",
        )
    if low <= cost.low and cost.high <= high:
        return MatchOutcome.PASS, values
    if not low <= cost.cost <= high:
        return MatchOutcome.OFF_TARGET, f"{values}; use more match trials"
    return MatchOutcome.NOT_SHOWN, f"{values}; use more repeats to narrow the interval"


def _spread(costs: Sequence[CostEstimate | None]) -> float:
    means = [cost.cost for cost in costs if cost is not None]
    return stdev(means) if len(means) > 1 else math.nan


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
