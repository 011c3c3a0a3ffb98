"""Which stretches of logs show a loop in service, and why the others do not."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.service_records.sources import read_logs
from estune.service_records.stretches import Stretch, find_stretches

STILL = "the setpoint stands still: it shows load and noise, not the loop"


class JudgedStretch(NamedTuple):
    """A stretch of a log.

    Attributes:
        log: Name of the log.
        start_s: Time of its first sample.
        stop_s: Time of its last sample.
        reason: Why it shows nothing of the loop; empty where it does.
    """

    log: str
    start_s: float
    stop_s: float
    reason: str


def judged_stretches(path: Path) -> list[JudgedStretch]:
    """The stretches of the logs below a path, in their order.

    Raises:
        InvalidInput: there is no log of setpoint and measurement.
    """
    found = list[JudgedStretch]()
    for log in read_logs(path).logs:
        P = log.gains.P if log.gains is not None else None
        stretches, left_out = find_stretches(log, P)
        parts = [_judged(stretch, log.sampling_Hz) for stretch in stretches]
        parts += [JudgedStretch(*part) for part in left_out]
        found += sorted(parts, key=lambda part: part.start_s)
    return found


def _judged(stretch: Stretch, rate: float) -> JudgedStretch:
    stop_s = stretch.start_s + (stretch.samples - 1) / rate
    reason = "" if np.ptp(stretch.setpoint) > 0.0 else STILL
    return JudgedStretch(stretch.log, stretch.start_s, stop_s, reason)
