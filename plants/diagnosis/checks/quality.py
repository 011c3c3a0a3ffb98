"""What is wrong with measurements, before anything is fitted to them."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import SATURATED
from plants.diagnosis.checks.units import mistaken_units
from plants.diagnosis.data.measured_record import (
    OUTPUTS,
    ROUNDING,
    DataIssue,
    Level,
    MeasuredRecord,
)
from plants.diagnosis.data.noise import FEWEST, upper_rms
from plants.diagnosis.data.sensors import faults, held_against, shift_between
from plants.diagnosis.models.base import BaseNumbers

MOVES = 3.0
"""A channel moves when its rms is so many times its noise."""
SETTLES = 3.0
"""A record should last so many time constants of the slowest mode."""
AT_LIMIT = (0.1, 0.5)
"""Shares of the samples at the current limit from which a record is warned of, and refused."""
STATIC = 0.01
"""The current is a function of the angle if the angle leaves less than this of it unexplained."""
PLACES = 64
"""Places of the angle that the current is averaged at."""
TURNS_BACK = 2
"""Times the angle must go to and fro for a function of it to say something."""
CALIBRATION = 0.2
"""Gain of the recorded current over the command by which an open loop is worth a warning."""
FOLLOWS = 0.2
"""Share of the current that the command must explain in an open loop; a limited or lagging
actuator leaves that much."""
LATEST = 50
"""Samples by which the measured current may come after the command."""


def check(
    measurements: Sequence[MeasuredRecord], model: Any
) -> tuple[tuple[MeasuredRecord, ...], tuple[DataIssue, ...]]:
    """The measurements that can be used, and everything found wrong.

    Args:
        measurements: The records.
        model: What they are to be held against, as it was given: a `ReelProgress`, an `UnloadedReel`, a
            plant with a linear model; of others only what needs no model is looked at.

    Raises:
        InvalidInput: none can be used; the message says why for each.
    """
    kept, findings = _of_one_rig(measurements)
    usable = []
    for m in kept:
        found = [
            DataIssue(said.level, m.source or m.name, said.column, said.row, said.sentence)
            for said in _looked_through(m, BaseNumbers.of(model, m))
        ]
        findings += found
        if not any(f.level == "refused" for f in found):
            usable.append(m)
    if not usable:
        raise InvalidInput(f"no record can be used: {'; '.join(str(f) for f in findings)}")
    return tuple(usable), tuple(findings)


def _of_one_rig(
    measurements: Sequence[MeasuredRecord],
) -> tuple[list[MeasuredRecord], list[DataIssue]]:
    """The records of the rig with most of them, by time; those without a name go with any."""
    lasting: dict[str, float] = defaultdict(float)
    for m in measurements:
        if m.rig:
            lasting[m.rig] += m.duration_s
    if len(lasting) < 2:
        return list(measurements), []
    rig = max(lasting, key=lambda name: lasting[name])
    findings = [
        DataIssue(
            "refused",
            m.source or m.name,
            "",
            None,
            f"this is a record of {m.rig!r} among those of {rig!r}; give one rig's at a time",
        )
        for m in measurements
        if m.rig not in ("", rig)
    ]
    return [m for m in measurements if m.rig in ("", rig)], findings


class Issue(NamedTuple):
    """A finding before it is known of which record."""

    level: Level
    column: str
    row: int | None
    sentence: str


def _looked_through(m: MeasuredRecord, b: BaseNumbers | None) -> Iterator[Issue]:
    """Everything found wrong with one record."""
    if m.samples < FEWEST:
        yield Issue(
            "refused", "", None, f"{m.samples} samples are too few; record {FEWEST} or more"
        )
        return
    for name in OUTPUTS:
        column = m.channel(name)
        if column is not None:
            for refused, row, sentence in faults(column):
                yield Issue("refused" if refused else "warning", name, row, sentence)
    yield from _unmoved(m)
    yield from _static(m)
    if b is None:
        return
    yield from _too_short(m, b)
    yield from _labels(m, b)
    yield from _at_limit(m, b)
    for column_name, unit, sentence in mistaken_units(m, b):
        yield Issue("refused" if unit else "warning", column_name, None, sentence)
    if b.stiffness_N_m is not None and m.angle_rad is not None and m.tension_N is not None:
        for refused, row, sentence in held_against(
            m.angle_rad, m.tension_N, 1.0 / b.tension_per_angle_N_rad
        ):
            yield Issue("refused" if refused else "warning", "angle_rad", row, sentence)
        late = shift_between(m.angle_rad, m.tension_N)
        if late:
            which = "after" if late > 0 else "before"
            yield Issue(
                "warning",
                "tension_N",
                None,
                f"it comes {abs(late)} samples {which} angle_rad: the channels are not of the "
                "same moments; align them",
            )


def _too_short(m: MeasuredRecord, b: BaseNumbers) -> Iterator[Issue]:
    natural = b.natural_rad_s
    if natural > 0.0 and m.duration_s < math.pi / natural:
        yield Issue(
            "refused",
            "",
            None,
            f"{m.duration_s:.3g} s are less than half a period of the model's slowest mode, "
            f"{2.0 * math.pi / natural:.3g} s; record longer",
        )
    elif m.duration_s < SETTLES * b.slowest_s:
        yield Issue(
            "warning",
            "",
            None,
            f"{m.duration_s:.3g} s are short against the model's slowest mode, which settles with "
            f"{b.slowest_s:.3g} s: what is slow cannot be told from an offset",
        )


def _unmoved(m: MeasuredRecord) -> Iterator[Issue]:
    """Neither the command nor the response moves beyond its noise."""
    commanded = [c for c in (m.setpoint_N, m.current_A) if c is not None]
    still = not any(_moves(c) for c in commanded)
    moving = [name for name in m.outputs if _moves(np.asarray(m.channel(name)))]
    if still and not moving:
        yield Issue("refused", "", None, "nothing moves beyond its noise; excite the reel")
    elif still:
        sentence = f"the command stands still while {' and '.join(moving)} moves"
        yield Issue("warning", "", None, f"{sentence}: it shows drift and disturbances only")
    elif not moving:
        yield Issue("refused", "", None, "no output moves beyond its noise; excite the reel more")


def _moves(column: FloatArray) -> bool:
    spread = float(column.std())
    rounding = 1e-9 * float(np.abs(column).max())
    return spread > max(MOVES * upper_rms(column), rounding)


def _static(m: MeasuredRecord) -> Iterator[Issue]:
    """The current is a function of the angle: friction, inertia and stiffness are one."""
    command = m.current_A if m.current_A is not None else m.setpoint_N
    if command is None or m.angle_rad is None or not np.ptp(m.angle_rad) > 0.0:
        return
    q = m.angle_rad
    place = np.minimum((q - q.min()) / np.ptp(q) * PLACES, PLACES - 1).astype(np.int64)
    far = np.abs(np.diff(np.sign(q - np.median(q))))
    if (far > 0).sum() < 2 * TURNS_BACK:
        return
    count = np.maximum(np.bincount(place, minlength=PLACES), 1)
    # A line within each place, for steep functions not to look like scatter.
    inside = q - (np.bincount(place, q, PLACES) / count)[place]
    u = command - (np.bincount(place, command, PLACES) / count)[place]
    slope = float(inside @ u) / max(float(inside @ inside), 1e-300)
    left = float((u - slope * inside).std()) / max(float(command.std()), 1e-300)
    if left < STATIC:
        yield Issue(
            "warning",
            "current_A" if m.current_A is not None else "setpoint_N",
            None,
            f"it is a function of the angle to {left:.1%}: friction, inertia and stiffness cannot "
            "be told apart by this record; move faster and reverse at other places",
        )


def _labels(m: MeasuredRecord, b: BaseNumbers) -> Iterator[Issue]:
    """Whether the record is of the loop that its label says."""
    if m.setpoint_N is None or m.current_A is None:
        return
    command = m.setpoint_N / b.newtons_per_ampere
    if m.loop == "closed":
        apart = float(np.abs(m.current_A - command).max())
        if _moves(m.setpoint_N) and apart <= ROUNDING * float(np.abs(command).max()):
            sentence = "the record is labelled closed, and the current is the open-loop"
            yield Issue("warning", "current_A", None, f"{sentence} command; check the label")
        return
    follows, gain = _follows(command, m.current_A)
    if follows < FOLLOWS:
        yield Issue(
            "refused",
            "current_A",
            None,
            "the record is labelled open, and the current does not follow the setpoint; check the "
            "label and the columns",
        )
    elif follows > 1.0 - ROUNDING and abs(gain - 1.0) > CALIBRATION:
        yield Issue(
            "warning",
            "current_A",
            None,
            f"the current is {gain:.3g} times setpoint x radius / torque constant; check the "
            "model's radius and torque constant and the column's unit",
        )


def _follows(command: FloatArray, current: FloatArray) -> tuple[float, float]:
    """Share of the current that the command explains, however late within reason, and its gain."""
    x, y = command - command.mean(), current - current.mean()
    xx, yy = float(x @ x), float(y @ y)
    if not (xx > 0.0 and yy > 0.0):
        return 1.0, 1.0
    size = 1 << (2 * x.size - 1).bit_length()
    likeness = np.fft.irfft(np.fft.rfft(y, size) * np.conj(np.fft.rfft(x, size)), size)
    best = float(likeness[: LATEST + 1].max())
    return max(best, 0.0) ** 2 / (xx * yy), best / xx


def _at_limit(m: MeasuredRecord, b: BaseNumbers) -> Iterator[Issue]:
    flagged = np.zeros(m.samples, bool) if m.flags is None else (m.flags & SATURATED) > 0
    if m.current_A is not None:
        flagged |= np.abs(m.current_A) >= b.current_limit_A * (1.0 - ROUNDING)
    share = float(flagged.mean())
    if share > AT_LIMIT[0]:
        row = int(flagged.argmax()) + 1
        yield Issue(
            "refused" if share > AT_LIMIT[1] else "warning",
            "current_A",
            row,
            f"{share:.0%} of the samples are at the current limit; ask for less",
        )
