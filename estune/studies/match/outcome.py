"""What a matching came to: each reel's record, the spread before and after."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from statistics import stdev
from typing import TYPE_CHECKING, Any, Self

from estune.core.cost import StepCost
from estune.core.gains import GAIN_NAMES, Gains
from estune.studies.match.cost_estimate import CostEstimate
from estune.trial.profiles import StepProfile

if TYPE_CHECKING:
    import pandas as pd


class MatchOutcome(StrEnum):
    """How a reel stands to the target; only `pass` is one."""

    PASS = "pass"  # noqa: S105  no password
    OFF_TARGET = "off target"
    NOT_SHOWN = "not shown"
    OUT_OF_REACH = "out of reach"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class ReelMatch:
    """The record of one reel.

    Attributes:
        label: What the user calls it.
        standing: How it stands to the target.
        reason: That in a sentence.
        rig: The rig's own name; empty if it was never reached.
        cable_length_m: Its cable length, m, or None.
        tuned: The gains it was tuned to on its own, or None.
        tuned_level: Their cost.
        gains: The gains that bring it to the target, or None.
        level: Their cost, from repeats that had no part in finding them.
        live: Whether the gains were made the rig's live ones.
        trials: Trials run on it.
    """

    label: str
    standing: MatchOutcome
    reason: str
    rig: str = ""
    cable_length_m: float | None = None
    tuned: Gains | None = None
    tuned_level: CostEstimate | None = None
    gains: Gains | None = None
    level: CostEstimate | None = None
    live: bool = False
    trials: int = 0

    @property
    def passed(self) -> bool:
        """Whether the reel meets the target."""
        return self.standing is MatchOutcome.PASS

    def to_json(self) -> dict[str, Any]:
        """The record as JSON values."""
        shown: dict[str, Any] = {
            "label": self.label,
            "rig": self.rig,
            "passed": self.passed,
            "standing": str(self.standing),
            "reason": self.reason,
            "cable_length_m": self.cable_length_m,
            "live": self.live,
            "trials": self.trials,
        }
        pairs = ("tuned", self.tuned, self.tuned_level), ("matched", self.gains, self.level)
        for name, gains, level in pairs:
            values = gains.as_tuple() if gains else (None,) * len(GAIN_NAMES)
            shown |= {f"{name}_{n}": v for n, v in zip(GAIN_NAMES, values, strict=True)}
            told = dict(zip(("eta", "eta_low", "eta_high"), level or (None,) * 3, strict=False))
            shown |= {f"{name}_{n}": _finite(v) for n, v in told.items()}
        return shown


@dataclass(frozen=True, slots=True)
class Matching:
    """Several reels brought to one cost.

    Attributes:
        target: The cost aimed at.
        by_worst: Whether the worst tuned reel chose it; otherwise the user did.
        tolerance: How far from the target a reel may be, relative to it.
        step: The step trial, the same on all reels.
        cost: How it was scored, the same on all reels.
        reels: The records, in the user's order.
        folder: Where the runs are kept, or None.
    """

    target: float
    by_worst: bool
    tolerance: float
    step: StepProfile
    cost: StepCost
    reels: tuple[ReelMatch, ...]
    folder: Path | None

    @property
    def passed(self) -> bool:
        """Whether every reel meets the target."""
        return all(reel.passed for reel in self.reels)

    @property
    def spread_before(self) -> float:
        """Standard deviation of the tuned costs over the reels that could be matched."""
        return _spread([r.tuned_level for r in self._matched])

    @property
    def spread_after(self) -> float:
        """The same of the matched costs."""
        return _spread([r.level for r in self._matched])

    @property
    def worst_tuned(self) -> float:
        """Greatest tuned cost of a reel that could be matched; nan without any."""
        return max((r.tuned_level.cost for r in self._matched if r.tuned_level), default=math.nan)

    @property
    def _matched(self) -> Sequence[ReelMatch]:
        return [r for r in self.reels if r.level is not None and math.isfinite(r.level.cost)]

    def heading(self) -> str:
        """The outcome in one line."""
        passed = sum(reel.passed for reel in self.reels)
        said = f"{passed} of {len(self.reels)} reels pass at cost {self.target:.4g}"
        before, after = self.spread_before, self.spread_after
        if math.isfinite(before):
            said += f"; spread {before:.3g} before, {after:.2g} after"
        return said

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
        """The records, a row for each reel, with the target and the tolerance."""
        import pandas as pd  # noqa: PLC0415  slow to import

        common = {"target": self.target, "tolerance": self.tolerance}
        return pd.DataFrame([{**reel.to_json(), **common} for reel in self.reels])

    def with_reels(self, reels: Sequence[ReelMatch]) -> Self:
        """The same with other records."""
        return type(self)(
            *(self.target, self.by_worst, self.tolerance, self.step, self.cost),
            *(tuple(reels), self.folder),
        )


def classify(level: CostEstimate, target: float, tolerance: float) -> tuple[MatchOutcome, str]:
    """Whether a level is shown to be the target's: its whole interval lies in the tolerance.

    Args:
        level: The level, from fresh repeats.
        target: The cost aimed at.
        tolerance: Relative to it.

    Returns:
        The standing and a sentence.
    """
    low, high = target * (1.0 - tolerance), target * (1.0 + tolerance)
    found = f"cost {level}, allowed {low:.4g} to {high:.4g}"
    if not math.isfinite(level.cost):
        return (
            MatchOutcome.FAILED,
            "a repeat of the matched gains was unsafe; see the run's trials",
        )
    if low <= level.low and level.high <= high:
        return MatchOutcome.PASS, found
    if not low <= level.cost <= high:
        return MatchOutcome.OFF_TARGET, f"{found}; more match trials place it better"
    return MatchOutcome.NOT_SHOWN, f"{found}; more repeats narrow its interval"


def unreachable_message(level: CostEstimate, target: float) -> str:
    """Says that a reel cannot reach the target."""
    return (
        f"its tuned gains cost {level}, above the target {target:.4g}; raise eta, or mend the reel"
    )


def _spread(levels: Sequence[CostEstimate | None]) -> float:
    costs = [level.cost for level in levels if level is not None]
    return stdev(costs) if len(costs) > 1 else math.nan


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
