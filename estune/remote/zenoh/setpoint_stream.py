"""Setpoints to several rigs at once, at the rate of their source."""

import math
import threading
import time
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from estune.core.quantities import check_positive
from estune.errors import EstuneError, InvalidInput, RigError
from estune.remote.zenoh.remote_rig import RemoteRig
from estune.trial import SETPOINT_S, Feedback, Setpoint

SILENT_S = 1.0
"""Time without any reply of a rig after which the stream ends, s."""


class Exchange(NamedTuple):
    """Replies to the setpoints of one period.

    Attributes:
        time_s: Monotonic time at which the setpoints were sent, s.
        feedback: Last feedback of each rig.
        round_trip_s: Time from the setpoint to its reply, s; NaN where none came in the period.
    """

    time_s: float
    feedback: tuple[Feedback, ...]
    round_trip_s: tuple[float, ...]


class SetpointStream:
    """A source's connection to its rigs: each period it sends a setpoint to all of them.

    The rigs keep a setpoint for `SETPOINT_S`; so they return to their hold tension whatever
    happens to the source. One thread may use it.
    """

    def __init__(self, rigs: Sequence[RemoteRig], rate_Hz: float) -> None:
        """Prepares a stream; the first setpoints acquire the leases.

        Raises:
            InvalidInput: the rate is not above that at which setpoints would expire.
        """
        check_positive("rate of setpoints", rate_Hz, "Hz")
        if rate_Hz < 2.0 / SETPOINT_S:
            raise InvalidInput(
                f"{rate_Hz:g} setpoints per second are too few: each is in force for "
                f"{SETPOINT_S:g} s; send {2.0 / SETPOINT_S:g} or more"
            )
        self._rigs = tuple(rigs)
        self._period_s = 1.0 / rate_Hz
        self._due_s = -math.inf
        self._arrived = threading.Condition()
        self._replies: list[tuple[Feedback | EstuneError, float] | None] = [None] * len(self._rigs)
        self._period = 0
        self._heard_s: list[float] = []
        self._feedback: list[Feedback | None] = [None] * len(self._rigs)

    def exchange(self, setpoints: Sequence[Setpoint]) -> Exchange:
        """Sends the setpoints when they are due, and waits for the replies until the next are.

        The first call waits up to `SILENT_S`, as the rigs have given no feedback yet.

        Raises:
            EstuneError: a rig refuses its setpoint, does not reply for `SILENT_S`, or is gone.
        """
        self._wait_until_due()
        sent_s, first = time.monotonic(), not self._heard_s
        within_s = SILENT_S if first else self._period_s
        with self._arrived:
            self._period += 1
            self._replies = [None] * len(self._rigs)
        if first:
            self._heard_s = [sent_s] * len(self._rigs)
        for n, (rig, setpoint) in enumerate(zip(self._rigs, setpoints, strict=True)):
            receive = partial(self._receive, self._period, n)
            rig.send_setpoint(setpoint, receive, SILENT_S)
        with self._arrived:
            self._arrived.wait_for(self._is_complete, sent_s + within_s - time.monotonic())
            replies = tuple(self._replies)
        trips = [self._take(n, reply, sent_s) for n, reply in enumerate(replies)]
        feedback = tuple(f for f in self._feedback if f is not None)
        return Exchange(sent_s, feedback, tuple(trips))

    def _wait_until_due(self) -> None:
        """Waits until a period after the last setpoints; late ones are not made up for."""
        now_s = time.monotonic()
        time.sleep(max(0.0, self._due_s - now_s))
        self._due_s = max(self._due_s, now_s - self._period_s) + self._period_s

    def _receive(self, period: int, n: int, reply: Feedback | EstuneError) -> None:
        now_s = time.monotonic()
        with self._arrived:
            if period == self._period and self._replies[n] is None:
                self._replies[n] = reply, now_s
                if self._is_complete():
                    self._arrived.notify()

    def _is_complete(self) -> bool:
        return None not in self._replies

    def _take(
        self, n: int, reply: tuple[Feedback | EstuneError, float] | None, sent_s: float
    ) -> float:
        """Stores the feedback of a rig; returns its round trip, s."""
        if reply is None:
            silent_s = time.monotonic() - self._heard_s[n]
            if silent_s > SILENT_S or self._feedback[n] is None:
                raise RigError(
                    f"rig {self._rigs[n].name!r} has answered no setpoint for {silent_s:.1f} s: "
                    "it is gone, overloaded, or too old to follow any; check it by estune doctor"
                )
            return math.nan
        feedback, self._heard_s[n] = reply
        if isinstance(feedback, EstuneError):
            raise feedback
        self._feedback[n] = feedback
        return self._heard_s[n] - sent_s
