"""Serves a rig in a process of its own, until its standard input is closed.

Prints the endpoint. Started by `served`; the arguments are a kind of rig of `make`, its name, the
endpoint, its ledger, and the endpoints of routers.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import plants
from estune.hardware import HardwareRig
from estune.remote import zenoh
from estune.trial import Rig
from tests.support_rigs import ScriptedRig, broken, diverged

SLOW_S = 100.0
"""Duration of the trials of the slow rigs, s."""


def make(kind: str, name: str) -> Rig:
    """Creates a rig of the given kind."""
    if kind.endswith("simulated"):
        pace = {"slow": SLOW_S, "paced": 0.5, "real-time": 1.0}.get(kind.split(maxsplit=1)[0], 0.0)
        return plants.reference_reel().rig(name=name, seed=3, pace=pace)
    if kind.endswith("hardware"):
        from tests.support_hardware import quick  # noqa: PLC0415  slow to import

        slow = {"step__duration_s": SLOW_S, "limits__duration_max_s": SLOW_S}
        return HardwareRig(quick(name=name, **(slow if kind.startswith("slow") else {})))
    if kind.startswith("rippled"):
        from tests.support_ripple import rippled  # noqa: PLC0415  slow to import

        return rippled(name, moved="moved" in kind)
    return {
        "scripted": lambda: ScriptedRig(name=name),
        "diverging": lambda: ScriptedRig(diverged, name=name),
        "broken": lambda: ScriptedRig(broken, name=name),
        "unhurried": lambda: ScriptedRig(duration_s=0.03, name=name),
        "slow scripted": lambda: ScriptedRig(duration_s=SLOW_S, name=name),
        "moving scripted": lambda: ScriptedRig(duration_s=SLOW_S, name=name, simulated=False),
    }[kind]()


@contextmanager
def served(
    kind: str,
    name: str = "reel",
    endpoint: str = "tcp/127.0.0.1:0",
    *routers: str,
    ledger: Path | None = None,
) -> Iterator["Served"]:
    """A rig served by another process while the block lasts.

    Its ledger is the given file, or a temporary one.
    """
    folder = TemporaryDirectory()
    file = str(ledger or Path(folder.name) / "ledger")
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.serve_rig", kind, name, endpoint, file, *routers],
        cwd=Path(__file__).parent.parent,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        line = process.stdout.readline().strip()
        assert line, f"the server of {kind} ended with code {process.wait()}"
        yield Served(process, line)
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()
        folder.cleanup()


@contextmanager
def hosted(kind: str, name: str = "reel", *routers: str) -> Iterator[str]:
    """A rig served by this process while the block lasts: its endpoint.

    The link is the same; another process takes 1.5 s of CPU to start.
    """
    with TemporaryDirectory() as folder, closing(make(kind, name)) as rig:
        file = Path(folder) / "ledger"
        with zenoh.serve(rig, "tcp/127.0.0.1:0", ledger=file, routers=routers) as at:
            yield at.endpoint


BOARD = (sys.executable, "-m", "tests.small_board", "board")


@contextmanager
def small_board(folder: Path, *missing: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """Runs the board that does without estune in its own process, without some verbs."""
    process = subprocess.Popen(
        [*BOARD, str(folder / "board.json"), *missing],
        cwd=Path(__file__).parent.parent,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


class Served:
    """A server process and its endpoint."""

    def __init__(self, process: subprocess.Popen, endpoint: str) -> None:
        self.process = process
        self.endpoint = endpoint

    def freeze(self) -> None:
        """Stops the process until SIGCONT; when this returns, none of its threads runs.

        One thread takes the signal and stops the others: on a busy machine they answered a
        daemon for up to 17 ms after it was sent.
        """
        self.process.send_signal(signal.SIGSTOP)
        os.waitpid(self.process.pid, os.WUNTRACED)


if __name__ == "__main__":
    kind, name, endpoint, file, *routers = sys.argv[1:]
    with zenoh.serve(make(kind, name), endpoint, ledger=Path(file), routers=routers) as server:
        print(server.endpoint, flush=True)
        sys.stdin.read()
