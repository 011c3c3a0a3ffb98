"""`estune demo`: the main job, with nothing but this machine."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from estune import api
from estune.cli.tune import TunerName, finish
from estune.errors import RigError
from estune.run.loop import Stopped
from estune.run.plan import DEFAULT_TUNER

_START_S = 60.0
"""How long the other process may take to serve the reel: the first time it compiles the model."""

_STOP_S = 5.0


def demo(
    *,
    tuner: TunerName = DEFAULT_TUNER,
    trials: int = 120,
    seed: int = 0,
    pace: float = 0.1,
    folder: Path = Path(api.RUNS),
) -> int:
    """Watch a simulated reel in another process being tuned over Zenoh.

    Args:
        tuner: How gains are proposed.
        trials: Greatest number of search trials.
        seed: Seed of the measurement noise.
        pace: Seconds a second of a trial takes: 1 is real time, 0 as fast as it can be simulated.
        folder: Folder that runs are kept in.
    """
    with served_reel(seed, pace) as endpoint:
        print(
            f"a simulated reel runs in another process; Zenoh reaches it at {endpoint}", flush=True
        )
        try:
            result = api.tune(endpoint, tuner=tuner, trials=trials, folder=folder)
        except Stopped:
            print(
                "the demo's reel ends with it; to go on, bring it back first with: "
                f"estune serve --listen {endpoint} --seed {seed} --pace {pace:g}"
            )
            raise
    more = {
        "next": "estune serve --listen tcp/127.0.0.1:7447    in one terminal",
        "": "estune tune tcp/127.0.0.1:7447              in another",
        "notebook": f"import estune; estune.load({str(result.folder)!r})",
    }
    return finish(result, None, more)


@contextmanager
def served_reel(seed: int, pace: float) -> Iterator[str]:
    """The reference reel served by a process of its own, which ends with the block.

    Yields:
        Its endpoint.

    Raises:
        RigError: the process does not come to serve it.
    """
    command = [sys.executable, "-m", "estune.cli", "serve", "--stop-on-eof", "--ledger", "memory"]
    command += ["--seed", str(seed), "--pace", str(pace)]
    process = subprocess.Popen(  # noqa: S603  our own interpreter and module
        command,
        stdin=subprocess.PIPE,  # closes however this process ends, and the other ends with it
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for us: the rig must live to put its gains back
    )
    try:
        yield _endpoint(process)
    finally:
        _end(process)


def _endpoint(process: "subprocess.Popen[str]") -> str:
    """Waits for the first line of `estune serve`: rig NAME at ENDPOINT."""
    late = threading.Timer(_START_S, process.kill)
    late.start()
    try:
        line = process.stdout.readline() if process.stdout else ""
    finally:
        late.cancel()
    words = line.split()
    if not words:
        raise RigError(
            f"the process that should serve the reel ended at once (exit code {process.wait()}); "
            "try it by itself: estune serve"
        )
    return words[-1]


def _end(process: "subprocess.Popen[str]") -> None:
    for stream in (process.stdin, process.stdout):
        if stream:
            stream.close()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
