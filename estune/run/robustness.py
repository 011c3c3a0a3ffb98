"""Robustness of gains as the records of a run show it, or why nothing is claimed."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.comparison import Change, interval_factor
from estune.core.gains import Gains
from estune.core.metrics import BAND, NOISE_SIGMAS, steady_samples
from estune.core.quantities import FloatArray
from estune.loop_model.claim import Claim, claim
from estune.loop_model.excitation import UnknownLoop
from estune.loop_model.fitting import fit_with_excitations
from estune.loop_model.half_widths import half_widths
from estune.loop_model.intervals import PredictedMargins
from estune.loop_model.limit_price import LimitPrice, price_of
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import robustness
from estune.loop_model.model import close_loop
from estune.loop_model.near_fit import fit_near, is_explained
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import expected_response
from estune.loop_model.records import LoopRecord
from estune.run.limit_verdict import (
    LimitState,
    LimitVerdict,
    limit_verdict,
    measured_overshoot,
)
from estune.run.missing_trials import MissingTrials, missing_trials
from estune.run.plan import Plan
from estune.run.planning import step_trial
from estune.run.tuning_run import TuningRun
from estune.support.blas import one_blas_thread
from estune.trial import Outcome, RigDescription, TrialRecord
from estune.trial.loop_records import loop_signals
from estune.tuners.identified_loop_state import fit_of

RECORDS_MAX = 20
"""Records that are fitted: the last ones of a run."""

SENSITIVITY_ROBUST = 2.5
"""Ms above which gains are not robust. On simulated reels it separates tunings that noise, slow
sampling or a short settling time spoiled (Ms 3.3 and more) from the others (up to 2.1)."""

END_ERROR = 0.005
"""Error at the end of a trial, as a share of the step, that is always allowed."""


class StepRecord(NamedTuple):
    """A step trial whose record identifies the loop.

    Attributes:
        signals: The same as the fit takes it.
    """

    record: TrialRecord
    signals: LoopRecord


class IdentifiedLoop(NamedTuple):
    """The loop identified from the records of a run.

    Attributes:
        fit: The fit; None where no record can be used.
        reason: Why there is no fit; empty where there is one.
        steps: The step trials that were fitted.
        remarks: Why others were not, a sentence for each reason.
    """

    fit: LoopFit | None
    reason: str = ""
    steps: tuple[StepRecord, ...] = ()
    excitations: tuple[LoopRecord, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def signals(self) -> tuple[LoopRecord, ...]:
        """The records in the order of the fit: step trials, then excitations."""
        return (*(step.signals for step in self.steps), *self.excitations)

    def expected_response(
        self, plan: Plan, rig: RigDescription, gains: Gains
    ) -> FloatArray | None:
        """Response with some gains, shape (samples,); None where their loop is not robust.

        Without friction: what that makes a loop do at the end of a trial it may do for ever.
        """
        if self.fit is None:
            return None
        if not robustness(self.fit.model, gains, rig.controller).sensitivity <= SENSITIVITY_ROBUST:
            return None
        trial = step_trial(rig, plan.step, plan.cost)
        trial = replace(trial, rest_effort=self.signals[0].rest_effort)
        return expected_response(self.fit.model._replace(friction=0.0), trial, gains)

    def loads(self, rig: RigDescription) -> dict[str, FloatArray]:
        """What load and drift add to the measurements of the step trials, by their ids.

        Empty where the fit knows of none.
        """
        if self.fit is None or not self.fit.is_loaded:
            return {}
        found = dict[str, FloatArray]()
        for step, left in zip(self.steps, self.fit.unexplained, strict=False):
            gains = step.record.gains
            if math.isfinite(robustness(self.fit.model, gains, rig.controller).sensitivity):
                loop = close_loop(self.fit.model, gains, rig.controller)
                found[step.record.trial_id] = loop.noise_response(left)[0]
        return found

    def undisturbed(self, records: Iterable[TrialRecord]) -> list[TrialRecord]:
        """The records that the loop rests on, and all records of gains of which it has none.

        Not those that the others contradict, nor those that do not follow from their gains.
        """
        out = () if self.fit is None else self.fit.left_out
        kept = [step.record for i, step in enumerate(self.steps) if i not in out]
        known, shown = {r.trial_id for r in kept}, {r.gains for r in kept}
        return [r for r in records if r.trial_id in known or r.gains not in shown]


@one_blas_thread()
def identify(
    records: Sequence[TrialRecord],
    excitations: Sequence[TrialRecord],
    plan: Plan,
    rig: RigDescription,
    *,
    own: LoopFit | None = None,
    gains: Gains | None = None,
) -> IdentifiedLoop:
    """The loop identified from the last step trials of a run and its excitations.

    Where no linear model explains them, it is that of the trials near the gains in question.

    Args:
        records: Records of step trials.
        excitations: Those of excitations.
        plan: The plan of the run.
        rig: The rig.
        own: The fit of the tuner, from which the search begins.
        gains: The gains in question; None for the loop of all records.
    """
    records = records[-RECORDS_MAX:]
    steps, reasons = list[StepRecord](), Counter[str]()
    for record in records:
        made = loop_signals(record, plan.step, rig)
        if made.record is None:
            reasons[made.reason] += 1
        else:
            steps.append(StepRecord(record, made.record))
    remarks = tuple(
        f"{count} of the last {len(records)} records cannot identify the loop: {reason}"
        for reason, count in reasons.items()
    )
    if not steps:
        reason = next(iter(reasons), "there are no records of it")
        return IdentifiedLoop(None, reason, remarks=remarks)
    made_of = (loop_signals(record, plan.step, rig).record for record in excitations)
    excited = tuple(record for record in made_of if record is not None)
    signals = [step.signals for step in steps]
    rate, asked_s = rig.controller.sampling_Hz, plan.cost.settling_time_s
    fit, kept = fit_with_excitations(signals, excited, rate, asked_s, own)
    if gains is not None and not is_explained(fit):
        near = fit_near(gains, signals, excited, rate, asked_s, misfit=fit.misfit)
        if near is not None:
            steps = [steps[i] for i in near.steps]
            fit, kept = near.fit, near.excitations
    return IdentifiedLoop(fit, "", tuple(steps), kept, remarks)


@one_blas_thread()
def claim_from(loop: IdentifiedLoop, plan: Plan, rig: RigDescription, gains: Gains) -> Claim:
    """The margins of some gains by an identified loop."""
    if loop.fit is None:
        return Claim(None, loop.reason, math.nan)
    return claim(loop.fit, loop.signals, step_trial(rig, plan.step, plan.cost), gains)


def limit_price(
    loop: IdentifiedLoop, claimed: Claim, plan: Plan, rig: RigDescription, gains: Gains
) -> LimitPrice | None:
    """The price of the plan's limits; None where no margins are claimed, or none are kept."""
    limits, space = plan.limits, plan.tuner.space
    if claimed.margins is None or loop.fit is None or not plan.uses_records:
        return None
    if limits is None or limits == RobustnessLimits(None, None, None):
        return None
    low, high = np.array(space.coordinate_bounds)
    trial = step_trial(rig, plan.step, plan.cost)
    return price_of(
        loop.fit,
        trial,
        limits,
        lambda x: space.gains(space.point(tuple(x.tolist()))),
        at=np.array(space.coordinates(space.point_of(gains))),
        bounds=(low, high),
        beside=half_widths(loop.fit, loop.signals, trial, gains, repeats=0),
    )


class Verdict(NamedTuple):
    """Robustness of the confirmed gains by the records of a complete run.

    Attributes:
        fault: Why they are not robust; empty where they are.
        broken: Limits that the initial gains break and the confirmed ones keep, in words; empty
            where there are none.
        missing: Trials that would show that the limits are kept.
    """

    fault: str = ""
    broken: str = ""
    loop: IdentifiedLoop | None = None
    claim: Claim | None = None
    limits: LimitVerdict = LimitVerdict()
    missing: MissingTrials = MissingTrials()


def verdict_on(run: TuningRun, change: Change | None) -> Verdict:
    """Robustness of the confirmed gains by the records of a complete run, which keeps it.

    Args:
        run: The run.
        change: Change of the cost by these gains; None where they were not confirmed.
    """
    about = change, len(run.entries)
    if run.judged is None or run.judged[:2] != about:
        run.judged = (*about, _judged(run, change))
    verdict: Verdict = run.judged[2]
    return verdict


def _judged(run: TuningRun, change: Change | None) -> Verdict:
    gains, plan, rig = run.session.candidate, run.plan, run.description
    if gains is None or change is None or plan.limits is None:
        return Verdict()
    records, own = list(run.recent_records), fit_of(run.session.tuner_state)
    loop = identify(records, run.excitations, plan, rig, own=own, gains=gains)
    claimed = claim_from(loop, plan, rig, gains)
    broken = ""
    if not change.is_decrease and claimed.margins and plan.limits.broken_by(claimed.margins) == "":
        if loop.fit is None or not loop.fit.near_error:
            at_start = loop
        else:
            at_start = identify(records, run.excitations, plan, rig, own=own, gains=plan.start)
        start = claim_from(at_start, plan, rig, plan.start)
        broken = plan.limits.broken_by(start.margins) if start.margins else ""
    if not (change.is_decrease or broken):
        return Verdict(loop=loop, claim=claimed)
    records = loop.undisturbed(records)
    expected = loop.expected_response(plan, rig, gains)
    loads = loop.loads(rig)
    unloaded = [less_load(record, loads) for record in records]
    fault = not_robust(unloaded, plan, claimed, gains, rig, expected=expected)
    limits, missing = limit_verdict(plan, claimed, gains, records), MissingTrials()
    if limits.state is LimitState.NOT_SHOWN and loop.fit is not None:
        done = sum(r.outcome is Outcome.DONE and r.gains == gains for r in records)
        overshoot = measured_overshoot(plan, gains, records, claimed), done
        unknown = UnknownLoop(loop.fit, loop.signals, gains, gains, rig.controller)
        missing = missing_trials(unknown, claimed, overshoot, plan, rig)
        if missing.repeats is not None:
            needed = done + missing.repeats
            more = f"; about {needed} repeats would show it (--repeats {needed})"
            limits = limits._replace(reason=limits.reason + more)
    return Verdict(fault, broken, loop, claimed, limits, missing)


def less_load(record: TrialRecord, loads: Mapping[str, FloatArray]) -> TrialRecord:
    """The record without what load and drift add to its measurement."""
    load = loads.get(record.trial_id)
    return record if load is None else replace(record, tension_N=record.tension_N - load)


def not_robust(
    records: Iterable[TrialRecord],
    plan: Plan,
    claimed: Claim,
    gains: Gains,
    rig: RigDescription,
    *,
    expected: FloatArray | None = None,
) -> str:
    """Why tuned gains are not robust; empty where they are, or in a plan without limits.

    The records with these gains have to settle, but for what a known loop still does at the end of
    a trial that is short for it, without an error at their end beyond their noise and that of the
    initial gains, which dry friction leaves with any gains. Ms, if it is claimed, may not be above
    `SENSITIVITY_ROBUST` unless the plan has no limit of it.

    Args:
        records: Those of the run.
        plan: Its plan.
        claimed: What is claimed of the gains.
        gains: The gains.
        rig: The rig.
        expected: Their response by the identified loop, shape (samples,); None where that is
            not known.
    """
    if plan.limits is None:
        return ""
    margins = claimed.margins
    if plan.limits.max_sensitivity is not None and margins is not None:
        Ms = margins.sensitivity.value
        if Ms > max(SENSITIVITY_ROBUST, plan.limits.max_sensitivity):
            return f"the sensitivity Ms is {Ms:.2g}, above {SENSITIVITY_ROBUST:g}"
    done = [r for r in records if r.outcome is Outcome.DONE]
    repeats = [r for r in done if r.gains == gains]
    if not repeats:
        return ""
    step, first = plan.step, repeats[0]
    index, final = step.step_index(first.sampling_Hz), step.preload_N + step.step_N
    responses = np.array([record.tension_N for record in repeats])
    error, allowed = _end_error(responses[:, index:], final)
    allowed = max(allowed, END_ERROR * abs(step.step_N))
    if before := [r.tension_N[index:] for r in done if r.gains == plan.start]:
        left, explained = _end_error(np.array(before), final)
        allowed += abs(left) + explained
    if abs(error) > allowed:
        ends = f"{error:+.2g} {rig.measurement_unit}".rstrip()
        return f"the response ends {ends} off its setpoint (allowed {rig.measured(allowed, 2)})"
    if _swing(responses, expected) > BAND * abs(step.step_N):
        return "the response has not settled at the end of the trial"
    return ""


def _swing(responses: FloatArray, expected: FloatArray | None) -> float:
    """Amplitude of a sine of the power with which responses move in their last tenth.

    About the value they end at, beyond what is expected, and without their noise: its power is
    taken off that of each response, with three standard deviations of what it scatters by. By
    its largest value a loop that cycles in noise as large would pass for noise.
    """
    count = steady_samples(responses.shape[1])
    tail = responses[:, -count:]
    if expected is not None:
        tail = tail - expected[-count:]
    moves = tail - tail.mean(axis=1, keepdims=True)
    noise = _white_noise(tail) ** 2 * (1.0 + 3.0 * math.sqrt(2.0 / tail.size))
    return math.sqrt(2.0 * max(float(np.mean(moves**2)) - noise, 0.0))


def _end_error(responses: FloatArray, final: float) -> tuple[float, float]:
    """Mean error over the last tenth of the responses, and what their noise explains of it."""
    tail = responses[:, -steady_samples(responses.shape[1]) :]
    count = tail.shape[0]
    explained = NOISE_SIGMAS * _white_noise(tail) / math.sqrt(tail.size)
    if count > 1:
        spread = float(np.std(tail.mean(axis=1), ddof=1)) / math.sqrt(count)
        explained = max(explained, interval_factor(count - 1) * spread)
    return float(tail.mean()) - final, explained


def _white_noise(responses: FloatArray) -> float:
    """Standard deviation of white noise, by first differences of responses by rows."""
    moves = np.diff(responses, axis=1)
    return float(np.std(moves)) / math.sqrt(2.0) if moves.size else 0.0


def robustness_cells(margins: PredictedMargins | None) -> Iterator[tuple[str, str]]:
    """Sensitivity and phase margin as text, by label."""
    if margins is None:
        yield from (("sensitivity Ms (records)", "-"), ("phase margin (records)", "-"))
        return
    Ms, angle = margins.sensitivity, margins.phase_margin_deg
    low, value, high = (f"{at:.2f}" for at in (Ms.low, Ms.value, Ms.high))
    yield "sensitivity Ms (records)", value + ("" if low == high else f" ({low} to {high})")
    low, value, high = (f"{at:.0f}" for at in (angle.low, angle.value, angle.high))
    yield "phase margin (records)", f"{value}°" + ("" if low == high else f" ({low} to {high})")
