"""A loop that rings, damped or held by the limits of its effort alone."""

import math
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.intervals import peak_sensitivity
from estune.loop_model.limited_loop import setpoint_response
from estune.loop_model.margins import loop_response
from estune.loop_model.model import close_loop
from estune.service_records.identification import ServiceLoop

RINGS = 0.1
"""Damping ratio below which a loop rings: each swing is more than half as large as the last."""

LOWER = 0.8
"""Share of a gain from which it is named as one to lower."""

SWINGS = 3
"""Swings in the second half of a record that show a lasting oscillation."""

LEVEL = 0.5
"""Distance from the middle, in standard deviations, that a swing passes on both sides: noise about
the middle counts as none."""

SAME_PERIOD = 0.2
"""Relative difference up to which the period of a model is that of the record."""


class Ringing(NamedTuple):
    """The oscillation of a loop.

    Attributes:
        sensitivity: Largest |S| over frequency; of an unstable loop no margin, but its distance
            from the critical point.
        stable: Whether it would die out without the limits of the effort.
    """

    period_s: float
    sensitivity: float
    stable: bool

    def sentence(self, in_use: Gains, better: Gains | None) -> str:
        """What rings, and which gains to lower."""
        period = f"{self.period_s:.3g} s"
        if self.stable:
            said = f"The loop rings with a period of {period} (Ms {self.sensitivity:.3g})"
        else:
            said = (
                f"The loop swings with a period of {period}, and the limits of its effort alone "
                f"hold it: without them it is unstable (largest |S| {self.sensitivity:.3g})"
            )
        if better is None:
            return f"{said}: lower the gains."
        shares = {
            name: new / old
            for name, new, old in zip("PID", better.as_tuple(), in_use.as_tuple(), strict=False)
            if old
        }
        lower = [name for name, share in shares.items() if share < LOWER]
        return f"{said}: it needs less {', '.join(lower)}." if lower else f"{said}."


def ringing(loop: ServiceLoop, gains: Gains) -> Ringing | None:
    """The oscillation of a loop with some gains; None where it does not ring.

    An unstable loop is believed only where the record swings as the model does with its limits:
    else the model is wrong.
    """
    model, settings = loop.fit.model, loop.settings
    response = loop_response(model, gains, settings)
    peak = peak_sensitivity(model, gains, settings)
    if not response.stable:
        period = _limit_cycle(loop, gains)
        return Ringing(period / settings.sampling_Hz, peak, stable=False) if period else None
    roots = np.roots(close_loop(model, gains, settings).characteristic)
    turning = [complex(np.log(root)) for root in roots if root.imag > 0.0]
    if not turning:
        return None
    least = min(turning, key=lambda root: -root.real / abs(root))
    if -least.real / abs(least) >= RINGS:
        return None
    return Ringing(2.0 * math.pi / least.imag / settings.sampling_Hz, peak, stable=True)


def _limit_cycle(loop: ServiceLoop, gains: Gains) -> float:
    """Period of a lasting oscillation, samples, in a record and by the model; zero without one."""
    for record in sorted(loop.records, key=lambda one: -one.samples):
        if not np.isfinite(record.limits).any():
            continue
        measured = _period(record.measurement)
        output = setpoint_response(loop.fit.model, record, gains, loop.settings)[0]
        foretold = _period(output) if np.isfinite(output).all() else 0.0
        if measured and abs(foretold - measured) <= SAME_PERIOD * measured:
            return measured
    return 0.0


def _period(signal: FloatArray) -> float:
    """Mean period of the second half of a signal, samples; zero where it does not swing."""
    half = signal[signal.size // 2 :]
    half = half - half.mean()
    level = LEVEL * float(half.std())
    if not level:
        return 0.0
    sides = np.where(half > level, 1, np.where(half < -level, -1, 0))
    at = np.flatnonzero(sides)
    ups = at[1:][(sides[at[1:]] > 0) & (sides[at[:-1]] < 0)]
    if ups.size <= SWINGS:
        return 0.0
    lengths = np.diff(ups)
    return float(lengths.mean()) if np.ptp(lengths) < lengths.mean() else 0.0
