"""Limits of a daemon's load: rigs held, connections begun and trials run at once.

A lease that is renewed late is the sign of an overload: the process, its machine or the network is
too slow. The number of rigs that run a trial at once is then multiplied by `DECREASE`, and grows
again, by a tenth at a time, while renewals are on time (additive increase, multiplicative decrease
as in D. M. Chiu and R. Jain, Computer Networks and ISDN Systems 17, 1989). Others wait their turn.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from estune.remote.state_machine.state import LEASE_S, RENEW_S
from estune.remote.zenoh.client_lease import LeaseRenewal

LATE_S = 0.5 * LEASE_S
"""Age of a lease, since it was renewed, that counts as late: two renewals of five are missing."""

MANY = 0.1
"""Fraction of the leases that are late in an overload; fewer are the fault of their rigs."""

DECREASE = 0.7
_ADJUST_S = 2.0 * RENEW_S
_LOOK_S = 0.5

_log = logging.getLogger(__name__)


class Admission:
    """Places for rigs, and turns for trials, in the order of their request.

    Attributes:
        computing: Held by a supervisor while it computes. One does at a time, as Python runs one
            thread at a time: two at once take 1.5 times as long for the same decisions (100 rigs
            on two cores are tuned within 1.71 instead of 1.46 times their trials), and delay the
            renewal of leases.
    """

    def __init__(self, renewal: LeaseRenewal, rigs: int, rigs_max: int | None = None) -> None:
        """Begins without a limit of trials."""
        self.computing = threading.Lock()
        self._renewal = renewal
        self._rigs = rigs
        self._rigs_max = rigs if rigs_max is None else rigs_max
        self._held: set[str] = set()
        self._limit = rigs
        self._running = 0
        self._waiting: deque[threading.Event] = deque()
        self._lock = threading.Lock()
        self._connecting = threading.Semaphore()
        self._adjusted_s = -math.inf

    def take_place(self, rig: str) -> str:
        """Takes a place for a rig; why there is none, if there is none."""
        with self._lock:
            if rig not in self._held:
                if len(self._held) >= self._rigs_max:
                    return f"this daemon supervises {self._rigs_max} rigs, its limit rigs_max"
                if self._is_late() and self._held:
                    return "this daemon is overloaded: it renews leases too late"
                self._held.add(rig)
        return ""

    def leave_place(self, rig: str) -> None:
        """Gives a rig's place to others."""
        with self._lock:
            self._held.discard(rig)

    @contextmanager
    def connecting(self, within_s: float) -> Iterator[None]:
        """Block that connects to a rig; no other does meanwhile, unless it takes too long."""
        alone = self._connecting.acquire(timeout=within_s)
        try:
            yield
        finally:
            if alone:
                self._connecting.release()

    @contextmanager
    def trial(self, waits: Callable[[str], None]) -> Iterator[None]:
        """Block of one trial, once it is its turn; the caller holds `computing`, but not in it.

        Args:
            waits: Called with the reason while it is not, again and again, and with an empty one
                when it is; it may raise, and the turn is given up.
        """
        turn = threading.Event()
        self.computing.release()
        with self._lock:
            self._waiting.append(turn)
            self._admit()
        try:
            while not turn.wait(_LOOK_S):
                waits(
                    f"waiting for its turn: {self._limit} of {self._rigs} rigs run trials at "
                    "once, as leases were renewed late"
                )
            waits("")
            yield
        finally:
            with self._lock:
                if turn.is_set():
                    self._running -= 1
                else:
                    self._waiting.remove(turn)
                self._admit()
            self.computing.acquire()

    def adjust(self) -> None:
        """Adjusts the number of trials at once; to be called several times a second."""
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._adjusted_s < _ADJUST_S:
                return
            self._adjusted_s, before = now_s, self._limit
            if self._is_late():
                self._limit = max(1, int(DECREASE * min(self._limit, self._running + 1)))
            else:
                self._limit = min(self._rigs, self._limit + math.ceil(0.1 * self._limit))
            self._admit()
        if self._limit < before == self._rigs:
            _log.warning("overloaded: leases are renewed late, so some trials wait their turn")
        elif before < self._limit == self._rigs:
            _log.warning("no longer overloaded: no trial waits its turn")

    def _is_late(self) -> bool:
        ages_s = self._renewal.ages_s()
        return sum(age_s > LATE_S for age_s in ages_s) > MANY * len(ages_s)

    def _admit(self) -> None:
        """Gives free turns to those who wait the longest; the lock is held."""
        while self._waiting and self._running < self._limit:
            self._waiting.popleft().set()
            self._running += 1
