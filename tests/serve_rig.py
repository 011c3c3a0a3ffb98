"""Serves a rig in a process of its own, until its standard input is closed.

Prints the endpoint. Started by `served`; the arguments are a kind that `make` knows, the name the
rig is to be served under, the endpoint, and the endpoint of a router, if any.
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import plants
from estune import bus
from estune.trial import Rig
from tests.support_rigs import ScriptedRig, broken, diverged

SLOW_S = 100.0
"""How long the trials of the slow rigs take if nobody stops them."""


def make(kind: str, name: str) -> Rig:
    """A rig of the kind named."""
    if kind.endswith("simulated"):
        pace = SLOW_S if kind.startswith("slow") else 0.0
        return plants.reference_reel().rig(name=name, seed=3, pace=pace)
    return {
        "scripted": lambda: ScriptedRig(name=name),
        "diverging": lambda: ScriptedRig(diverged, name=name),
        "broken": lambda: ScriptedRig(broken, name=name),
        "unhurried": lambda: ScriptedRig(duration_s=0.03, name=name),
        "slow scripted": lambda: ScriptedRig(duration_s=SLOW_S, name=name),
    }[kind]()


@contextmanager
def served(
    kind: str, name: str = "reel", endpoint: str = "tcp/127.0.0.1:0", *routers: str
) -> Iterator["Served"]:
    """A rig served by another process, for as long as the block lasts."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.serve_rig", kind, name, endpoint, *routers],
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


class Served:
    """A server process, and where it listens."""

    def __init__(self, process: subprocess.Popen, endpoint: str) -> None:
        self.process = process
        self.endpoint = endpoint


if __name__ == "__main__":
    kind, name, endpoint, *routers = sys.argv[1:]
    with bus.serve(make(kind, name), endpoint, routers=routers) as server:
        print(server.endpoint, flush=True)
        sys.stdin.read()
