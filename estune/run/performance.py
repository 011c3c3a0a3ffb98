"""Performance of gains on a rig: cost, step metrics and margins."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from estune.core.gains import GAIN_NAMES, GAIN_UNITS, Gains
from estune.core.metrics import StepMetrics
from estune.interop import Margins, margins
from estune.trial import RigDescription, TrialRecord
from estune.trial.profiles import StepProfile
from estune.trial.scoring import metrics_of


@dataclass(frozen=True, slots=True)
class Performance:
    """Performance of gains on a rig.

    Attributes:
        gains: The gains.
        cost: Mean cost of their repeats; nan or infinite where there is none.
        cost_error: Standard error of that mean.
        metrics: Step metrics of `record`.
        margins: Gain and phase margins on the rig's linear model, or None without a model.
        record: A trial with these gains, or None.
        intervals: 95 % confidence interval of the optimum of each tuned gain, by name; may be
            empty.
    """

    gains: Gains
    cost: float
    cost_error: float
    metrics: StepMetrics | None
    margins: Margins | None
    record: TrialRecord | None
    intervals: dict[str, tuple[float, float]]

    @classmethod
    def on(
        cls,
        rig: RigDescription,
        step: StepProfile,
        gains: Gains,
        cost: tuple[float, float],
        *,
        record: TrialRecord | None,
        intervals: tuple[tuple[str, float, float], ...] = (),
    ) -> Self:
        """The performance from the cost and its standard error, a record, and intervals."""
        model = rig.linear_model
        return cls(
            gains,
            *cost,
            metrics=None if record is None else metrics_of(record, step),
            margins=None if model is None else margins(model, gains, rig.controller),
            record=record,
            intervals={name: (low, high) for name, low, high in intervals},
        )

    def cells(self) -> dict[str, str]:
        """All values as text, by label."""
        cells = {
            _GAIN_LABELS[name]: (
                f"{getattr(self.gains, name):.4g} {GAIN_UNITS[name]}{self._interval(name)}"
            )
            for name in GAIN_NAMES
        }
        error = f" ± {self.cost_error:.1g}" if self.cost_error > 0.0 else ""
        cells["cost η"] = f"{self.cost:.3g}{error}" if math.isfinite(self.cost) else "-"
        return {**cells, **dict(_metric_cells(self.metrics)), **dict(_margin_cells(self.margins))}

    def _interval(self, name: str) -> str:
        """The interval of a gain, appended to its value."""
        if name not in self.intervals:
            return ""
        low, high = self.intervals[name]
        return f" ({low:.3g} to {high:.3g})"


_GAIN_LABELS = {"P": "P", "I": "I", "D": "D", "setpoint_filter_s": "setpoint filter"}


def _metric_cells(metrics: StepMetrics | None) -> Iterator[tuple[str, str]]:
    def shown(value: float | None, scale: float, unit: str, never: str) -> str:
        if value is None:
            return "-"
        return f"{value * scale:.3g} {unit}" if math.isfinite(value) else never

    m = metrics
    yield "rise time", shown(m and m.rise_time_s, 1e3, "ms", "not reached")
    yield "settling time (2 %)", shown(m and m.settling_time_s, 1e3, "ms", "not settled")
    yield "overshoot", shown(m and m.overshoot, 100.0, "%", "-")
    yield "steady-state error", shown(m and m.steady_state_error, 1.0, "N", "-")


def _margin_cells(measured: Margins | None) -> Iterator[tuple[str, str]]:
    if measured is None:
        yield from (("gain margin", "-"), ("phase margin", "-"))
    elif not measured.stable:
        yield from (("gain margin", "unstable"), ("phase margin", "unstable"))
    else:
        gain_dB, angle = 20.0 * math.log10(measured.gain_margin), measured.phase_margin_deg
        yield "gain margin", f"{gain_dB:.1f} dB" if math.isfinite(gain_dB) else "∞"
        yield "phase margin", f"{angle:.0f}°" if math.isfinite(angle) else "∞"
