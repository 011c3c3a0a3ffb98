"""A board's own clock on the host's monotonic clock."""

from typing import NamedTuple

WRAP_us = 2**32
DRIFT_MAX = 3e-4
"""Greatest rate at which a board's clock falls behind the host's; quartz is within 1e-4."""


class BoardClock(NamedTuple):
    """Offset from board to host, from the fastest answers so far.

    An answer cannot arrive before it was stamped, so that the least difference of arrival and
    stamp is nearest to the truth; it is allowed to grow with the drift of the board's clock.

    Attributes:
        unwrapped_us: The board's last stamp, without wraps.
        offset_s: Host time less board time; NaN before the first stamp.
    """

    unwrapped_us: int = 0
    offset_s: float = float("nan")

    def stamped(self, stamp_us: int, arrival_s: float) -> "BoardClock":
        """The clock after an answer.

        Args:
            stamp_us: The board's counter of microseconds, 32 bits.
            arrival_s: `time.monotonic()` at its arrival.
        """
        passed_us = (stamp_us - self.unwrapped_us) % WRAP_us
        if self.offset_s != self.offset_s:  # the first stamp
            return BoardClock(stamp_us, arrival_s - 1e-6 * stamp_us)
        unwrapped_us = self.unwrapped_us + passed_us
        late_s = arrival_s - 1e-6 * unwrapped_us
        return BoardClock(unwrapped_us, min(late_s, self.offset_s + 1e-6 * passed_us * DRIFT_MAX))

    @property
    def time_s(self) -> float:
        """The last stamp on the host's monotonic clock, s."""
        return 1e-6 * self.unwrapped_us + self.offset_s


def unwrapped(counts: int, last: int) -> int:
    """A counter of 32 bits that wraps, continued from its last value."""
    half = 1 << 31
    return last + ((counts - last + half) % (2 * half)) - half
