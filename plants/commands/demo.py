"""`estune demo`: a simulated reel in another process, tuned over Zenoh."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from estune import api
from estune.cli.options import TunerName
from estune.cli.tune import finish
from estune.cli.values import Flag, RunsFolder
from estune.cli.watch import watch
from estune.run.journal import RUNS
from estune.run.loop import Stopped
from estune.support.child_process import child_process, next_line
from estune.tuners import DEFAULT_TUNER

_START_S = 60.0
"""Time limit of the other process to serve the reel; the first time, it compiles the model."""

_STOP_S = 5.0


def demo(
    *,
    tuner: TunerName = DEFAULT_TUNER,
    trials: int = 120,
    seed: int = 0,
    pace: float = 0.1,
    page: Flag = False,
    port: int | None = None,
    folder: RunsFolder = Path(RUNS),
) -> int:
    """Tune a simulated reel, which runs in another process, over Zenoh.

    Args:
        tuner: Tuner.
        trials: Maximum number of search trials.
        seed: Seed of the measurement noise.
        pace: Wall-clock seconds per simulated second: 1 is real time, 0 is as fast as possible.
        page: Show the reel on a page in the browser instead, from which it is tuned, until Ctrl-C.
        port: Port of the page; by default 8765, or a free one where that is taken.
    """
    with served_reel(seed, pace) as endpoint:
        print(
            f"a simulated reel runs in another process; Zenoh reaches it at {endpoint}", flush=True
        )
        if page:
            print(_FIRST_STEPS, flush=True)
            watch(endpoint, allow_commands=True, port=port, folder=folder)
            return 0
        try:
            result = api.tune(endpoint, tuner=tuner, trials=trials, folder=folder)
        except Stopped:
            print(
                "the reel of the demo ends with it; to continue, restart the reel with: "
                f"estune serve --listen {endpoint} --seed {seed} --pace {pace:g}"
            )
            raise
    more = {
        "next": "estune serve --listen tcp/127.0.0.1:7447    in one terminal",
        "": "estune tune tcp/127.0.0.1:7447              in another",
        "notebook": f"import estune; estune.load({str(result.folder)!r})",
    }
    return finish(result, None, more)


_FIRST_STEPS = """
Open the address below in a browser on this machine. Then:
  1. Start a tuning, and Start: about 8 trials, shown as they run
  2. Tune by the model: move a slider, and see the response predicted
  3. Try these gains once, then Make these gains live
Ctrl-C ends the reel and the page.
"""


@contextmanager
def served_reel(seed: int, pace: float) -> Iterator[str]:
    """Serves the reference reel in a process of its own, for the duration of the block.

    Yields:
        Its endpoint.

    Raises:
        RigError: the process ends, or does not serve the reel in time.
    """
    arguments = ["serve", "--stop-on-eof", "--ledger", "memory"]
    arguments += ["--seed", str(seed), "--pace", str(pace)]
    # In a session of its own, Ctrl-C does not reach the rig, which restores its gains.
    with child_process(
        "estune", *arguments, end_within_s=_STOP_S, start_new_session=True
    ) as process:
        late = threading.Timer(_START_S, process.kill)
        late.start()
        try:
            endpoint = next_line(process).split()[-1]  # rig NAME at ENDPOINT
        finally:
            late.cancel()
        yield endpoint
