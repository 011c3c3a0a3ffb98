"""What a run found: its conclusion, and the performance of gains on its rig."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import fmean, variance
from typing import Self

from estune.core.comparison import Change, InterleavedRepeats
from estune.core.gains import Gains
from estune.core.metrics import LoadMetrics, StepMetrics
from estune.interop import Margins, margins
from estune.run.plan import Plan
from estune.run.session import Session
from estune.support.quantity_text import interval_text, time_text, with_unit
from estune.trial import RigDescription, TrialRecord
from estune.trial.profiles import StepProfile
from estune.trial.scoring import load_metrics_of, metrics_of

INTERVALS_ARE = (
    "the interval of a gain contains the optimum with 95 % confidence and, where the loop is "
    "identified, the values of this gain alone whose predicted cost is at most 2 % higher"
)


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Summary of a run.

    Attributes:
        gains: The gains to use: the tuned ones, or the initial ones without an improvement.
        cost: Their mean cost over the repeats.
        cost_error: Standard error of `cost`; zero without repeats.
        start_cost: Mean cost of the initial gains, from the confirmation if there was one.
        change: Relative change of the cost from the initial to the tuned gains, with its 95 %
            confidence interval, from interleaved repeats; None if they were not compared.
        intervals: Interval of each tuned parameter, by the tuner's cost model: name, lower and
            upper end in the parameter's unit. May be empty. `INTERVALS_ARE` says what it is.
        improved: Whether the interval of the change lies below zero, or the initial gains break a
            limit that the tuned ones keep.
        complete: Whether the run is complete; otherwise `gains` are the initial ones.
    """

    gains: Gains
    cost: float
    cost_error: float
    start_cost: float
    start_cost_error: float
    change: Change | None
    intervals: tuple[tuple[str, float, float], ...]
    unsafe: int
    declined: int
    improved: bool
    message: str
    complete: bool


def summarise(session: Session) -> RunSummary:
    """Summary of a run, complete or not."""
    plan, repeats = session.plan, session.confirmation
    complete = session.phase is None and not session.failure
    compared = repeats if complete and repeats is not None and len(repeats.safe) == 2 else None
    change = None if compared is None else compared.change()
    improved = change is not None and change.is_decrease
    start_costs = session.baseline if compared is None else compared.costs[0]
    start = _mean(start_costs)
    best = _mean(compared.costs[1]) if compared is not None and improved else start
    return RunSummary(
        gains=compared.gains[1] if compared is not None and improved else plan.start,
        cost=best[0],
        cost_error=best[1],
        start_cost=start[0],
        start_cost_error=start[1],
        change=change,
        intervals=_intervals(session),
        unsafe=session.unsafe,
        declined=session.declined,
        improved=improved,
        message=_message(session, repeats, change)
        if complete
        else session.failure
        or f"stopped after {session.number} trials, before any gains were confirmed",
        complete=complete,
    )


def not_robust_summary(summary: RunSummary, plan: Plan, fault: str) -> RunSummary:
    """The summary of a run that improved the cost by gains that are not robust."""
    return replace(
        summary,
        gains=plan.start,
        cost=summary.start_cost,
        cost_error=summary.start_cost_error,
        improved=False,
        message=f"the tuned gains are not robust: {fault}; keep the initial gains",
    )


def within_limits_summary(summary: RunSummary, session: Session, broken: str) -> RunSummary:
    """The summary of a run whose initial gains break a limit that the confirmed ones keep."""
    repeats = session.confirmation
    assert repeats is not None  # noqa: S101  confirmed gains were repeated
    cost, error = _mean(repeats.costs[1])
    return replace(
        summary,
        gains=repeats.gains[1],
        cost=cost,
        cost_error=error,
        improved=True,
        message=f"the initial gains have {broken}, the tuned ones keep the limits; they change "
        f"the cost by {summary.change}; {session.search_end}",
    )


def _message(session: Session, repeats: InterleavedRepeats | None, change: Change | None) -> str:
    """The conclusion of a complete run."""
    if repeats is None:
        reason = (
            "all candidate gains were unsafe when repeated"
            if session.choice is not None and session.choice.best is None
            else "the search returned to the initial gains"
        )
        return f"{reason}; keep the initial gains; {session.search_end}"
    if change is None:
        which = "tuned" if repeats.safe == (0,) else "initial"
        reason = f"the {which} gains were unsafe when repeated: check the rig"
        return f"{reason}; nothing was confirmed; {session.search_end}"
    if change.is_decrease:
        start, cost = (fmean(costs) for costs in repeats.costs)
        return f"the cost fell from {start:.3g} to {cost:.3g}, {change}; {session.search_end}"
    return (
        f"no significant improvement: the best gains change the cost by {change}; "
        f"keep the initial gains; {session.search_end}"
    )


def _intervals(session: Session) -> tuple[tuple[str, float, float], ...]:
    convergence = session.plan.convergence(session.tuner_state)
    if convergence is None:
        return ()
    space = session.plan.tuner.space
    used = space.point_of(session.candidate or session.plan.start)
    rows = zip(space.names, used, convergence.intervals, strict=True)
    return tuple((name, min(low, at), max(high, at)) for name, at, (low, high) in rows)


def _mean(costs: tuple[float, ...]) -> tuple[float, float]:
    if not costs:
        return math.nan, 0.0
    return fmean(costs), math.sqrt(variance(costs) / len(costs)) if len(costs) > 1 else 0.0


@dataclass(frozen=True, slots=True)
class Performance:
    """Performance of gains on a rig.

    Attributes:
        cost: Mean cost of their repeats; nan or infinite where there is none.
        load: Metrics of its response to a load; None without one.
        margins: Gain and phase margins on the rig's linear model, or None without a model.
        record: A trial with these gains, or None.
        intervals: 95 % confidence interval of the optimum of each tuned gain, by name; may be
            empty.
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
            _GAIN_LABELS[name]: self._gain(name, unit)
            for name, unit in self.rig.gain_units.items()
        }
        error = f" ± {self.cost_error:.1g}" if self.cost_error > 0.0 else ""
        cells["cost η"] = f"{self.cost:.3g}{error}" if math.isfinite(self.cost) else "-"
        metrics = _metric_cells(self.metrics, self.rig)
        load = _load_cells(self.load, self.rig)
        return {**cells, **dict(metrics), **dict(load), **dict(margin_cells(self.margins))}

    def _gain(self, name: str, unit: str) -> str:
        value = getattr(self.gains, name)
        ends = self.intervals.get(name)
        return with_unit(value, unit, 4) if ends is None else interval_text(value, ends, unit, 4)


_SHARES = ("overshoot", "undershoot")
_GAIN_LABELS = {"P": "P", "I": "I", "D": "D", "setpoint_filter_s": "setpoint filter"}


def _metric_cells(metrics: StepMetrics | None, rig: RigDescription) -> Iterator[tuple[str, str]]:
    if metrics is None:
        labels = ("rise time", "settling time (2 %)", *_SHARES, "steady-state error", "IAE")
        yield from dict.fromkeys(labels, "-").items()
        return
    settling_s, error, iae = metrics.settling_time_s, metrics.steady_state_error, metrics.iae
    yield "rise time", rise_text(metrics)
    settled = math.isfinite(settling_s)
    yield "settling time (2 %)", time_text(settling_s) if settled else "not settled"
    for label in _SHARES:
        yield label, share_text(getattr(metrics, label))
    yield "steady-state error", rig.measured(error, 3) if math.isfinite(error) else "-"
    unit = f"{rig.measurement_unit} s".strip()
    yield "IAE", with_unit(iae, unit, 3) if math.isfinite(iae) else "-"


def rise_text(metrics: StepMetrics) -> str:
    """The rise time with its unit."""
    rise_s = metrics.rise_time_s
    return time_text(rise_s) if math.isfinite(rise_s) else "not reached"


def share_text(share: float) -> str:
    """A fraction of the step in per cent."""
    return f"{100.0 * share:.3g} %" if math.isfinite(share) else "-"


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
