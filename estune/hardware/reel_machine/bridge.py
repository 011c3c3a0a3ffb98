"""Bad readings, bridged by the last good one."""

import math
from typing import NamedTuple

from estune.hardware.driver import Reading
from estune.hardware.loop_messages import BadReadings


class Bridge(NamedTuple):
    """The readings so far.

    Attributes:
        last: The last good reading; None before the first, and after a stop was cleared.
        bad: Bad readings in a row up to now.
    """

    last: Reading | None = None
    bad: int = 0
    time_s: float = -math.inf


def bridge(
    rule: BadReadings, state: Bridge, reading: Reading, *, period_s: float
) -> tuple[Bridge, Reading]:
    """The reading of a sample, and the state after it.

    A bad reading has its fault and age, and the values of the last good one; before the first one
    it has no tension. Its time goes on, so that the guard sees neither a gap nor a step back.
    """
    last = state.last
    fault = reading.fault or _implausible(rule, state, reading)
    if not fault:
        return Bridge(reading, 0, reading.time_s), reading
    time_s = reading.time_s
    if not state.time_s < time_s < math.inf:
        time_s = state.time_s + period_s
    if last is None:
        held = Reading(time_s, math.nan, 0, reading.age_s, fault)
    else:
        age_s = max(time_s - last.time_s, 0.0)
        held = Reading(time_s, last.gauge_counts, last.encoder_counts, age_s, fault)
    return Bridge(last, state.bad + 1, time_s), held


def _implausible(rule: BadReadings, state: Bridge, reading: Reading) -> str:
    """Why a reading cannot follow the last good one; empty if it can."""
    last = state.last
    if not reading.time_s > state.time_s:
        return (
            f"the driver's time stamp went from {state.time_s:.6f} to {reading.time_s:.6f} s; "
            "check the device's clock, and whether its readings repeat"
        )
    if last is None:
        return ""
    if abs(reading.encoder_counts - last.encoder_counts) > rule.travel_counts:
        return (
            f"the encoder went from {last.encoder_counts} to {reading.encoder_counts} counts in "
            f"{1e3 * (reading.time_s - last.time_s):.3g} ms, more than guard.travel_max_rad at "
            "once; check the encoder"
        )
    return ""
