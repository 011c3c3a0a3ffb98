"""From logs of a running loop to its margins and to better gains."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.cost import StepCost, cost_from
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.response import CostFunction, LoadStep, StepShape
from estune.errors import InvalidInput
from estune.loop_model.intervals import PredictedMargins
from estune.loop_model.load_rejection import gain_within
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.recordings.loop_log import LoopLog
from estune.service_records.actuator import may_stick
from estune.service_records.advice import advise
from estune.service_records.cause.beside_loop import of_others, with_better, with_margins
from estune.service_records.cause.judge import Cause, judge_cause, of_most
from estune.service_records.cause.valve import Valve
from estune.service_records.gain_sets import cut, gain_sets
from estune.service_records.identification import (
    ServiceLoop,
    ServicePart,
    identify,
    settling_time,
)
from estune.service_records.judged_records import JudgedRecords, Verdict
from estune.service_records.judgement import Judgement, judge, margins_of
from estune.service_records.passed_wave import with_passed_wave
from estune.service_records.recommendation import Recommendation, recommend
from estune.service_records.replay import Replay
from estune.service_records.sources import Logs, check_names, gains_of, read_logs
from estune.service_records.stretches import SHORTEST, LeftOut, unused, whole_stretches
from estune.support.blas import one_blas_thread

TRIAL_SPAN = 3.0
"""Duration of the predicted step response, settling times."""

WORTHWHILE = 0.05
"""Decrease of the cost from which other gains are recommended, where all that the records allow
is a decrease."""


class GainsUnknown(InvalidInput):
    """No gains are known, so that the cause alone is told.

    Attributes:
        cause: Whether it is the tuning or the machine.
    """

    def __init__(self, needed: str, cause: Cause) -> None:
        super().__init__(needed)
        self.cause = cause


class Suggestion(JudgedRecords):
    """Margins and better gains, with their report."""

    def report(self, path: Path | str) -> None:
        """Writes the page: table, figures, what was used and what is missing.

        Raises:
            InvalidInput: the file cannot be written.
        """
        from estune.service_records.page import page  # noqa: PLC0415  slow to import
        from estune.support import html_page  # noqa: PLC0415  as above

        html_page.write(page(self), Path(path))


@one_blas_thread()
def suggest(
    records: Path | str | Logs | Sequence[Path | str] | Sequence[LoopLog],
    *,
    gains: Gains | Mapping[str, Gains] | None = None,
    columns: Mapping[str, str] | None = None,
    sampling_Hz: float | None = None,
    derivative_filter_s: float | None = None,
    form: ControllerForm | None = None,
    reverse: bool = False,
    settling_time_s: float | None = None,
    step: float | None = None,
    cost: StepCost | str | CostFunction | None = None,
    trial: StepTrial | None = None,
    limits: RobustnessLimits | None = None,
    progress: Callable[[str, float], None] = lambda _phase, _done: None,
) -> Suggestion:
    """Margins of a running loop and better gains, from records of its ordinary service.

    Args:
        records: A file of any known format, a folder of them, several of both, a run, or logs.
            The gains in use are those of the last log; those of a folder are in the order of
            their names, run2 before run10.
        gains: The gains that ran, of all logs or by the log's name; of the logs' metadata by
            default.
        columns: Channels of `time`, `setpoint`, `measurement` and `effort` that are not found by
            their names.
        sampling_Hz: Rate, where the logs have no times.
        derivative_filter_s: Time constant of the derivative filter, s; none by default.
        form: Form of the controller's difference equation; estune's own by default.
        reverse: Whether more effort lowers the measurement.
        settling_time_s: Settling time asked of a step; that of the gains in use by default.
        step: Step that the predictions are for; the range of the setpoint by default.
        cost: What the recommended gains minimise, as `estune.tune` takes it. A `StepCost` has the
            settling time in it; (35) with a control-move penalty by default.
        trial: The step trial that costs and overshoots are predicted for; then `cost`, `step` and
            the settling time are its own.
        limits: What the recommended gains keep; Ms 1.6 and overshoot 5 % by default.
        progress: Called with the phase in words and about the share of the work that is done.

    Raises:
        InvalidInput: there is no usable log.
        GainsUnknown: no gains are known; it has the cause that the logs show.

    Example::

        suggestion = estune.suggest("logs", gains=estune.Gains(2.0, 0.5, 0.0, 0.0))
        print(suggestion.heading())
    """
    logs = _logs(records, columns, sampling_Hz, reverse=reverse)
    limits = limits or RobustnessLimits()
    settings = logs.controller or ControllerSettings(
        logs.logs[0].sampling_Hz, derivative_filter_s or 0.0, -math.inf, math.inf, form
    )
    # Not before: a log that cannot be read is refused in one line, with no progress above it.
    progress("looking for the cause", 0.05)
    judged = [judge_cause(log) for log in logs.logs]
    cause = of_most(judged)
    progress("replaying the effort", 0.1)
    parts, left_out, replays = _usable(logs, gains, settings, cause)
    decides = replays[-1][1] if replays else None
    if decides is not None and decides.explained and decides.controller is not None:
        settings = decides.controller
    in_use = parts[-1].gains
    if trial is not None:
        cost = trial.cost
    if isinstance(cost, StepCost):
        settling_time_s = cost.settling_time_s
    progress("identifying the loop", 0.15)
    loop = identify(parts, settings, settling_time_s)
    if trial is None:
        trial = _trial(loop, in_use, settling_time_s, step, cost or "paper")
    # The limits of the effort are about a level that the records do not name.
    limitless = replace(trial.controller, output_min_N=-math.inf, output_max_N=math.inf)
    trial = replace(trial, controller=limitless)
    progress("judging what the logs show", 0.65)
    margins, margin = margins_of(loop, trial, in_use)
    is_thin = decides is not None and decides.is_thin
    judgement = judge(loop, in_use, margins, margin, is_thin=is_thin)
    known = margins.sensitivity if judgement.can_tell else None
    cause = of_most([with_margins(_beside(loop, one, judgement), known) for one in judged])
    judgement = _for_machine(judgement, cause, loop)
    progress("looking for better gains", 0.8)
    better = recommend(loop, trial, in_use, limits) if judgement.can_tell else None
    holds = math.isfinite(margins.sensitivity.value)
    identified = loop if judgement.can_tell and holds else None
    cause = with_passed_wave(cause, identified, in_use, better and better.gains)
    if better is None and judgement.can_tell and not holds:
        judgement = judgement._replace(
            reason="the loop is unstable, and no gains are known to hold"
        )
    verdict = _verdict(decides, judgement, margins, better, limits)
    if better is not None and verdict == "change" and holds:
        Ms, relative = margins.sensitivity.value, better.relative_cost.value
        cause = with_better(cause, Ms, relative, better.load_error)
    if better is None:
        advised = advise(loop, trial, in_use)
    elif better.price > WORTHWHILE and judgement.half_width > 0.0:
        # The price is about as large as the intervals are wide. A log without noise shows Ms
        # exactly, and no experiment tells more.
        aim = judgement.half_width * WORTHWHILE / better.price
        advised = advise(loop, trial, in_use, aim)
    else:
        advised = None
    progress("done", 1.0)
    return Suggestion(
        verdict=verdict,
        in_use=in_use,
        margins=margins if judgement.can_tell and holds else None,
        recommendation=better,
        judgement=judgement,
        replay=decides,
        trial=trial,
        fit=loop.fit,
        stretches=tuple(part.stretch for part in parts),
        gains_by_log={part.stretch.log: part.gains for part in parts},
        ran_otherwise=tuple(log for log, one in replays[:-1] if one.contradicts),
        left_out=tuple(left_out),
        issues=logs.issues,
        limits=limits,
        experiment=advised,
        cause=cause,
    )


def _logs(
    records: Path | str | Logs | Sequence[Path | str] | Sequence[LoopLog],
    columns: Mapping[str, str] | None,
    sampling_Hz: float | None,
    *,
    reverse: bool,
) -> Logs:
    if isinstance(records, Logs):
        return records
    if isinstance(records, Path | str):
        records = (records,)
    if not records:
        raise InvalidInput("there is no log; give at least one")
    logs = tuple(log for log in records if isinstance(log, LoopLog))
    if logs:
        return Logs(logs, ())
    paths = [path for path in records if isinstance(path, Path | str)]
    return read_logs(paths, columns, sampling_Hz, reverse=reverse)


def _beside(loop: ServiceLoop, cause: Cause, judgement: Judgement) -> Cause:
    """The cause beside a known loop, which may leave no room for an actuator that sticks."""
    if cause.name != "sticking" or not judgement.can_tell:
        return cause
    band, slip = (float(cause.numbers[name] or 0.0) for name in ("band", "slip"))
    return cause if may_stick(loop, Valve(band, slip)) else of_others(cause)


def _for_machine(judgement: Judgement, cause: Cause, loop: ServiceLoop) -> Judgement:
    """A judgement that offers no gains where the actuator sticks.

    Those that a linear loop asked for moved a sticking actuator up to 21 times as far. A loop that
    is identified with its friction has it in its margins.
    """
    if cause.name == "sticking" and judgement.can_tell and not loop.fit.model.friction:
        return judgement._replace(reason="the actuator sticks; free it before other gains")
    return judgement


def _usable(
    logs: Logs,
    given: Gains | Mapping[str, Gains] | None,
    settings: ControllerSettings,
    cause: Cause,
) -> tuple[list[ServicePart], list[LeftOut], list[tuple[str, Replay]]]:
    """Stretches with the gains that ran, what is left out, and replays of the effort by log.

    The last log shows the gains in use. Another whose effort no gains explain is left out.
    """
    parts, replays = list[ServicePart](), list[tuple[str, Replay]]()
    if isinstance(given, Mapping):
        check_names(logs.logs, given)
    found = [(log, *whole_stretches(log)) for log in logs.logs]
    left_out = [part for *_, without in found for part in without]
    used = [(log, whole) for log, whole, _ in found if whole]
    for number, (log, whole) in enumerate(used, 1):
        stated = gains_of(log, given)
        sets = gain_sets(log, settings, stated)
        if number < len(used) and not all(one.replay.explained for one in sets):
            why = sets[-1].replay.sentence()
            left_out += [unused(stretch, log.sampling_Hz, why) for stretch in whole]
            continue
        replays += [(log.name, one.replay) for one in sets]
        ran = [_ran(one.replay, stated) for one in sets] or [stated]
        for stretch, of in (pair for one in whole for pair in cut(one, sets, log.sampling_Hz)):
            gains = ran[of]
            if gains is None:
                logged = any(stretch.effort is not None for stretch in whole)
                also = "no P, I and D explain the output" if logged else "log the effort beside"
                raise GainsUnknown(
                    f"the gains that ran in {log.name} are not known; give them, as in "
                    f'--gains "P=2,I=0.5,D=0"; {also}',
                    cause,
                )
            if stretch.samples < SHORTEST:
                left_out.append(unused(stretch, log.sampling_Hz))
            else:
                parts.append(ServicePart(stretch, gains))
    if not parts:
        reasons = "; ".join(dict.fromkeys(part.reason for part in left_out))
        raise InvalidInput(f"no stretch of the logs can be used: {reasons}; record more of them")
    if not any(np.ptp(part.stretch.measurement) for part in parts):
        raise InvalidInput("the measurement does not move; map the channel that the loop controls")
    return parts, left_out, replays


def _ran(compared: Replay, stated: Gains | None) -> Gains | None:
    """The gains that ran by a comparison with those stated."""
    return compared.ran if compared.explained and not compared.agrees else stated


def _trial(
    loop: ServiceLoop,
    in_use: Gains,
    settling_time_s: float | None,
    step: float | None,
    cost: StepCost | str | CostFunction,
) -> StepTrial:
    """The step that the predictions are for: of the size and the speed of the records."""
    settings, model = loop.settings, loop.fit.model
    rate = settings.sampling_Hz
    if settling_time_s is None:
        settling_time_s = settling_time(loop, in_use)
    size = step or loop.span or 1.0
    own = isinstance(cost, StepCost)
    cost = cost if isinstance(cost, StepCost) else cost_from(cost, settling_time_s)
    # A fit of an integrating plant has any gain at rest: with it the effort of a servo cost 1e11
    # times the error.
    gain = gain_within(model, settling_time_s * rate)
    if cost.unscaled or not own:
        cost = cost.scaled(gain)
    shape, samples = StepShape(1, size), math.ceil(TRIAL_SPAN * settling_time_s * rate) + 1
    if cost.rejection:
        # A load that takes as much effort as the step, once the step has settled.
        shape, samples = shape._replace(load=LoadStep(samples, size / gain)), 2 * samples
    return StepTrial(settings, cost, 0.0, shape, samples)


def _verdict(
    decides: Replay | None,
    judgement: Judgement,
    margins: PredictedMargins,
    better: Recommendation | None,
    limits: RobustnessLimits,
) -> Verdict:
    if decides is not None and decides.contradicts:
        return "other gains ran"
    if not judgement.can_tell:
        return "cannot tell"
    return "change" if better and is_worthwhile(margins, better, limits) else "keep"


def is_worthwhile(
    margins: PredictedMargins, better: Recommendation, limits: RobustnessLimits
) -> bool:
    """Whether other gains are surely better, or keep a broken limit."""
    cost = better.relative_cost
    return bool(limits.broken_by(margins)) or (cost.value < 1.0 - WORTHWHILE and cost.high < 1.0)
