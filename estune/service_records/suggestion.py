"""From logs of a running loop to its margins and to better gains."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from estune.core.controller_form import ControllerForm
from estune.core.cost import default_cost
from estune.core.gains import GAIN_NAMES, Gains
from estune.core.pidf import ControllerSettings
from estune.core.response import StepShape
from estune.errors import InvalidInput
from estune.loop_model.intervals import Interval, PredictedMargins
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.recordings.issue import DataIssue
from estune.recordings.loop_log import LoopLog
from estune.service_records.identification import (
    ServiceLoop,
    ServicePart,
    identify,
    settling_time,
)
from estune.service_records.judgement import Judgement, judge, margins_of
from estune.service_records.recommendation import Recommendation, recommend
from estune.service_records.replay import RAN_OTHERWISE, Replay, replay
from estune.service_records.sources import Logs, gains_of, read_logs
from estune.service_records.stretches import LeftOut, Stretch, find_stretches
from estune.support.blas import one_blas_thread

if TYPE_CHECKING:
    import pandas as pd

TRIAL_SPAN = 3.0
"""Duration of the predicted step response, settling times."""

WORTHWHILE = 0.05
"""Decrease of the cost, by the whole of both intervals, from which other gains are recommended."""

LABELS = {"setpoint_filter_s": "setpoint filter, s"}

Verdict = Literal["change", "keep", "cannot tell", "other gains ran"]


@dataclass(frozen=True)
class Suggestion:
    """Margins of the gains in use, and recommended gains, from records of a running loop.

    Attributes:
        verdict: Whether to change the gains; `cannot tell` where the records do not show it,
            `other gains ran` where the effort is not that of the stated gains.
        in_use: The gains in use: those stated, or those that the logged effort shows.
        margins: Predictions for them; None where they are not known.
        recommendation: Better gains, or None.
        judgement: What the records show.
        replay: Comparison of the logged effort with that of the gains; None without an effort.
        trial: The step response that cost and overshoot are predicted for.
        fit: The identified loop.
        stretches: What was used.
        left_out: What was not, with the reason.
        issues: What was done to the time stamps, and files that cannot be used.
        limits: The limits of the recommended gains.
    """

    verdict: Verdict
    in_use: Gains
    margins: PredictedMargins | None
    recommendation: Recommendation | None
    judgement: Judgement
    replay: Replay | None
    trial: StepTrial
    fit: LoopFit
    stretches: tuple[Stretch, ...]
    left_out: tuple[LeftOut, ...]
    issues: tuple[DataIssue, ...]
    limits: RobustnessLimits

    @property
    def exit_code(self) -> int:
        """Exit code of the command line.

        0 where the gains are judged, 9 where the records do not show enough, 10 where other gains
        ran than those stated.
        """
        return {"cannot tell": 9, "other gains ran": 10}.get(self.verdict, 0)

    def heading(self) -> str:
        """The verdict in one line."""
        if self.verdict == "other gains ran":
            assert self.replay is not None  # noqa: S101  the verdict comes from it
            sentence = self.replay.sentence()
            return f"OTHER GAINS RAN: {sentence.removeprefix(RAN_OTHERWISE)}."
        if self.verdict == "cannot tell":
            return f"CANNOT TELL: {self.judgement.reason}."
        assert self.margins is not None  # noqa: S101  a judged loop has margins
        Ms = self.margins.sensitivity
        now = f"Ms {Ms.value:.2f} ({Ms.low:.2f} to {Ms.high:.2f})"
        if self.recommendation is None:
            return f"KEEP: no gains are predicted to be better within the limits; {now} in use."
        cost = self.recommendation.margins.cost.value / self.margins.cost.value - 1.0
        if self.verdict == "keep":
            return f"KEEP: the best gains within the limits change the cost by {cost:+.0%}; {now}."
        return (
            f"CHANGE: predicted cost {cost:+.0%} with {self.recommendation.gains}; {now} in use."
        )

    def rows(self) -> list[tuple[str, str, str]]:
        """Label, gains in use and recommended gains, for a table."""
        better = self.recommendation
        rows = [
            (LABELS.get(name, name), f"{now:.4g}", "-" if better is None else f"{then:.4g}")
            for name, now, then in zip(
                GAIN_NAMES,
                self.in_use.as_tuple(),
                (better.gains if better else self.in_use).as_tuple(),
                strict=True,
            )
        ]
        for label, form, scale, field in (
            ("sensitivity Ms", ".2f", 1.0, "sensitivity"),
            ("phase margin, deg", ".0f", 1.0, "phase_margin_deg"),
            ("overshoot, %", ".1f", 100.0, "overshoot"),
            ("cost of a step", ".3g", 1.0, "cost"),
        ):
            cells = [
                "-" if m is None else _text(getattr(m, field), form, scale)
                for m in (self.margins, better.margins if better else None)
            ]
            rows.append((label, cells[0], cells[1]))
        return rows

    def remarks(self) -> list[str]:
        """What limits the statements, and what to do about it, a sentence each."""
        from estune.service_records.advice import advice  # noqa: PLC0415  it builds on this

        remarks = []
        if self.judgement.can_tell and self.judgement.unseen:
            remarks.append(
                f"Nothing is known {self.judgement.unseen}: the records do not excite it, and a "
                "resonance there would not be seen."
            )
        if self.recommendation is not None and self.recommendation.price > 0.01:
            remarks.append(
                "The uncertainty of the records costs "
                f"{self.recommendation.price:.0%}: with more data less cautious gains keep the "
                "limits."
            )
        return [*remarks, *advice(self)]

    def to_json(self) -> dict[str, Any]:
        """All numbers as JSON values."""
        better = self.recommendation
        return {
            "verdict": self.verdict,
            "heading": self.heading(),
            "gains_in_use": _gains_json(self.in_use),
            "in_use": self.margins and _margins_json(self.margins),
            "recommended_gains": better and _gains_json(better.gains),
            "recommended": better and _margins_json(better.margins),
            "price_of_uncertainty": better and better.price,
            "setpoint_half_width": self.judgement.half_width,
            "reason": self.judgement.reason,
            "replay": self.replay
            and {
                "agrees": self.replay.agrees,
                "stated_error": self.replay.stated_error,
                "ran": self.replay.ran and _gains_json(self.replay.ran),
                "ran_error": self.replay.ran_error,
                "sentence": self.replay.sentence(),
            },
            "settling_time_s": self.trial.cost.settling_time_s,
            "step": self.trial.step.size_N,
            "poles": self.fit.order,
            "used": [
                {"log": s.log, "start_s": s.start_s, "samples": s.samples} for s in self.stretches
            ],
            "left_out": [part._asdict() for part in self.left_out],
            "issues": [str(issue) for issue in self.issues],
            "remarks": self.remarks(),
        }

    def to_frame(self) -> "pd.DataFrame":
        """The table of `rows` as a frame."""
        import pandas as pd  # noqa: PLC0415  slow to import

        rows = self.rows()
        return pd.DataFrame(
            [row[1:] for row in rows],
            index=[row[0] for row in rows],
            columns=["in use", "recommended"],
        )

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
    records: Path | str | Logs | Sequence[LoopLog],
    *,
    gains: Gains | Mapping[str, Gains] | None = None,
    columns: Mapping[str, str] | None = None,
    sampling_Hz: float | None = None,
    derivative_filter_s: float | None = None,
    form: ControllerForm | None = None,
    reverse: bool = False,
    settling_time_s: float | None = None,
    step: float | None = None,
    limits: RobustnessLimits | None = None,
) -> Suggestion:
    """Margins of a running loop and better gains, from records of its ordinary service.

    Args:
        records: A file of any known format, a folder of them, a run, or logs.
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
        limits: What the recommended gains keep; Ms 1.6 and overshoot 5 % by default.

    Raises:
        InvalidInput: there is no usable log, or no gains are known.

    Example::

        suggestion = estune.suggest("logs", gains=estune.Gains(2.0, 0.5, 0.0, 0.0))
        print(suggestion.heading())
    """
    logs = _logs(records, columns, sampling_Hz, reverse=reverse)
    limits = limits or RobustnessLimits()
    settings = logs.controller or ControllerSettings(
        logs.logs[0].sampling_Hz, derivative_filter_s or 0.0, -math.inf, math.inf, form
    )
    parts, left_out, replays = _usable(logs, gains, settings)
    worst = _worst(replays)
    in_use = parts[-1].gains
    loop = identify(parts, settings, settling_time_s)
    trial = _trial(loop, in_use, settling_time_s, step)
    margins, margin = margins_of(loop, trial, in_use)
    judgement = judge(loop, in_use, margins, margin)
    better = recommend(loop, trial, in_use, limits) if judgement.can_tell else None
    verdict: Verdict = "cannot tell"
    if worst is not None and not worst.agrees:
        verdict = "other gains ran"
    elif judgement.can_tell:
        verdict = "change" if better and _worthwhile(margins, better, limits) else "keep"
    return Suggestion(
        verdict=verdict,
        in_use=in_use,
        margins=margins if judgement.can_tell else None,
        recommendation=better,
        judgement=judgement,
        replay=worst,
        trial=trial,
        fit=loop.fit,
        stretches=tuple(part.stretch for part in parts),
        left_out=tuple(left_out),
        issues=logs.issues,
        limits=limits,
    )


def _logs(
    records: Path | str | Logs | Sequence[LoopLog],
    columns: Mapping[str, str] | None,
    sampling_Hz: float | None,
    *,
    reverse: bool,
) -> Logs:
    if isinstance(records, Logs):
        return records
    if isinstance(records, Path | str):
        return read_logs(records, columns, sampling_Hz, reverse=reverse)
    if not records:
        raise InvalidInput("there is no log; give at least one")
    return Logs(tuple(records), ())


def _usable(
    logs: Logs, given: Gains | Mapping[str, Gains] | None, settings: ControllerSettings
) -> tuple[list[ServicePart], list[LeftOut], list[Replay]]:
    """Stretches with the gains that ran, what is left out, and the replays of the effort."""
    parts, left_out, replays = list[ServicePart](), list[LeftOut](), list[Replay]()
    for log in logs.logs:
        stated = gains_of(log, given)
        stretches, without = find_stretches(log, stated.P if stated else 0.0)
        left_out += without
        if not stretches:
            continue
        ran = stated
        if all(s.effort is not None for s in stretches):
            compared = replay(stretches, settings, stated)
            replays.append(compared)
            ran = compared.ran if compared.explained and not compared.agrees else stated
        if ran is None:
            raise InvalidInput(
                f"the gains that ran in {log.name} are not known; give them, as in "
                '--gains "P=2,I=0.5,D=0", or log the effort of the controller beside'
            )
        parts += [ServicePart(stretch, ran) for stretch in stretches]
    if not parts:
        reasons = "; ".join(dict.fromkeys(part.reason for part in left_out))
        raise InvalidInput(f"no stretch of the logs can be used: {reasons}; record more of them")
    return parts, left_out, replays


def _worst(replays: Sequence[Replay]) -> Replay | None:
    """The replay that decides: one that does not agree, else that of the largest error."""
    return max(replays, key=lambda r: (not r.agrees, r.stated_error), default=None)


def _trial(
    loop: ServiceLoop, in_use: Gains, settling_time_s: float | None, step: float | None
) -> StepTrial:
    """The step that the predictions are for: of the size and the speed of the records."""
    settings, model = loop.settings, loop.fit.model
    if settling_time_s is None:
        settling_time_s = settling_time(loop, in_use)
    if not math.isfinite(settling_time_s):
        settling_time_s = model.natural_period / settings.sampling_Hz
    setpoint = np.concatenate([record.setpoint_N for record in loop.records])
    measured = np.concatenate([record.measurement_N for record in loop.records])
    size = step or float(np.ptp(setpoint)) or float(np.ptp(measured)) or 1.0
    cost = default_cost(settling_time_s)
    if math.isfinite(model.static_gain):
        cost = cost.scaled(model.static_gain)
    samples = math.ceil(TRIAL_SPAN * settling_time_s * settings.sampling_Hz) + 1
    limitless = replace(settings, output_min_N=-math.inf, output_max_N=math.inf)
    return StepTrial(limitless, cost, 0.0, StepShape(1, size), samples)


def _worthwhile(
    margins: PredictedMargins, better: Recommendation, limits: RobustnessLimits
) -> bool:
    """Whether other gains are better by the whole of both intervals, or keep a broken limit."""
    if limits.broken_by(margins):
        return True
    return better.margins.cost.value < (1.0 - WORTHWHILE) * margins.cost.value


def _text(at: Interval, form: str, scale: float) -> str:
    low, high = scale * at.low, scale * at.high
    return f"{scale * at.value:{form}} ({low:{form}} to {high:{form}})"


def _gains_json(gains: Gains) -> dict[str, float]:
    return dict(zip(GAIN_NAMES, gains.as_tuple(), strict=True))


def _margins_json(margins: PredictedMargins) -> dict[str, dict[str, float]]:
    return {name: interval._asdict() for name, interval in margins._asdict().items()}
