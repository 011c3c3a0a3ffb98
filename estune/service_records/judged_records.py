"""What records of a running loop show: margins of the gains in use, and better gains."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from estune.core.gains import GAIN_NAMES, Gains
from estune.loop_model.intervals import Interval, PredictedMargins
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.recordings.issue import DataIssue
from estune.service_records.advice import AdvisedExperiment, advice
from estune.service_records.cause.judge import Cause
from estune.service_records.judgement import Judgement
from estune.service_records.recommendation import Recommendation
from estune.service_records.replay import RAN_OTHERWISE, Replay, apart
from estune.service_records.stretches import LeftOut, Stretch

if TYPE_CHECKING:
    import pandas as pd

LABELS = {"setpoint_filter_s": "setpoint filter, s"}

LISTED = 4
"""Sets of gains that are named."""

LARGE = 2.0
"""Factor of the error after a load from which it is told in the first line."""

Verdict = Literal["change", "keep", "cannot tell", "other gains ran"]


@dataclass(frozen=True)
class JudgedRecords:
    """Margins of the gains in use, and recommended gains, from records of a running loop.

    Attributes:
        verdict: Whether to change the gains; `cannot tell` where the records do not show it,
            `other gains ran` where the last log's effort is not that of the stated gains.
        in_use: The gains in use: those stated, or those that the logged effort shows.
        margins: Predictions for them; None where they are not known.
        recommendation: Better gains, or None.
        judgement: What the records show.
        replay: Comparison of the last logged effort with that of the gains; None without one.
        trial: The step response that cost and overshoot are predicted for.
        stretches: What was used.
        gains_by_log: The gains that ran, by the log's name.
        ran_otherwise: Names of logs before the last in which other gains ran than those stated.
        left_out: What was not, with the reason.
        issues: What was done to the time stamps, and files that cannot be used.
        experiment: What would show the margins; None where nothing is known to, or is needed.
        cause: Whether it is the tuning or the machine, by the last log.
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
    gains_by_log: Mapping[str, Gains]
    ran_otherwise: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    issues: tuple[DataIssue, ...]
    limits: RobustnessLimits
    experiment: AdvisedExperiment | None = None
    cause: Cause | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of the command line.

        0 where the gains are judged, 9 where the records do not show enough, 10 where other gains
        ran than those stated.
        """
        return {"cannot tell": 9, "other gains ran": 10}.get(self.verdict, 0)

    @property
    def verdict_first(self) -> bool:
        """Whether the verdict stands before the cause: what is refused stands first.

        A log in which other gains ran than those stated began with `NOTHING WRONG`.
        """
        return self.exit_code != 0 and self.cause is not None and self.cause.name == "none"

    def heading(self) -> str:
        """The verdict in one line."""
        if self.verdict == "other gains ran":
            assert self.replay is not None  # noqa: S101  the verdict comes from it
            sentence = self.replay.sentence()
            other = "FORM" if self.replay.ran == self.replay.stated else "GAINS"
            return f"OTHER {other} RAN: {sentence.removeprefix(RAN_OTHERWISE)}."
        if self.verdict == "cannot tell":
            return f"CANNOT TELL: {self.judgement.reason}."
        if self.margins is None:  # its limits alone hold it
            assert self.recommendation is not None  # noqa: S101  else nothing is told
            return f"CHANGE: the loop is unstable; {self.recommendation.gains} hold it."
        Ms = self.margins.sensitivity
        now = f"Ms {Ms.value:.2f} ({Ms.low:.2f} to {Ms.high:.2f})"
        if self.recommendation is None:
            return f"KEEP: the records show no other gains that keep the limits; {now} in use."
        cost, _, most = (one - 1.0 for one in self.recommendation.relative_cost)
        if self.verdict == "keep":
            sure = f", but by up to {most:+.0%} for all that is known" if cost < 0.0 < most else ""
            change = f"change the cost by {cost:+.0%}{sure}"
            return f"KEEP: the best gains within the limits {change}; {now}."
        worse = self.recommendation.load_error
        load = f"; the error after a load is {worse:.2g} times as large" if worse >= LARGE else ""
        return (
            f"CHANGE: predicted cost {cost:+.0%} with {self.recommendation.gains}{load}; {now} in "
            "use."
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
        if better is not None and self.margins is not None:
            rows.append(("error after a load, in use = 1", "1", f"{better.load_error:.3g}"))
        return rows

    def remarks(self) -> list[str]:
        """What limits the statements, and what to do about it, a sentence each."""
        remarks = []
        if self.recommendation and self.cause and self.cause.name in ("outside", "sensor"):
            remarks.append("Other gains do not mend the cause; they are what the loop allows.")
        if any(apart(gains, self.in_use) for gains in self.gains_by_log.values()):
            remarks.append(
                f"Several sets of gains ran: {_listed(self.gains_by_log)}; those in use are the "
                "last."
            )
        if self.ran_otherwise:
            remarks.append(
                f"In {', '.join(self.ran_otherwise)} other gains ran than those stated; what the "
                "logged effort shows is used."
            )
        if self.replay is not None and (self.replay.stated is None or self.replay.is_thin):
            sentence = self.replay.sentence()
            remarks.append(f"{sentence[0].upper()}{sentence[1:]}.")
        rings = self.judgement.ringing
        if self.judgement.can_tell and rings is not None:
            better = self.recommendation and self.recommendation.gains
            remarks.append(rings.sentence(self.in_use, better))
        if self.judgement.can_tell and self.judgement.unseen:
            remarks.append(
                f"Nothing is known {self.judgement.unseen}: the records do not excite it, and a "
                "resonance there would not be seen."
            )
        moved = self._setpoint_range()
        if self.judgement.can_tell and self.trial.step.size > moved:
            remarks.append(
                f"The step, {self.trial.step.size:.3g}, is larger than the setpoint's range in "
                f"the records, {moved:.3g}: what shows in large motion alone, as a cable that "
                "begins to slide in an eyelet, would not be seen."
            )
        if self.recommendation is not None and self.recommendation.price > 0.01:
            remarks.append(
                "The uncertainty of the records costs "
                f"{self.recommendation.price:.0%}: with more data less cautious gains keep the "
                "limits."
            )
        if self.recommendation is None or self.experiment is not None:
            remarks.append(advice(self.experiment))
        return remarks

    def _setpoint_range(self) -> float:
        setpoints = [stretch.setpoint for stretch in self.stretches]
        return float(max(s.max() for s in setpoints) - min(s.min() for s in setpoints))

    def to_json(self) -> dict[str, Any]:
        """All numbers as JSON values."""
        better = self.recommendation
        return {
            "verdict": self.verdict,
            "heading": self.heading(),
            "cause": self.cause and self.cause.to_json(),
            "gains_in_use": _gains_json(self.in_use),
            "gains_by_log": {log: _gains_json(ran) for log, ran in self.gains_by_log.items()},
            "in_use": self.margins and _margins_json(self.margins),
            "recommended_gains": better and _gains_json(better.gains),
            "recommended": better and _margins_json(better.margins),
            "price_of_uncertainty": better and better.price,
            "setpoint_half_width": self.judgement.half_width,
            "reason": self.judgement.reason,
            "ringing": self.judgement.ringing and self.judgement.ringing._asdict(),
            "replay": self.replay
            and {
                "agrees": self.replay.agrees,
                "stated_error": self.replay.stated_error,
                "ran": self.replay.ran and _gains_json(self.replay.ran),
                "ran_error": self.replay.ran_error,
                "sentence": self.replay.sentence(),
            },
            "settling_time_s": self.trial.cost.settling_time_s,
            "step": self.trial.step.size,
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


def _text(at: Interval, form: str, scale: float) -> str:
    low, high = scale * at.low, scale * at.high
    return f"{scale * at.value:{form}} ({low:{form}} to {high:{form}})"


def _listed(gains_by_log: Mapping[str, Gains]) -> str:
    """The sets of gains, each with the first log that ran with it, at most four."""
    first = dict[str, Gains]()
    for log, gains in gains_by_log.items():
        if not any(not apart(gains, other) for other in first.values()):
            first[log] = gains
    named = [f"{gains} ({log})" for log, gains in first.items()]
    return "; ".join(named if len(named) <= LISTED else [*named[:LISTED], "and others"])


def _gains_json(gains: Gains) -> dict[str, float]:
    return dict(zip(GAIN_NAMES, gains.as_tuple(), strict=True))


def _margins_json(margins: PredictedMargins) -> dict[str, dict[str, float]]:
    return {name: interval._asdict() for name, interval in margins._asdict().items()}
