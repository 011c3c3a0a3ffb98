"""Performance of gains on a rig: cost, step metrics and margins."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from estune.core.gains import Gains
from estune.core.metrics import LoadMetrics, StepMetrics
from estune.interop import Margins, margins
from estune.support.quantity_text import time_text, with_unit
from estune.trial import RigDescription, TrialRecord
from estune.trial.profiles import StepProfile
from estune.trial.scoring import load_metrics_of, metrics_of


@dataclass(frozen=True, slots=True)
class Performance:
    """Performance of gains on a rig.

    Attributes:
        gains: The gains.
        cost: Mean cost of their repeats; nan or infinite where there is none.
        cost_error: Standard error of that mean.
        metrics: Step metrics of `record`.
        load: Metrics of its response to a load; None without one.
        margins: Gain and phase margins on the rig's linear model, or None without a model.
        record: A trial with these gains, or None.
        intervals: 95 % confidence interval of the optimum of each tuned gain, by name; may be
            empty.
        rig: The rig.
    """

    gains: Gains
    cost: float
    cost_error: float
    metrics: StepMetrics | None
    load: LoadMetrics | None
    margins: Margins | None
    record: TrialRecord | None
    intervals: dict[str, tuple[float, float]]
    rig: RigDescription

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
            load=None if record is None else load_metrics_of(record, step),
            margins=None if model is None else margins(model, gains, rig.controller),
            record=record,
            intervals={name: (low, high) for name, low, high in intervals},
            rig=rig,
        )

    def cells(self) -> dict[str, str]:
        """All values as text, by label."""
        cells = {
            _GAIN_LABELS[name]: (
                f"{with_unit(getattr(self.gains, name), unit, 4)}{self._interval(name)}"
            )
            for name, unit in self.rig.gain_units.items()
        }
        error = f" ± {self.cost_error:.1g}" if self.cost_error > 0.0 else ""
        cells["cost η"] = f"{self.cost:.3g}{error}" if math.isfinite(self.cost) else "-"
        metrics = _metric_cells(self.metrics, self.rig)
        load = _load_cells(self.load, self.rig)
        return {**cells, **dict(metrics), **dict(load), **dict(margin_cells(self.margins))}

    def _interval(self, name: str) -> str:
        """The interval of a gain, appended to its value."""
        if name not in self.intervals:
            return ""
        low, high = self.intervals[name]
        return f" ({low:.3g} to {high:.3g})"


_GAIN_LABELS = {"P": "P", "I": "I", "D": "D", "setpoint_filter_s": "setpoint filter"}


def _metric_cells(metrics: StepMetrics | None, rig: RigDescription) -> Iterator[tuple[str, str]]:
    if metrics is None:
        labels = ("rise time", "settling time (2 %)", "overshoot", "steady-state error")
        yield from dict.fromkeys(labels, "-").items()
        return
    rise_s, settling_s, overshoot, error = metrics
    yield "rise time", time_text(rise_s) if math.isfinite(rise_s) else "not reached"
    settled = math.isfinite(settling_s)
    yield "settling time (2 %)", time_text(settling_s) if settled else "not settled"
    yield "overshoot", f"{100.0 * overshoot:.3g} %" if math.isfinite(overshoot) else "-"
    yield "steady-state error", rig.measured(error, 3) if math.isfinite(error) else "-"


def _load_cells(load: LoadMetrics | None, rig: RigDescription) -> Iterator[tuple[str, str]]:
    if load is None:
        return
    recovered = math.isfinite(load.recovery_time_s)
    yield "peak after the load", rig.measured(load.peak, 3)
    yield (
        "recovery time (2 %)",
        time_text(load.recovery_time_s) if recovered else "not recovered",
    )


def margin_cells(measured: Margins | None) -> Iterator[tuple[str, str]]:
    """Gain margin in dB and phase margin in degrees as text, by label."""
    if measured is None:
        yield from (("gain margin", "-"), ("phase margin", "-"))
    elif not measured.stable:
        yield from (("gain margin", "unstable"), ("phase margin", "unstable"))
    else:
        gain_dB, angle = 20.0 * math.log10(measured.gain_margin), measured.phase_margin_deg
        yield "gain margin", f"{gain_dB:.1f} dB" if math.isfinite(gain_dB) else "∞"
        yield "phase margin", f"{angle:.0f}°" if math.isfinite(angle) else "∞"
