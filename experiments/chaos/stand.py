"""The test stand: a rig process, the wires to it, and further processes on the network."""

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from estune.remote.zenoh.endpoints import host_and_port, with_port
from experiments.chaos.faults import frozen
from experiments.chaos.motions import Log
from experiments.chaos.processes import end, started
from experiments.chaos.wire import Wire

NAME = "reel"
BOOT_WITHIN_S = 60.0
FLOOD = 300
"""Connections of a flood; at `tcp/` Zenoh lets 512 wait (docs/how-to/security.md)."""


class Stand:
    """Keeps a rig running. A context manager.

    Attributes:
        log: Motions of all rigs, namesakes and twins included.
        near: Wire from a client to the rig.
        hub: Wire from a client to a router.
        back: Wire from the rig to the router.
        direct: Endpoint of the rig.
        ledger: The rig's ledger file.
        namesakes: Process ids of further rigs of the same name.
    """

    def __init__(self, folder: Path, pace: float) -> None:
        self.folder = folder
        self.ledger = folder / "rig.ledger"
        self.log = Log()
        self.namesakes: set[int] = set()
        self.direct, self._router_at = (with_port("tcp/127.0.0.1:0") for _ in range(2))
        self._pace = pace
        self._opened = contextlib.ExitStack()
        self.near, self.hub, self.back = (
            self._opened.enter_context(Wire(target))
            for target in (self.direct, self._router_at, self._router_at)
        )
        router = self._opened.enter_context(self.other("router", self._router_at))
        if not router.stdout or not router.stdout.readline():
            sys.exit("the router does not start")
        self.rig = self._boot(self.direct, self.ledger, self.back.endpoint)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        end(self.rig)
        self._opened.close()

    @property
    def wires(self) -> list[Wire]:
        """All wires."""
        return [self.near, self.hub, self.back]

    def restart(self) -> None:
        """Ends the rig, if it runs, and starts it again."""
        end(self.rig)
        self.rig = self._boot(self.direct, self.ledger, self.back.endpoint)

    @contextlib.contextmanager
    def namesake(self) -> Iterator[None]:
        """A second rig of the same name, connected to the router."""
        ledger = self.folder / "namesake.ledger"
        rig = self._boot(with_port("tcp/127.0.0.1:0"), ledger, self._router_at)
        self.namesakes.add(rig.pid)
        try:
            yield
        finally:
            end(rig)

    def is_twin_refused(self) -> bool:
        """Whether a second process on the rig's own ledger is refused."""
        twin = self._start(with_port("tcp/127.0.0.1:0"), self.ledger, self._router_at)
        served = self._wait_for(twin)
        end(twin)
        return not served

    def rival(self, name: str) -> contextlib.AbstractContextManager[object]:
        """A second client that submits a trial of that name."""
        return self.other("rival", self.direct, name)

    @contextlib.contextmanager
    def flood(self) -> Iterator[None]:
        """Connections to the rig's port that never become a session: half of them send noise."""
        with contextlib.ExitStack() as opened:
            for number in range(FLOOD):
                with contextlib.suppress(OSError):
                    bare = opened.enter_context(
                        socket.create_connection(host_and_port(self.direct), timeout=1.0)
                    )
                    if number % 2:
                        bare.sendall(bytes(range(256)) * 4)
            yield

    @contextlib.contextmanager
    def slow(self) -> Iterator[None]:
        """A consumer that queries more than it receives, and is then frozen."""
        with self.other("slow", self.direct) as process:
            if not process.stdout or not process.stdout.readline():
                sys.exit("the slow consumer does not start")
            with frozen(process):
                yield

    @contextlib.contextmanager
    def other(self, what: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
        """A further process on the network."""
        process = started("others", what, *arguments, errors=self.folder / "others.err")
        try:
            yield process
        finally:
            end(process)
            if process.stdout:
                process.stdout.close()

    def _boot(self, endpoint: str, ledger: Path, router: str) -> subprocess.Popen[bytes]:
        """A rig process that answers queries."""
        rig = self._start(endpoint, ledger, router)
        if not self._wait_for(rig):
            errors = (self.folder / "rig.err").read_text(encoding="utf-8")[-2000:]
            sys.exit(f"the rig does not start (exit code {rig.poll()}): {errors}")
        return rig

    def _start(self, endpoint: str, ledger: Path, router: str) -> subprocess.Popen[bytes]:
        errors = self.folder / "rig.err"
        rig = started("rig", NAME, endpoint, str(ledger), str(self._pace), router, errors=errors)
        if rig.stdout:
            self.log.follow(rig.stdout)
        return rig

    def _wait_for(self, rig: subprocess.Popen[bytes]) -> bool:
        """Waits until a rig answers queries; returns whether it does."""

        def booted(motions: Any) -> bool:
            return any(motion.rig == rig.pid for motion in motions)

        for _ in range(int(BOOT_WITHIN_S / 0.1)):
            if self.log.wait(booted, 0.1) or rig.poll() is not None:
                break
        return booted(self.log.motions())
