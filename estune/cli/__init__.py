"""The command line: what to type, and what a failure comes to.

Commands are loaded when they are called, so that help and version answer at once. An error estune
can name is one line on standard error, its number the exit code; any other keeps its traceback.
Ctrl-C, and a polite request to end from the system, stop the rig first.
"""

import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from cyclopts import App, CycloptsError

from estune.errors import EstuneError, InvalidInput

INTERRUPTED = 130
"""Exit code of a command that was stopped, as shells have it: 128 and the number of SIGINT."""


def _version() -> str:
    from importlib.metadata import version  # noqa: PLC0415  only --version needs it

    return version("estune")


app = App(
    name="estune",
    help="Tunes a cable reel's PIDF controller by step trials. Begin with: estune demo",
    version=_version,
    suppress_keyboard_interrupt=False,  # `run` says what became of the rig
)
_COMMANDS = (
    ("demo", "demo:demo", "Watch a simulated reel in another process being tuned over Zenoh."),
    ("serve", "serve:serve", "Serve a simulated reel, or any plant, as a rig on the network."),
    ("rig", "rig:rig", "Serve a reel on hardware, or an emulated one, as a rig on the network."),
    ("tune", "tune:tune", "Tune a rig by step trials."),
    ("resume", "tune:resume", "Go on with a run that was stopped or cut off."),
    ("sweep", "sweep:sweep", "Tune over cable lengths, and say how the gains follow them."),
    ("match", "match:match", "Tune several reels to one and the same cost."),
    ("list", "runs:list_runs", "List the runs of a folder."),
    ("show", "runs:show", "Show what a run came to."),
    ("export", "runs:export", "Write the trial records of a run as CSV or Parquet files."),
    (
        "export-controller",
        "rig:export_controller",
        "Write a controller with its gains as one C file for firmware.",
    ),
    ("apply", "rigs:apply", "Make a run's gains, or its start gains, live on a rig."),
    ("explain", "explain:explain", "Find what a model lacks that records show, and name it."),
    (
        "run-experiment",
        "experiment:run_experiment",
        "Run the trial of a file on a rig, and add its record to a folder.",
    ),
    ("improve", "improve:improve", "Mend a rig's model by experiment, and tune the rig with it."),
    ("rigs", "rigs:rigs", "Say which rigs answer at an endpoint, and how they stand."),
    ("doctor", "doctor:doctor", "Check a rig: what is fine, what to mend, and how."),
    ("estop", "rigs:estop", "Bring a rig to its safe state at once, and hold it there."),
    ("clear", "rigs:clear", "End a rig's emergency stop, once you have seen to the rig."),
    ("daemon", "daemon:daemon", "Tune and watch rigs for days, as a service."),
    ("control", "daemon:control", "Ask a daemon how a rig stands, or tell it what to do."),
    ("paper", "paper:paper", "Make the paper's figures again; say which of its claims hold here."),
)
for _place, (_name, _where, _help) in enumerate(_COMMANDS):
    app.command(f"estune.cli.{_where}", name=_name, help=_help, sort_key=_place)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line and ends the process with its exit code."""
    sys.path.append(str(Path.cwd()))  # where a user's own module:attribute is looked for, at last
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Runs one command.

    Returns:
        Its exit code.
    """
    interrupts = Interrupts()
    signal.signal(signal.SIGINT, interrupts)
    signal.signal(signal.SIGTERM, interrupts)
    try:
        code = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        _say(f"{' '.join(str(error).split())} (see: estune --help)")
        return InvalidInput.exit_code
    except EstuneError as error:
        if not interrupts.count:
            _say(str(error))
            return error.exit_code
        _say(f"stopped, but the rig has not confirmed which gains are live; check it: {error}")
        return INTERRUPTED
    except KeyboardInterrupt as stop:
        _say(_after(stop))
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has seen enough, as in: estune list | head
        sys.stderr.close()
        return 0
    return code if isinstance(code, int) else 0


class Interrupts:
    """Takes SIGINT and SIGTERM: the first stops, the second waits, the third gives up waiting.

    A stop ends in asking the rig for its gains; an impatient second Ctrl-C must not cut that off.

    Attributes:
        count: How many came.
    """

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002  a handler
        """Takes one."""
        self.count += 1
        if self.count == 2:
            _say("waiting for the rig to confirm its gains; once more ends without that")
        else:
            raise KeyboardInterrupt


def _after(stop: KeyboardInterrupt) -> str:
    """What to say of a stop: the gains the rig confirmed, if it was asked, and how to go on."""
    from estune.run.loop import Stopped  # noqa: PLC0415  slow to import

    if not isinstance(stop, Stopped):
        return "stopped"
    rig = stop.description
    on = f"; go on with: estune resume {stop.folder}" if stop.folder else ""
    return f"stopped; {rig.name} confirms that its own gains are live: {rig.gains}{on}"


def _say(text: str) -> None:
    print(f"estune: {text}", file=sys.stderr, flush=True)
