"""Faults of a chaos test: kinds, durations, schedule, and the ones that last."""

import contextlib
import resource
import signal
import subprocess
from collections.abc import Iterator, Sequence
from enum import StrEnum
from random import Random
from typing import NamedTuple

from experiments.chaos.wire import Way, Wire

LEASE_S = 1.0
"""Lease of the link; a longer fault costs the client its lease."""


class Durations(NamedTuple):
    """Times for which faults last, s: one of some, and of an outage the shortest and longest."""

    usual_s: tuple[float, ...]
    outage_s: tuple[float, float]


DURATIONS = Durations((0.3, 1.3, 2.8), (1.0, 20.0))
"""Shorter than the lease, longer, and longer than Zenoh's own timeout for a silent peer; a client
waits 30 s for a network by default."""

SHORT = Durations((0.3, 1.3), (1.0, 2.0))

DISK_FULL_BYTES = 8192
"""File size limit of a process whose disk is full."""


class LinkFault(StrEnum):
    """Kind of a fault of the link."""

    CUT = "connections cut"
    OUTAGE = "the network is down"
    LOSE = "a reply lost with its connection"
    HANG = "the network hangs"
    HANG_THERE = "nothing reaches the rig"
    HANG_BACK = "nothing comes back"
    KILL_CLIENT = "client killed"
    KILL_RIG = "rig killed"
    STOP_CLIENT = "client frozen"
    STOP_RIG = "rig frozen"
    CTRL_C = "client stopped by Ctrl-C"
    RESTART = "rig restarted properly"
    DOUBLE = "a submit delivered twice"
    LATE = "a submit delivered late"
    AGAIN = "old commands delivered again, in any order"
    NAMESAKE = "a second rig of the same name"
    TWIN = "a second process on the rig's ledger"
    RIVAL = "a second client gives commands"
    SLOW = "a slow consumer floods the rig with queries"
    FLOOD = "bare and garbled connections flood the rig's port"
    RIG_DISK = "the rig's disk is full"
    CLIENT_DISK = "the client's disk is full"


class Fault(NamedTuple):
    """One fault: its duration, if it lasts, the trials before it, and the delay after these."""

    kind: StrEnum
    lasts_s: float
    after_trials: int
    delay_s: float


def schedule(
    kinds: Sequence[StrEnum],
    pauses_trials: Sequence[int],
    count: int,
    seed: int,
    durations: Durations = DURATIONS,
) -> list[Fault]:
    """A number of faults, each kind equally often, in random order."""
    random = Random(seed)  # noqa: S311  for faults, not for secrets
    order = [kind for _ in range(-(-count // len(kinds))) for kind in kinds]
    random.shuffle(order)
    return [
        Fault(
            kind,
            random.uniform(*durations.outage_s)
            if kind is LinkFault.OUTAGE
            else random.choice(durations.usual_s),
            random.choice(pauses_trials),
            random.uniform(0.0, 0.1),
        )
        for kind in order[:count]
    ]


@contextlib.contextmanager
def stalled(wires: list[Wire], way: Way) -> Iterator[None]:
    """Nothing passes the wires."""
    for wire in wires:
        wire.stall(way)
    try:
        yield
    finally:
        for wire in wires:
            wire.flow()


@contextlib.contextmanager
def frozen(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """A process does not run."""
    process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        process.send_signal(signal.SIGCONT)


@contextlib.contextmanager
def disk_full(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Writes of a process to a file fail beyond its first bytes."""
    limit = resource.RLIMIT_FSIZE
    with contextlib.suppress(ProcessLookupError):
        _, hard = resource.prlimit(process.pid, limit)
        resource.prlimit(process.pid, limit, (DISK_FULL_BYTES, hard))
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(process.pid, limit, (hard, hard))
