"""Setpoints to several rigs at once, at the rate of their source."""

import math
import threading
import time
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from estune.core.quantities import check_positive
from estune.errors import EstuneError, InvalidInput, RigError, StaleSetpoint
from estune.remote.zenoh.remote_rig import RemoteRig
from estune.trial import SETPOINT_S, Feedback, Setpoint

SILENT_S = 1.0
"""Time without any reply of a rig after which the stream ends, s."""


class Exchange(NamedTuple):
    """Replies to the setpoints of one period.

    Attributes:
        time_s: Monotonic time at which the setpoints were sent, s.
        round_trip_s: Time from the setpoint to its reply, s; NaN where it came after the period.
    """

    time_s: float
    feedback: tuple[Feedback, ...]
    round_trip_s: tuple[float, ...]


class _Reply(NamedTuple):
    """Latest reply of a rig, to the setpoint of a period."""

    period: int
    feedback: Feedback | EstuneError | None
    received_s: float


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
        self._due_s = self._sent_s = -math.inf
        self._arrived = threading.Condition()
        self._period = 0
        self._replies = [_Reply(0, None, math.inf)] * len(self._rigs)

    def exchange(self, setpoints: Sequence[Setpoint]) -> Exchange:
        """Sends the setpoints when they are due, and waits for the replies until the next are.

        The first call, or the first after a pause, waits up to `SILENT_S` for fresh feedback.

        Raises:
            EstuneError: a rig refuses its setpoint, does not reply for `SILENT_S`, or is gone.
        """
        self._wait_until_due()
        sent_s = time.monotonic()
        first, self._sent_s = sent_s - self._sent_s > SILENT_S, sent_s
        within_s = SILENT_S if first else self._period_s
        with self._arrived:
            self._period += 1
            if first:
                self._replies = [_Reply(0, None, sent_s)] * len(self._rigs)
        for n, (rig, setpoint) in enumerate(zip(self._rigs, setpoints, strict=True)):
            rig.send_setpoint(setpoint, partial(self._receive, self._period, n), SILENT_S)
        with self._arrived:
            self._arrived.wait_for(self._is_complete, sent_s + within_s - time.monotonic())
            replies = tuple(self._replies)
        feedback = tuple(map(self._checked, self._rigs, replies))
        in_time = (reply.period == self._period for reply in replies)
        trips = (
            reply.received_s - sent_s if here else math.nan
            for reply, here in zip(replies, in_time, strict=True)
        )
        return Exchange(sent_s, feedback, tuple(trips))

    def _wait_until_due(self) -> None:
        """Waits until a period after the last setpoints; late ones are not made up for."""
        now_s = time.monotonic()
        time.sleep(max(0.0, self._due_s - now_s))
        self._due_s = max(self._due_s, now_s - self._period_s) + self._period_s

    def _receive(self, period: int, n: int, reply: Feedback | EstuneError) -> None:
        """Takes a reply, unless the setpoint was dropped or one to a later setpoint was here."""
        if isinstance(reply, StaleSetpoint):
            return
        now_s = time.monotonic()
        with self._arrived:
            if period > self._replies[n].period:
                self._replies[n] = _Reply(period, reply, now_s)
                if self._is_complete():
                    self._arrived.notify()

    def _is_complete(self) -> bool:
        return all(reply.period == self._period for reply in self._replies)

    @staticmethod
    def _checked(rig: RemoteRig, reply: _Reply) -> Feedback:
        """Feedback of a rig; raises its error, or one if it has been silent for long."""
        if isinstance(reply.feedback, EstuneError):
            raise reply.feedback
        silent_s = time.monotonic() - reply.received_s
        if reply.feedback is None or silent_s > SILENT_S:
            raise RigError(
                f"rig {rig.name!r} has followed no setpoint for {silent_s:.1f} s: it is gone, "
                "overloaded, or too old to follow any; check it by estune doctor"
            )
        return reply.feedback
