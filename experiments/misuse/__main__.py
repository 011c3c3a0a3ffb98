"""Do random commands and damaged files end in anything but a refusal?

Command: `python -m experiments.misuse`.
Target: no traceback, no gain beyond the rig's bounds, and the rig runs a trial at the end.

Files of every kind that a command reads are damaged, or their values made extreme, and read. Then
commands with right and wrong words, and the verbs of the wire with extreme numbers, are sent to an
emulated reel in virtual time, in a process of its own. What takes 5 s is interrupted as by Ctrl-C.
Printed are the numbers by command and exit code, and what went wrong.
"""

import argparse
import contextlib
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from estune.errors import EstuneError
from estune.hardware import read_config
from estune.remote import zenoh
from estune.support.child_process import child_process, next_line
from estune.trial import Outcome, TrialRequest
from experiments.misuse.commands import Commands
from experiments.misuse.files import Files
from experiments.results import Target, at_least, at_most, command_line, print_results
from experiments.virtual_loop import virtual_rig
from plants.emulator import RIG_FILE

COMMANDS, FILES = 5000, 2000


def serve(folder: Path) -> None:
    """Serves the rig until standard input is closed."""
    rig = virtual_rig(read_config(RIG_FILE))
    with rig, zenoh.serve(rig, "tcp/127.0.0.1:0", ledger=folder / "reel.ledger") as server:
        print(server.endpoint, flush=True)
        sys.stdin.read()


def runs_a_trial(endpoint: str) -> bool:
    """Whether the rig still does what it is there for, at the gains it began with."""
    with zenoh.connect(endpoint, timeout_s=30.0) as rig:
        rig.clear()
        about = read_config(RIG_FILE).describe()
        rig.apply(about.gains)
        return rig.run(TrialRequest("last", 0, about.gains, about.step)).outcome is Outcome.DONE


@contextlib.contextmanager
def _in(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def main(arguments: list[str] | None = None) -> int:
    """Runs the experiment."""
    options = _options(arguments)
    share = 0.02 if options.quick else 1.0
    with tempfile.TemporaryDirectory() as name, _in(Path(name)):
        folder = Path(name)
        files = Files(folder, options.seed)
        files.read(round(share * FILES))
        with child_process("experiments.misuse", "rig", name) as process:
            endpoint = next_line(process)
            commands = Commands(endpoint, folder, options.seed)
            handlers = {
                number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)
            }
            commands.run(round(share * COMMANDS))
            for number, handler in handlers.items():
                signal.signal(number, handler)
            try:
                alive = runs_a_trial(endpoint) and process.poll() is None
            except EstuneError as error:
                commands.faults.append(f"the rig runs no trial: {error}")
                alive = False
    for fault in (*files.faults, *commands.faults):
        print(fault, file=sys.stderr)
    figures = dict(sorted((files.counts + commands.counts).items()))
    targets: dict[str, Target] = {
        "faults_of_files": at_most(len(files.faults), 0),
        "faults_of_commands": at_most(len(commands.faults), 0),
        "rig_runs_a_trial": at_least(float(alive), 1.0),
    }
    return print_results(figures, targets, as_json=options.json)


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = command_line(__doc__, quick="a fiftieth of both")
    parser.add_argument("--seed", type=int, default=1, help="seed of both")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["rig", folder]:
            serve(Path(folder))
        case _:
            sys.exit(main())
