"""Time of an emulated machine."""

import math
import time

_AHEAD = 1.3
"""Longest time by which a machine that waits moves on after a reading, in intervals of the
readings: a sample of ordinary lateness is real time, and one that is missing is no gap in the
record, which begins at 1.5."""
_SHARE = 0.05
"""Share of a new interval in the usual one; a stall counts as two intervals at most."""


class MachineClock:
    """The computer's monotonic clock, which stands still where the computer is held up.

    Emulated hardware shares its computer with the loop that drives it. On two cores at a load of
    20 the loop's process was held up for 20 to 75 ms six times in a quarter of an hour: the motor
    of a real machine goes on meanwhile, and its guard has to stop it; an emulated one can wait.
    What it has waited, its clock is behind that of the computer from then on.
    """

    def __init__(self, waits_s: float) -> None:
        """Begins at the present.

        Args:
            waits_s: Longest time that the machine stands still without a reading, s: a loop that
                hangs is then cut off by the watchdog. Zero for a machine that never does.
        """
        self._waits_s = waits_s
        self._behind_s = 0.0
        self._usual_s = math.inf
        self._read_s = math.nan

    def now_s(self, *, reading: bool = False) -> float:
        """The machine's time, s.

        Args:
            reading: Whether this is the time of a reading.
        """
        now_s = time.monotonic() - self._behind_s
        passed_s = now_s - self._read_s
        held_s = passed_s - _AHEAD * self._usual_s
        if 0.0 < held_s <= self._waits_s:
            now_s -= held_s
            if reading:
                self._behind_s += held_s
        if reading:
            if math.isinf(self._usual_s) and passed_s > 0.0:
                self._usual_s = passed_s
            elif passed_s > 0.0:
                self._usual_s += _SHARE * (min(passed_s, 2.0 * self._usual_s) - self._usual_s)
            self._read_s = now_s
        return now_s
