"""Whether a supervisor makes progress."""

import time

STUCK_AFTER_S = 120.0
"""Time without progress, beside the longest trial, after which a supervisor is stuck."""


class ProgressWatch:
    """When a supervisor last made progress, or for how long it rests on purpose."""

    def __init__(self) -> None:
        self._idle_until_s = time.monotonic()

    def mark(self, idle_s: float = 0.0) -> None:
        """Notes progress; the next may take so much longer."""
        self._idle_until_s = time.monotonic() + idle_s

    def is_stuck(self, longest_trial_s: float) -> bool:
        """Whether no progress was made for longer than any step may take."""
        allowed_s = STUCK_AFTER_S + 2.0 * min(longest_trial_s, STUCK_AFTER_S)  # some have no limit
        return time.monotonic() - self._idle_until_s > allowed_s
