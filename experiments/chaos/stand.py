"""The test stand: a rig process, the wires to it, and whoever else is on the network."""

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from estune.remote.zenoh.zenoh_session import with_port
from experiments.chaos.faults import frozen
from experiments.chaos.motions import Log
from experiments.chaos.processes import end, started
from experiments.chaos.rig import PLAIN
from experiments.chaos.wire import Wire

NAME = "reel"
BOOT_WITHIN_S = 60.0


class Stand:
    """Keeps a rig up. A context manager.

    Attributes:
        log: What the rigs did, namesakes and twins included.
        near: The wire from a client straight to the rig.
        hub: The wire from a client to a router.
        back: The wire from the rig to the router.
        direct: Where the rig listens.
        namesakes: Processes of rigs that only bear the name.
    """

    def __init__(self, folder: Path, *, plain: bool, pace: float) -> None:
        self.folder = folder
        self.plain = plain
        self._pace = pace
        self.log = Log()
        self.namesakes: set[int] = set()
        self.direct, self._router_at = (with_port("tcp/127.0.0.1:0") for _ in range(2))
        self._ledger = PLAIN if plain else str(folder / "rig.ledger")
        self._opened = contextlib.ExitStack()
        self.near = self._opened.enter_context(Wire(self.direct))
        self.hub = self._opened.enter_context(Wire(self._router_at))
        self.back = self._opened.enter_context(Wire(self._router_at))
        router = self._opened.enter_context(self.other("router", self._router_at))
        if not router.stdout or not router.stdout.readline():
            sys.exit("the router does not start")
        self.rig = self.boot(self.direct, self._ledger, self.back.endpoint)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        end(self.rig)
        self._opened.close()

    @property
    def wires(self) -> list[Wire]:
        """All of them."""
        return [self.near, self.hub, self.back]

    def rival(self, name: str) -> contextlib.AbstractContextManager[object]:
        """A second client that asks for a trial of that name."""
        who = "rival-plainly" if self.plain else "rival"
        return self.other(who, self.direct, name)

    @property
    def ledger(self) -> Path:
        """The file in which the rig notes its trials."""
        return self.folder / "rig.ledger"

    def restart(self) -> None:
        """Starts the rig again, which has ended."""
        end(self.rig)
        self.rig = self.boot(self.direct, self._ledger, self.back.endpoint)

    def boot(self, endpoint: str, ledger: str, router: str) -> subprocess.Popen[bytes]:
        """A rig process, once it can be asked."""
        rig = self.begin(endpoint, ledger, router)
        if not self.wait_for(rig):
            said = (self.folder / "rig.err").read_text(encoding="utf-8")[-2000:]
            sys.exit(f"the rig does not start (exit code {rig.poll()}): {said}")
        return rig

    def begin(self, endpoint: str, ledger: str, router: str) -> subprocess.Popen[bytes]:
        """A rig process that has just been started."""
        rig = started(
            "rig", NAME, endpoint, ledger, str(self._pace), router, errors=self.folder / "rig.err"
        )
        if rig.stdout:
            self.log.follow(rig.stdout)
        return rig

    def wait_for(self, rig: subprocess.Popen[bytes]) -> bool:
        """Waits until a rig can be asked; whether it came to that before it ended."""
        ended = threading.Event()

        def booted(motions: Any) -> bool:
            ended.set() if rig.poll() is not None else None
            return ended.is_set() or any(m.rig == rig.pid for m in motions)

        for _ in range(int(BOOT_WITHIN_S / 0.1)):
            if self.log.wait(booted, 0.1):
                break
        return any(motion.rig == rig.pid for motion in self.log.motions())

    @contextlib.contextmanager
    def namesake(self) -> Iterator[None]:
        """A second rig of the same name, known to the router."""
        ledger = PLAIN if self.plain else str(self.folder / "namesake.ledger")
        rig = self.boot(with_port("tcp/127.0.0.1:0"), ledger, self._router_at)
        self.namesakes.add(rig.pid)
        try:
            yield
        finally:
            end(rig)

    def twin_is_kept_out(self) -> bool:
        """Whether a second process on the rig's own ledger is turned away."""
        twin = self.begin(with_port("tcp/127.0.0.1:0"), self._ledger, self._router_at)
        served = self.wait_for(twin)
        end(twin)
        return not served

    @contextlib.contextmanager
    def other(self, what: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
        """Somebody else on the network."""
        process = started("others", what, *arguments, errors=self.folder / "others.err")
        try:
            yield process
        finally:
            end(process)
            if process.stdout:
                process.stdout.close()

    @contextlib.contextmanager
    def slow(self) -> Iterator[None]:
        """Somebody who asks for more than they take in, and who then does not take in anything."""
        with self.other("slow", self.direct) as process:
            if not process.stdout or not process.stdout.readline():
                sys.exit("the slow consumer does not start")
            with frozen(process):
                yield
