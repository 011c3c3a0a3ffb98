"""The faults: what goes wrong, for how long, and how it is brought about."""

import contextlib
import resource
import signal
import subprocess
from collections.abc import Iterator
from enum import StrEnum
from random import Random
from typing import NamedTuple

from experiments.chaos.wire import Way, Wire

LEASE_S = 1.0
"""The lease of the link; a fault that lasts longer costs the client its right to command."""

DURATIONS_S = (0.3, 1.3, 2.8)
"""Shorter than the lease, longer, and longer than Zenoh's own patience with a silent peer."""

DISK_FULL_BYTES = 8192
"""A process for whom the disk is full can write so far into a file and no further."""


class Kind(StrEnum):
    """What can go wrong."""

    CUT = "connections cut"
    LOSE = "an answer lost with its connection"
    HANG = "the network hangs"
    HANG_THERE = "nothing reaches the rig"
    HANG_BACK = "nothing comes back"
    KILL_CLIENT = "client killed"
    KILL_RIG = "rig killed"
    STOP_CLIENT = "client frozen"
    STOP_RIG = "rig frozen"
    CTRL_C = "client stopped by Ctrl-C"
    RESTART = "rig restarted in good order"
    DOUBLE = "a submit delivered twice"
    LATE = "a submit delivered late"
    AGAIN = "old commands delivered again, in any order"
    NAMESAKE = "a second rig of the same name"
    TWIN = "a second process on the rig's ledger"
    RIVAL = "a second client gives commands"
    SLOW = "a slow consumer floods the rig with questions"
    RIG_DISK = "the rig's disk is full"
    CLIENT_DISK = "the client's disk is full"


class Fault(NamedTuple):
    """One fault.

    Attributes:
        kind: What goes wrong.
        lasts_s: For how long, where that has a meaning.
        after_trials: After how many more trials.
        delay_s: And how long after the last of them.
    """

    kind: Kind
    lasts_s: float
    after_trials: int
    delay_s: float


def schedule(count: int, seed: int) -> list[Fault]:
    """So many faults, each kind as often as any other, in an order drawn at random."""
    random = Random(seed)  # noqa: S311  for faults, not for secrets
    kinds = [kind for n in range(count // len(Kind) + 1) for kind in Kind]
    random.shuffle(kinds)
    return [
        Fault(
            kind,
            random.choice(DURATIONS_S),
            random.choice((0, 1, 1, 2, 4)),
            random.uniform(0.0, 0.1),
        )
        for kind in kinds[:count]
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
    """Whatever a process writes to a file fails, but for the first few bytes of it."""
    limit = resource.RLIMIT_FSIZE
    with contextlib.suppress(ProcessLookupError):
        _, hard = resource.prlimit(process.pid, limit)
        resource.prlimit(process.pid, limit, (DISK_FULL_BYTES, hard))
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(process.pid, limit, (hard, hard))
