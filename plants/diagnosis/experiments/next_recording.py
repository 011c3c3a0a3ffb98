"""What to record next, as a table that the machine's own controller follows.

It stays within what the records show to be safe: their travel, speed and acceleration, or the
greatest and least command, a tenth of the range kept free at either end. Several speeds in both
directions over the travel tell friction, its change with speed, direction and load, and what
depends on the angle; levels that are held tell what is slow, of a plant whose output may be
anything.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.next_data import NextRecording
from plants.effects.plant_scale import PlantScale, si

MARGIN = 0.1
"""Share of a range that stays free at either end."""
SPEEDS = (0.05, 0.2, 0.5, 0.9)
"""Speeds, relative to the greatest of the records."""
LONGEST_s = 12.0
"""Longest time of a sweep one way: a slow one covers less of the travel."""
STAIRS = 4
SETTLED = 5.0
"""Time constants that a level is held."""
RATE_Hz = 200.0
"""Greatest rate of the table; a controller draws straight lines between its rows."""


def next_recording(
    measurements: Sequence[MeasuredRecord],
    numbers: Sequence[BaseNumbers | None],
    scale: PlantScale,
) -> NextRecording:
    """What to record next of a machine whose records leave a question."""
    known = [b for b in numbers if b is not None]
    if known and all(b.is_free for b in known):
        return _motion([m for m in measurements if m.angle_rad is not None], scale)
    return _levels(measurements, known, scale)


def _motion(measurements: Sequence[MeasuredRecord], scale: PlantScale) -> NextRecording:
    """Sweeps both ways at several speeds."""
    angles = [np.asarray(m.angle_rad) for m in measurements]
    low, high = min(float(a.min()) for a in angles), max(float(a.max()) for a in angles)
    margin = MARGIN * (high - low)
    low, high = low + margin, high - margin
    smooth = [Smoother.slow(m.duration_s, m.sampling_Hz) for m in measurements]
    moved = list(zip(smooth, angles, strict=True))
    speed, most = (
        max(float(np.nanquantile(np.abs(s.sampled(a, *orders)), 0.95)) for s, a in moved)
        for orders in ((0.0, 1.0), (0.0, 0.0, 1.0))
    )
    if not (speed > 0.0 and most > 0.0 and high > low):
        sentence = (
            "Record next slow and fast motion both ways: in these records hardly anything moves."
        )
        return NextRecording(sentence, {})
    speeds = [share * speed for share in SPEEDS]
    middle, rate_Hz = 0.5 * (low + high), min(RATE_Hz, measurements[0].sampling_Hz)
    position = [np.full(round(rate_Hz), middle)]
    for v in speeds:
        reach = min(0.5 * (high - low), 0.5 * v * LONGEST_s)
        ends = middle + reach * np.array([0.0, 1.0, -1.0, 1.0, 0.0])
        legs = itertools.pairwise(ends.tolist())
        position += [a + _leg(b - a, v, most, rate_Hz) for a, b in legs]
    angle = np.concatenate(position)
    title, unit = scale.channel("angle_rad")
    listed = ", ".join(scale.amount(v, "rad/s") for v in speeds)
    sentence = (
        f"Record next, in a position loop of your own, motion both ways between "
        f"{scale.amount(low, 'rad')} and {scale.amount(high, 'rad')} at {listed} "
        f"({angle.size / rate_Hz:.0f} s): travel, speed and acceleration are within those of "
        f"these records. It tells apart what depends on direction, speed, load and {scale.along}."
    )
    time = np.arange(angle.size) / rate_Hz
    return NextRecording(sentence, {"time_s": time, f"{title}_{unit}": angle})


def _leg(distance: float, speed: float, acceleration: float, rate_Hz: float) -> FloatArray:
    """Way from rest to rest within a speed and an acceleration, shape (samples,)."""
    size = abs(distance)
    speed = min(speed, math.sqrt(size * acceleration))
    ramp_s = speed / acceleration
    whole_s = size / speed + ramp_s
    t = np.arange(1, math.ceil(whole_s * rate_Hz) + 1) / rate_Hz
    begun = 0.5 * acceleration * np.minimum(t, ramp_s) ** 2
    held = speed * np.clip(t - ramp_s, 0.0, whole_s - 2.0 * ramp_s)
    left = np.clip(t - (whole_s - ramp_s), 0.0, ramp_s)
    ended = speed * left - 0.5 * acceleration * left**2
    way: FloatArray = math.copysign(1.0, distance) * (begun + held + ended)
    return way


def _levels(
    measurements: Sequence[MeasuredRecord], numbers: Sequence[BaseNumbers], scale: PlantScale
) -> NextRecording:
    """Stairs up and down: of the setpoint of the loop, or of the command of an open one.

    A command that is held moves what integrates out of its range: there it is the loop's, too.
    """
    in_loop = any(b.integrates for b in numbers) or measurements[0].loop == "closed"
    name = measurements[0].outputs[0] if in_loop else measurements[0].command_column
    shown = [column for m in measurements if (column := m.channel(name)) is not None]
    low, high = min(float(c.min()) for c in shown), max(float(c.max()) for c in shown)
    if not high > low:
        sentence = "Record next motion that is slow and fast, both ways: these records rest."
        return NextRecording(sentence, {})
    margin = MARGIN * (high - low)
    levels = np.linspace(low + margin, high - margin, STAIRS + 1)
    slowest = max((b.slowest_s for b in numbers), default=0.0)
    longest = max(m.duration_s for m in measurements)
    # Whatever the model says, a stair is no longer than half of a record.
    hold_s = min(SETTLED * slowest if slowest > 0.0 else longest, 0.5 * longest)
    whole = np.concatenate([levels, levels[-2::-1], levels[1:], levels[-2::-1]])
    title, unit = scale.channel(name) if in_loop else ("command", scale.input_unit)
    unit = scale.output_unit if in_loop and scale.is_plant else unit
    what = "the setpoint of your loop" if in_loop else "the command"
    sentence = (
        f"Record next {what} in {STAIRS} stairs up and down, twice, from {levels[0]:.4g} to "
        f"{levels[-1]:.4g} {unit}".rstrip()
        + f", each held {si(hold_s, 's')}: within what these records show of the {title}. It "
        "tells apart what depends on level, direction and time."
    )
    time = np.asarray(np.arange(whole.size) * hold_s, dtype=np.float64)
    return NextRecording(sentence, {"time_s": time, "setpoint" if in_loop else "command": whole})
