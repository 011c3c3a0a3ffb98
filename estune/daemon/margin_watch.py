"""Margins of one rig in service, from its check trials and, where it is asked for, a multisine.

The multisine is a trial of the live gains: the rig's guard, deadline and lease are in force, it
moves the setpoint by a stated share of the step for a stated share of the time, and a trial that a
guard ends is the last one.
"""

import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.daemon.check_trials import check_cut_off
from estune.daemon.config import RigTable
from estune.daemon.events import EventKind
from estune.errors import InvalidInput
from estune.loop_model.intervals import Interval
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.service_records.advice import multisine
from estune.service_records.cause.judge import Cause, judge_signals
from estune.service_records.cause.loop_signals import JudgedSignals
from estune.service_records.recommendation import recommend
from estune.service_records.watched_loop import (
    WatchedLoop,
    WatchedMargins,
    judged_margins,
    observe,
)
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest
from estune.trial.loop_records import loop_signals, recomputed_effort
from estune.trial.records import SATURATED

PERIODS = 4
"""Periods of a multisine: 80 settling times, by which a 1 % one shows Ms to 10 to 20 %."""


class MarginReport(NamedTuple):
    """Something to be reported of the margins.

    Attributes:
        gains: Recommended gains, whose limits hold by the upper ends of their intervals; or None.
        is_machine: Whether the actuator or the sensor is at fault, which no tuning mends.
    """

    kind: EventKind
    sentence: str
    gains: Gains | None = None
    is_machine: bool = False


class MarginWatch:
    """Margins of the live gains of one rig.

    Attributes:
        sensitivity: Ms with its interval; None while it is not known.
        sentence: What is known of it; empty before the first record.
        stopped: Why the multisine is no longer added; empty while it is.
    """

    def __init__(self, settings: RigTable, instance: str) -> None:
        self.sensitivity: Interval | None = None
        self.sentence = ""
        self.stopped = ""
        self._settings = settings
        self._instance = instance
        self._known = WatchedLoop()
        self._number = 0
        self._due_s = self._shown_s = -np.inf
        self._taken_s = 0.0  # by multisines that followed each other at once
        self._above = self._fault = False

    @property
    def bounds(self) -> tuple[float | None, ...] | None:
        """`sensitivity` as a message has it: an end without bound is none."""
        found = self.sensitivity
        return found and tuple(end if np.isfinite(end) else None for end in found)

    @property
    def wait_s(self) -> float:
        """Time until the next multisine; infinite without any."""
        if not self._settings.margins.dither or self.stopped:
            return np.inf
        return max(0.0, self._due_s - time.monotonic())

    def take(
        self, check: TrialRecord | None, rig: Rig, description: RigDescription, gains: Gains
    ) -> list[MarginReport]:
        """Takes a check trial, or runs a multisine with the live gains; what is to be reported.

        Raises:
            RigError: the rig cannot be reached.
            Interrupted: the multisine was cut off on a real rig.
        """
        if check is None:
            return self._dither(rig, description, gains)
        if time.monotonic() - self._shown_s < self._settings.margins.every_s:
            return []
        step = self._settings.step.of(description)
        signals = loop_signals(check, step, description).record
        return [] if signals is None else self._observe(signals, description, gains)

    def _dither(self, rig: Rig, description: RigDescription, gains: Gains) -> list[MarginReport]:
        table, step = self._settings.margins, self._settings.step.of(description)
        T, rate = self._settling_time_s(description), description.controller.sampling_Hz
        profile = multisine(step.preload_N, table.dither * abs(step.step_N), T, rate)
        length_s = min(PERIODS * profile.period_s, description.limits.duration_max_s)
        profile = replace(profile, duration_s=length_s)
        if np.isfinite(self._due_s):
            self._taken_s = 0.0
        begun_s = time.monotonic()
        request = TrialRequest(f"{self._instance}-margins", self._number, gains, profile)
        self._number += 1
        try:
            record = rig.run(request)
        except InvalidInput as error:  # the rig's limits do not allow it
            return [self._stop(str(error))]
        finally:
            # One that follows at once is paid for by the wait after it.
            ended_s, self._taken_s = time.monotonic(), self._taken_s + time.monotonic() - begun_s
            wait_s = self._taken_s / table.dither_time - self._taken_s
            self._due_s = max(begun_s + table.every_s, ended_s + wait_s)
        check_cut_off(record, description)
        if record.outcome.is_void:
            return []
        if record.outcome is not Outcome.DONE:
            return [self._stop(record.reason or record.outcome.sentence)]
        effort = recomputed_effort(record, description, 0.0)
        if (record.flags & SATURATED).any():
            self.sentence = "not known: the command was at a limit of the controller"
            return []
        signals = LoopRecord(effort, record.tension_N, record.setpoint_N, gains)
        return self._observe(signals, description, gains)

    def _observe(
        self, record: LoopRecord, description: RigDescription, gains: Gains
    ) -> list[MarginReport]:
        T, settings = self._settling_time_s(description), description.controller
        before = self.sentence
        self._known, changed = observe(self._known, record, settings.sampling_Hz, T)
        if self._known.suspects:
            self._due_s = -np.inf  # the next record says more
            return []
        self._shown_s = time.monotonic()
        found = judged_margins(self._known, self._trial(description), gains, settings)
        Ms, records = found.margins.sensitivity, len(self._known.records)
        if found.judgement.can_tell:
            self.sensitivity = Ms
            of = "1 record" if records == 1 else f"{records} records"
            self.sentence = f"Ms {Ms.value:.2f} ({Ms.low:.2f} to {Ms.high:.2f}), {of}"
        else:
            self.sensitivity = None
            self.sentence = f"cannot tell: {found.judgement.reason}"
        reports = []
        if changed:
            sentence = f"the plant has changed: {self.sentence}; before, {before}"
            reports.append(self._report(EventKind.PLANT, sentence, found, description, gains))
        most = self._settings.margins.max_sensitivity
        above = self.sensitivity is not None and Ms.low > most
        if above and not self._above:
            sentence = f"{self.sentence}: the whole interval is above {most:g}"
            reports.append(self._report(EventKind.MARGINS, sentence, found, description, gains))
        self._above = above
        # A loop that sticks shows no margins: nothing else would say so.
        fault = not found.judgement.can_tell and self._cause(settings.sampling_Hz).is_machine
        if fault and not self._fault and not reports:
            reports.append(
                self._report(EventKind.MARGINS, self.sentence, found, description, gains)
            )
        self._fault = fault
        return reports

    def _report(
        self,
        kind: EventKind,
        sentence: str,
        found: WatchedMargins,
        description: RigDescription,
        gains: Gains,
    ) -> MarginReport:
        """The report with its cause, and with better gains where some keep the limits.

        Where the actuator or the sensor is at fault, no gains are offered.
        """
        cause = self._cause(description.controller.sampling_Hz)
        if cause.name != "unknown":
            sentence = f"{sentence}; {cause.heading().rstrip('.')}"
        if not found.judgement.can_tell or cause.is_machine:
            return MarginReport(kind, sentence, is_machine=cause.is_machine)
        limits = self._settings.tuning.limits or RobustnessLimits()
        better = recommend(found.loop, self._trial(description), gains, limits)
        if better is None:
            return MarginReport(kind, sentence)
        return MarginReport(
            kind, f"{sentence}; {better.gains} is predicted to be within the limits", better.gains
        )

    def _cause(self, sampling_Hz: float) -> Cause:
        newest = self._known.records[-1]
        return judge_signals(
            JudgedSignals(newest.setpoint, newest.measurement, newest.effort, 1.0 / sampling_Hz)
        )

    def _stop(self, why: str) -> MarginReport:
        self.stopped = why
        return MarginReport(
            EventKind.DITHER, f"no multisine is added any more until the daemon restarts: {why}"
        )

    def _settling_time_s(self, description: RigDescription) -> float:
        return self._settings.cost.of(description).settling_time_s

    def _trial(self, description: RigDescription) -> StepTrial:
        step, settings = self._settings.step.of(description), description.controller
        rate, cost = settings.sampling_Hz, self._settings.cost.of(description)
        return StepTrial(settings, cost, step.preload_N, step.shape(rate), step.samples(rate))
