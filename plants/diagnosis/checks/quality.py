"""Issues of one record, found before anything is fitted to it."""

import math
from collections.abc import Iterator

import numpy as np

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from estune.trial import SATURATED
from plants.diagnosis.checks.inner_loop import inner_loop
from plants.diagnosis.checks.sensors import faults, frozen_angle, shift_between
from plants.diagnosis.checks.units import mistaken_units, within_factor
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import OUTPUTS, MeasuredRecord
from plants.diagnosis.data.noise import upper_rms
from plants.diagnosis.models.base import BaseNumbers


def issues(
    m: MeasuredRecord,
    b: BaseNumbers | None,
    rate_Hz: float,
    step_rad: float,
    sign: DataIssue | None,
) -> Iterator[DataIssue]:
    """All issues of a record, its source left out; without numbers those that need no model."""
    if m.samples < CONSTANTS.fewest:
        sentence = f"{m.samples} samples are too few; record {CONSTANTS.fewest:g} or more"
        yield DataIssue("refused", sentence)
        return
    for name in OUTPUTS:
        readings = m.channel(name)
        if readings is not None:
            yield from faults(name, readings)
    yield from _unmoved(m)
    yield from _static(m)
    if b is None:
        return
    for look in (_too_short, _too_slow, _mislabelled, _at_limit):
        yield from look(m, b)
    inside = list(inner_loop(m, b))
    # A setpoint of another kind is in no unit of a torque, and has no sign of one.
    yield from inside or ([sign] if sign else mistaken_units(m, b, rate_Hz))
    if b.stiffness_N_m is None or m.angle_rad is None or m.tension_N is None:
        return
    per_N = 1.0 / b.tension_per_angle_N_rad
    yield from frozen_angle(m.angle_rad, m.tension_N, per_N, step_rad)
    late = shift_between(m.angle_rad, m.tension_N)
    if late:
        sentence = f"it comes {abs(late)} samples {'after' if late > 0 else 'before'} angle_rad"
        remedy = "the channels are not of the same moments; align them"
        yield DataIssue("warning", f"{sentence}: {remedy}", "tension_N")


def _too_short(m: MeasuredRecord, b: BaseNumbers) -> Iterator[DataIssue]:
    if b.is_free:  # it has no mode, and when its friction stops it is what a fit is to find
        return
    natural = b.natural_rad_s
    if natural > 0.0 and m.duration_s < math.pi / natural:
        yield DataIssue(
            "refused",
            f"{m.duration_s:.3g} s are less than half a period of the model's slowest mode, "
            f"{2.0 * math.pi / natural:.3g} s; record longer",
        )
    elif m.duration_s < b.slowest_s:
        yield DataIssue(
            "warning",
            f"{m.duration_s:.3g} s are less than the time constant of the model's slowest mode, "
            f"{b.slowest_s:.3g} s: what is slow cannot be told from an offset",
        )


def _too_slow(m: MeasuredRecord, b: BaseNumbers) -> Iterator[DataIssue]:
    sample_s = 1.0 / m.sampling_Hz
    if not b.is_free and b.natural_rad_s * sample_s > CONSTANTS.clear:
        yield DataIssue(
            "refused",
            f"its samples are {sample_s:.3g} s apart, and the model's slowest mode is over after "
            f"{CONSTANTS.clear / b.natural_rad_s:.3g} s; give the time in s, or record faster",
            "time_s",
        )


def _unmoved(m: MeasuredRecord) -> Iterator[DataIssue]:
    """Neither the command nor the response moves beyond its noise."""
    commanded = [c for c in (m.setpoint_N, m.current_A) if c is not None]
    # A setpoint has no noise, but may be as fast as noise is.
    still = m.setpoint_N is None or not _varies(m.setpoint_N)
    still = still and not any(_moves(c) for c in commanded)
    moving = [name for name in m.outputs if _moves(np.asarray(m.channel(name)))]
    if not (still or moving):
        shares = {n: _follows(commanded[0], np.asarray(m.channel(n)))[0] for n in m.outputs}
        # Of white noise the share times the samples is the square of a standard deviate.
        moving = [n for n, share in shares.items() if share * m.samples > CONSTANTS.clear**2]
    if still and not moving:
        yield DataIssue("refused", "nothing moves beyond its noise; excite the plant")
    elif still:
        sentence = f"the command stands still while {' and '.join(moving)} moves"
        yield DataIssue("warning", f"{sentence}: it shows drift and disturbances only")
    elif not moving:
        yield DataIssue("refused", "no output moves beyond its noise; excite the plant more")


def _moves(column: FloatArray) -> bool:
    """Whether a channel or its moving mean, in which there is less noise, exceeds the noise.

    The command of a loop on a coarse encoder is noisy, and moves the drive all the same.
    """
    noise, slow = upper_rms(column), _slow(column)
    moved = max(float(column.std()), float(slow.std()) * math.sqrt(column.size - slow.size + 1))
    return moved > CONSTANTS.above_noise * noise and _varies(column)


def _varies(column: FloatArray) -> bool:
    """Whether a channel is another than a constant, but for rounding."""
    return float(column.std()) > 1e-9 * float(np.abs(column).max())


def _static(m: MeasuredRecord) -> Iterator[DataIssue]:
    """The current is a function of the angle: friction, inertia and stiffness are one."""
    command = m.current_A if m.current_A is not None else m.setpoint_N
    if command is None or m.angle_rad is None or not np.ptp(m.angle_rad) > 0.0:
        return
    q = m.angle_rad
    bins = 64
    place = np.minimum((q - q.min()) / np.ptp(q) * bins, bins - 1).astype(np.int64)
    far = np.abs(np.diff(np.sign(q - np.median(q))))
    # A function of the angle says something where the angle comes back.
    if (far > 0).sum() < 2:
        return
    count = np.maximum(np.bincount(place, minlength=bins), 1)
    # A line within each bin, so that a steep function does not look like noise.
    inside = q - (np.bincount(place, q, bins) / count)[place]
    u = command - (np.bincount(place, command, bins) / count)[place]
    slope = float(inside @ u) / max(float(inside @ inside), 1e-300)
    unexplained = float((u - slope * inside).std()) / max(float(command.std()), 1e-300)
    if unexplained < CONSTANTS.allowance:
        yield DataIssue(
            "warning",
            f"it is a function of the angle to {unexplained:.1%}: friction, inertia and stiffness "
            "cannot be told apart by this record; move faster and reverse at other places",
            "current_A" if m.current_A is not None else "setpoint_N",
        )


def _mislabelled(m: MeasuredRecord, b: BaseNumbers) -> Iterator[DataIssue]:
    if m.setpoint_N is None or m.current_A is None:
        return
    command = m.setpoint_N / b.newtons_per_ampere
    if m.loop == "closed":
        apart = float(np.abs(m.current_A - command).max())
        if _moves(m.setpoint_N) and apart <= CONSTANTS.rounding * float(np.abs(command).max()):
            sentence = "the record is labelled closed, and the current is the open-loop command"
            yield DataIssue("warning", f"{sentence}; check the label", "current_A")
        return
    explained, gain = _follows(command, m.current_A)
    # A measured current may be noisy: it is judged by what is slow, too.
    # A limited or lagging actuator leaves that much.
    if max(explained, _follows(_slow(command), _slow(m.current_A))[0]) < CONSTANTS.small:
        sentence = "the record is labelled open, and the current does not follow the setpoint"
        yield DataIssue("refused", f"{sentence}; check the label and the columns", "current_A")
    elif explained > 1.0 - CONSTANTS.rounding and not within_factor(gain):
        yield DataIssue(
            "warning",
            f"the current is {gain:.3g} times setpoint x radius / torque constant; check the "
            "model's radius and torque constant and the column's unit",
            "current_A",
        )


def _slow(column: FloatArray) -> FloatArray:
    """Moving mean over a hundredth of the record."""
    width = max(1, round(0.01 * column.size))
    return np.convolve(column, np.full(width, 1.0 / width), "valid")


def _follows(command: FloatArray, current: FloatArray) -> tuple[float, float]:
    """Share of the current that the command explains, up to 50 samples late, and its gain."""
    from scipy.signal import correlate  # noqa: PLC0415  slow to import

    x, y = command - command.mean(), current - current.mean()
    xx, yy = float(x @ x), float(y @ y)
    if not (xx > 0.0 and yy > 0.0):
        return 1.0, 1.0
    likeness = correlate(y, x, method="fft")[x.size - 1 :]
    best = float(likeness[:51].max())
    return max(best, 0.0) ** 2 / (xx * yy), best / xx


def _at_limit(m: MeasuredRecord, b: BaseNumbers) -> Iterator[DataIssue]:
    flagged = np.zeros(m.samples, bool) if m.flags is None else (m.flags & SATURATED) > 0
    if m.current_A is not None:
        flagged |= np.abs(m.current_A) >= b.current_limit_A * (1.0 - CONSTANTS.rounding)
    share = float(flagged.mean())
    if share > CONSTANTS.small:
        yield DataIssue(
            "refused" if share > 0.5 else "warning",
            f"{share:.0%} of the samples are at the current limit; ask for less",
            "current_A",
            int(flagged.argmax()) + 1,
        )
