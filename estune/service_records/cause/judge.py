"""The cause of what a log shows, with its probability and its numbers."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from estune.recordings.loop_log import LoopLog
from estune.service_records.cause import margins
from estune.service_records.cause.evidence import CauseEvidence, evidence
from estune.service_records.cause.loop_signals import JudgedSignals
from estune.service_records.cause.predictors import around
from estune.service_records.cause.probability import CauseName, probabilities
from estune.support.quantity_text import time_text

Number = float | str | None

SHORTEST = 100
"""Samples of a log whose cause is judged: five swings of twenty samples."""

SURE = 0.65
"""Probability from which a cause is told: a mechanic who finds nothing, or gains that mend none,
cost twice what a cause costs that is not told yet. Of 200 sealed loops 88 % are told, 90 %
of those rightly, and 1.9 % of the others called sticking. Of 25 logs of a plant, the nine that
stick are at 0.66 or more, the sixteen sound ones at 0.30 or less."""

BAND_FACTOR, SLIP_SHARE = 1.25, 0.75
"""What the interval of a band is widened by, and that of a slip, over the band: of 170 simulated
actuators the likelihood alone holds 64 % of the bands and 49 % of the slips; 1.2 times as wide it
holds 94 % of the bands, and half a band wider 80 % of the slips."""

FORETELLS = 5.0
"""Log likelihood of what is left out that a sticking actuator gains at least: very strong evidence
(Kass and Raftery 1995, doi:10.1080/01621459.1995.10476572). By the shapes of their swings alone
two of 120 sound loops, which gain -1 and 3, were called sticking; nine logs of a plant that stick
gain 12 to 42, and two of 32 simulated ones less than 5."""

TIGHT = 1.8
"""Ms above which the tuning is called too tight, below it too slow: sound loops lie below."""

HELD = 0.03
"""Share of a log at a limit from which it is a warm-up or the like: it is 0.01 in the plant log
whose historian repeats values most, and 0.08 in a log of a linear loop that rings down from a cold
start, which was said to stick."""

SLOW = 5.0
"""Factor that the gains of a loop allow from which it is too slow. Sound ones are up to four times
as slow as their dead time asks; of four chambers that were called so the factor was 1.2 to 3.6."""

RETURNS, LATER = 0.5, 0.3
"""Correlation of the error one period later, and of that four periods later, from which a loop
swings. Seven of 25 simulated loops that are too tight have Ms below `TIGHT` by the judge's plant
and were called too slow: their correlations are 0.6 to 0.9 and 0.5 to 1; those of slow ones 0."""

AWAY = 10.0
"""Error at the end of a log, over the largest of its first half and the range of the setpoint,
from which the measurement has run away. A controller of the wrong sign was told to take a sudden
load away in time, and sooner with tighter gains."""

_WORDS: dict[CauseName, str] = {
    "tuning": "TUNING",
    "sticking": "STICKING ACTUATOR",
    "outside": "FROM OUTSIDE",
    "sensor": "SENSOR",
    "none": "NOTHING WRONG",
    "unknown": "CAUSE UNKNOWN",
}


@dataclass(frozen=True)
class Cause:
    """Whether it is the tuning or the machine.

    Attributes:
        probability: Its probability; of an unknown one that of the likeliest.
        numbers: What is known of it, in the units of the log; times in s.
        words: The same as the end of a sentence.
        probabilities: Of every cause that was weighed.
        shown: What was weighed; None of a log that cannot be judged.
    """

    name: CauseName
    probability: float
    numbers: Mapping[str, Number]
    words: str
    probabilities: Mapping[CauseName, float]
    shown: CauseEvidence | None = field(default=None, repr=False)
    log: str = ""

    @property
    def is_machine(self) -> bool:
        """Whether new gains are no remedy: the actuator or the sensor is at fault."""
        return self.name in ("sticking", "sensor")

    def heading(self) -> str:
        """The cause in one line."""
        sure = f" ({self.probability:.0%})" if self.name != "unknown" else ""
        return f"{_WORDS[self.name]}{sure}: {self.words}."

    def to_json(self) -> dict[str, Any]:
        """All numbers as JSON values."""
        return {
            "name": self.name,
            "probability": self.probability,
            **self.numbers,
            "heading": self.heading(),
            "probabilities": dict(self.probabilities),
            "log": self.log,
        }


def judge_cause(log: LoopLog) -> Cause:
    """The cause that the longest part of a log shows."""
    part = max(log.parts, key=lambda one: one["time"].size)
    if "effort" not in part:
        return _unknown("the output of the controller is not logged; log it beside", log.name)
    signals = JudgedSignals(
        part["setpoint"], part["measurement"], part["effort"], 1.0 / log.sampling_Hz
    )
    return judge_signals(between_limits(signals), log.name)


def of_most(judged: Sequence[Cause]) -> Cause:
    """The cause that most logs of a loop show, as the log has it that shows it best.

    Logs that show another one are named: a sensor that froze in one of ten is still to be seen to.
    """
    told = [cause for cause in judged if cause.name != "unknown"]
    if len(judged) == 1 or not told:
        return judged[-1]
    weight = defaultdict[CauseName, float](float)
    for cause in told:
        weight[cause.name] += cause.probability
    name = max(weight, key=lambda one: weight[one])
    best = max((c for c in told if c.name == name), key=lambda c: c.probability)
    count = sum(c.name == name for c in told)
    others = [f"{_WORDS[c.name]} in {c.log}" for c in told if c.name != name]
    shown = f"{best.words} ({best.log}; {count} of {len(judged)} logs)"
    return replace(best, words="; ".join([shown, *others]))


def between_limits(signals: JudgedSignals) -> JudgedSignals:
    """The longest part in which the output is not held at its least or greatest value.

    A warm-up at a limit is no swing of the loop: its end was taken for a load. A log that is at a
    limit for less than `HELD` of its length is taken whole.
    """
    u = signals.output
    at_limit = (u == u.min()) | (u == u.max())
    if at_limit.mean() < HELD:
        return signals
    edges = np.flatnonzero(np.diff(np.concatenate([[True], at_limit, [True]]).astype(np.int8)))
    free = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    # An output of two values is at one of them throughout.
    begin, end = max(free, key=lambda pair: pair[1] - pair[0], default=(0, 0))
    return signals.part(slice(begin, end))


def judge_signals(signals: JudgedSignals, name: str = "") -> Cause:
    """The cause that signals show."""
    if not signals.samples:
        return _unknown(
            "the output is at its least or its greatest value throughout, as of an on-off "
            "controller; record a loop whose output moves between its limits",
            name,
        )
    if signals.samples < SHORTEST:
        why = (
            f"the log has {signals.samples} samples in a row without a gap or a limit; record "
            f"{SHORTEST} or more"
        )
        return _unknown(why, name)
    if not np.ptp(signals.output) or not np.ptp(signals.measurement):
        still = "output" if np.ptp(signals.measurement) else "measurement"
        return _unknown(f"the {still} does not move; record the loop in automatic", name)
    if _runs_away(signals):
        off = abs(float(signals.error[-1]))
        why = (
            f"the measurement runs away from the setpoint, {off:.3g} off at the end, and "
            "the output does not bring it back; see that the loop is in automatic and that its "
            "output acts in the right direction, before any gains"
        )
        return _unknown(why, name)
    with np.errstate(all="ignore"):
        shown = evidence(signals)
    if shown.faults:
        return _of(shown, "sensor", {"sensor": 1.0}, name)
    return likeliest_cause(shown, probabilities(shown.numbers), name)


def _runs_away(signals: JudgedSignals) -> bool:
    """Whether the error grows to one side to the end, beyond all that the loop has mended."""
    error, quarter = signals.error, signals.samples // 4
    size, side = np.abs(error), np.sign(error[-1])
    mended = max(float(size[: 2 * quarter].max()), float(np.ptp(signals.setpoint)))
    before = float(size[2 * quarter : 3 * quarter].max())
    end = float(size[-(quarter // 2) :].min())
    # Still growing: twice the quarter before. One that has come to rest far off is another fault.
    return bool(
        (error[3 * quarter :] * side > 0.0).all() and end > max(AWAY * mended, 2.0 * before)
    )


def likeliest_cause(shown: CauseEvidence, weighed: Mapping[CauseName, float], log: str) -> Cause:
    """The likeliest cause, where it is likely enough."""
    likeliest = max(weighed, key=lambda cause: weighed[cause])
    told = weighed[likeliest] >= SURE
    if likeliest == "sticking":
        # An interval that holds none is that of a loop which is linear but for a little.
        told &= bool(shown.predicted.near) and _band_of(shown)[0] > 0.0
        told &= shown.gain > FORETELLS
    if likeliest == "tuning":
        told &= _is_tight(shown) or shown.room > SLOW
    return _of(shown, likeliest if told else "unknown", weighed, log)


def _unknown(words: str, log: str) -> Cause:
    return Cause("unknown", 0.0, {}, words, {}, log=log)


def _of(
    shown: CauseEvidence, name: CauseName, weighed: Mapping[CauseName, float], log: str
) -> Cause:
    numbers, words = {
        "tuning": _tuning,
        "sticking": _sticking,
        "outside": _outside,
        "sensor": _sensor,
        "none": _none,
        "unknown": _record,
    }[name](shown, weighed)
    return Cause(
        name,
        max(weighed.values()),
        numbers,
        words,
        weighed,
        shown,
        log,
    )


_Told = tuple[dict[str, Number], str]


def _is_tight(shown: CauseEvidence) -> bool:
    swings = shown.shapes.returns > RETURNS and shown.shapes.later > LATER
    return swings or shown.room < 1.0 or shown.sensitivity > TIGHT


def _tuning(shown: CauseEvidence, _weighed: Mapping[CauseName, float]) -> _Told:
    tight = _is_tight(shown)
    if tight and shown.room >= 1.0:
        unseen: dict[str, Number] = {
            "direction": "tight",
            "sensitivity": None,
            "gain_factor": None,
        }
        return unseen, "too tight, it swings by itself; by what factor, a step would show"
    factor = shown.room
    lead = f"to Ms {margins.SENSITIVITY:g}"
    numbers: dict[str, Number] = {
        "direction": "tight" if tight else "slow",
        "sensitivity": shown.sensitivity,
        # At either end none of the tried factors leads there: an integral before an integrating
        # plant, or a plant that the output hardly shows.
        "gain_factor": factor if 1.01 < factor / margins.LEAST < 0.99 / margins.LEAST**2 else None,
    }
    if tight:
        Ms = f"Ms {shown.sensitivity:.1f}" if shown.sensitivity < margins.UNSTABLE else "no margin"
        less = f"gains times {factor:.2f} lead {lead}"
        if numbers["gain_factor"] is None:
            less = f"no factor of all gains leads {lead}: take from I first"
        return numbers, f"too tight, {Ms}; {less}"
    more = f"{factor:.1f} times the gains lead {lead}"
    if numbers["gain_factor"] is None:
        # Of a log whose gains times 15 give Ms 1.7, the rough plant had less with 30.
        return numbers, "too slow; how much larger the gains may be, the log does not show"
    return numbers, f"too slow; {more}, if the output of the log shows the plant"


def _band_of(shown: CauseEvidence) -> tuple[float, float, float, float]:
    """Least and greatest band, and slip over the band, that the log allows."""
    near, size = shown.predicted.near, float(np.ptp(shown.signals.output))
    low, high, least, most = around(
        [one.band / size for one in near], [one.slip / one.band for one in near]
    )
    return low * size / BAND_FACTOR, high * size * BAND_FACTOR, least, most


def _sticking(shown: CauseEvidence, _weighed: Mapping[CauseName, float]) -> _Told:
    valve = shown.predicted.sticking.valve
    assert valve is not None  # noqa: S101  it is of the kind that sticks
    low, high, least, most = _band_of(shown)
    least = max(0.0, least * low - SLIP_SHARE * valve.band)
    most = min(most * high + SLIP_SHARE * valve.band, high)
    numbers: dict[str, Number] = {
        "band": valve.band,
        "band_low": low,
        "band_high": high,
        "slip": valve.slip,
        "slip_low": least,
        "slip_high": most,
    }
    return numbers, (
        f"after a reversal the output moves by {valve.band:.3g} ({low:.3g} to "
        f"{high:.3g}) before the actuator does, "
        f"which then slips by {valve.slip:.3g} "
        f"({least:.3g} to {most:.3g}); "
        "free it first, other gains do not mend that"
    )


def _outside(shown: CauseEvidence, _weighed: Mapping[CauseName, float]) -> _Told:
    interval_s = shown.signals.interval_s
    wave = shown.line
    if wave.share < LINE and shown.jump.score > 0.0:
        at_s = shown.jump.at * interval_s
        size = float(np.ptp(shown.signals.measurement)) * abs(shown.jump.size)
        numbers: dict[str, Number] = {"kind": "step", "at_s": at_s, "size": size}
        return numbers, (
            f"a sudden load moves the measurement by {size:.3g} at {time_text(at_s)}; the loop "
            "takes it away in time, tighter gains sooner"
        )
    period_s = 2.0 * math.pi * interval_s / wave.angle
    numbers = {"kind": "period", "period_s": period_s, "size": wave.amplitude}
    of_period = f"of period {time_text(period_s)} and size {wave.amplitude:.3g}"
    return numbers, f"a wave {of_period} reaches the loop; its gains do not make it"


LINE = 0.25
"""Share of the disturbance's variance from which a line is its cause, and not a step."""


def _sensor(shown: CauseEvidence, _weighed: Mapping[CauseName, float]) -> _Told:
    fault = shown.faults[0]
    numbers: dict[str, Number] = {
        "fault": fault.fault,
        "size": fault.size,
        "count": float(fault.number),
        "share": fault.share,
    }
    return numbers, {
        "frozen": f"up to {fault.number} readings in a row are the same while the output moves",
        "steps": f"readings come in steps of {fault.size:.3g}, {fault.number} levels in all",
        "spikes": f"{fault.number} single readings leap by {fault.size:.3g} and are back at once",
        "noise": f"noise of {fault.size:.3g} (standard deviation) hides the moves of the setpoint",
    }[fault.fault]


def _none(shown: CauseEvidence, _weighed: Mapping[CauseName, float]) -> _Told:
    return {"sensitivity": shown.sensitivity}, "the loop does what its gains and loads explain"


def _record(_shown: CauseEvidence, weighed: Mapping[CauseName, float]) -> _Told:
    first, second = sorted(weighed, key=lambda cause: -weighed[cause])[:2]
    words = (
        f"{_WORDS[first].lower()} or {_WORDS[second].lower()}; record steps of the setpoint, up "
        "and down, each until the loop rests"
    )
    return {"likeliest": first, "second": second}, words
