"""The command line: its commands, and the exit code and message of every failure.

Commands are imported when they are called, so that help and version answer at once. An
`EstuneError` is one line on standard error, and its number the exit code; any other exception
keeps its traceback. Ctrl-C and SIGTERM stop the rig first.

Installed packages add commands by the entry point group `estune.commands`: each entry point names
an iterable of tuples (name, "module:function", help, place), and its module must be quick to
import. The place, a number, orders the commands and puts them under the headings of `GROUPS`.
"""

import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType

from cyclopts import App, CycloptsError, Group, UnusedCliTokensError

from estune.cli.plain_text import allow_any_encoding
from estune.errors import EstuneError, InvalidInput
from estune.support.plugins import load_plugin, plugins

INTERRUPTED = 130
"""Exit code of a stopped command, as in shells: 128 and the number of SIGINT."""

COMMANDS = (
    ("tune", "tune:tune", "Tune a rig by step trials.", 40),
    ("resume", "tune:resume", "Continue a run that was stopped or interrupted.", 50),
    ("sweep", "sweep:sweep", "Tune over cable lengths and fit the gains over length.", 60),
    ("match", "match:match", "Tune several reels to the same cost.", 70),
    ("compare", "compare:compare", "Compare tuners on one plant or rig.", 75),
    ("list", "runs:list_runs", "List the runs of a folder.", 80),
    ("watch", "watch:watch", "Show a run, a rig or a daemon live in the browser.", 85),
    ("show", "runs:show", "Show the result of a run.", 90),
    ("report", "runs:report", "Write the report of a run as one HTML page.", 95),
    ("export", "runs:export", "Write a run's trial records as CSV, Parquet or MCAP.", 100),
    (
        "export-controller",
        "hardware:export_controller",
        "Write a controller with its gains as one C file.",
        110,
    ),
    ("apply", "apply:apply", "Make the gains of a run live on a rig.", 120),
    ("suggest", "suggest:suggest", "Judge and improve gains by records of a running loop.", 128),
    ("remedy", "remedy:remedy", "Write a remedy of a diagnosis as a patch of a rig's file.", 135),
    ("prove", "remedy:prove", "Prove a remedy on a rig, by trials with it and without.", 140),
    ("serve-hardware", "hardware:serve_hardware", "Serve a reel on hardware as a rig.", 161),
    ("discover", "rigs:discover", "List the rigs at an endpoint and their status.", 162),
    ("run-experiment", "experiment:run_experiment", "Run the trial of a file on a rig.", 165),
    ("doctor", "doctor:doctor", "Check a rig, with a remedy for each failed check.", 170),
    ("bridge", "bridge:bridge", "Show a rig in ROS 2, PlotJuggler or Foxglove.", 175),
    ("estop", "rigs:estop", "Stop a rig at once and hold it in its safe state.", 180),
    ("clear", "rigs:clear", "Reset the emergency stop of a rig.", 190),
    ("daemon", "daemon:daemon", "Tune and supervise rigs for days, as a service.", 200),
    ("daemon-control", "daemon:daemon_control", "Query or command a daemon.", 210),
    ("faults", "faults:faults", "Show what has failed, with a remedy for each.", 215),
    ("docs", "docs:docs", "Open the documentation in the browser.", 220),
    ("licences", "licences:licences", "List the licences of what is installed with it.", 225),
)
"""Name, function in `estune.cli`, help, and place in the list of commands."""

GROUPS = tuple(
    Group(title, sort_key=first)
    for first, title in (
        (0, "Start"),
        (80, "Runs"),
        (125, "Records"),
        (130, "Models"),
        (160, "Rigs"),
        (200, "Service"),
        (220, "Help"),
    )
)
"""Headings of the list of commands; the sort key of a heading is the first place under it."""


def _version() -> str:
    from estune.support.version import __version__  # noqa: PLC0415  only --version needs it

    return __version__


app = App(
    name="estune",
    help="Tunes a PIDF controller by step trials on its machine. Begin with: estune demo",
    version=_version,
    help_format="plaintext",  # Markdown takes 45 ms to import; commands, whose texts have it, do
    suppress_keyboard_interrupt=False,  # `run` reports the live gains of the rig
)


def _add_commands() -> Iterator[str]:
    """Registers all commands; messages on packages whose commands cannot be added."""
    commands: list[tuple[str, str, str, int]] = [
        (name, f"estune.cli.{where}", text, place) for name, where, text, place in COMMANDS
    ]
    for point in plugins("estune.commands").values():
        try:
            commands.extend(load_plugin(point))
        except EstuneError as error:
            yield f"no commands of {point.name}: {error}"
    for name, where, text, place in commands:
        app.command(
            where,
            name=name,
            help=text,
            help_format="markdown",
            sort_key=place,
            group=_group(place),
        )


def _group(place: int) -> Group:
    """The heading under which a command of that place is listed."""
    below = [group for group in GROUPS[1:] if group.sort_key <= place]
    return below[-1] if below else GROUPS[0]


app.register_install_completion_command(
    help="Let the shell complete commands, options, tuners and runs: bash, zsh, fish.",
    group=GROUPS[-1],
)
for _flag in (*app.help_flags, *app.version_flags):
    app[_flag].group = GROUPS[-1]
_faults = tuple(_add_commands())


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line and ends the process with its exit code."""
    allow_any_encoding()
    sys.path.append(str(Path.cwd()))  # for module:attribute of the user, after all else
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Runs one command.

    Returns:
        Its exit code.
    """
    for fault in _faults:
        _print_error(fault)
    interrupts = Interrupts()
    signal.signal(signal.SIGINT, interrupts)
    signal.signal(signal.SIGTERM, interrupts)
    try:
        code = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        _print_error(f"{_usage_fault(error)} (see: estune --help)")
        return InvalidInput.exit_code
    except EstuneError as error:
        if not interrupts.count:
            _print_error(str(error))
            return error.exit_code
        _print_error(f"stopped, but the live gains are not confirmed; check the rig: {error}")
        return INTERRUPTED
    except KeyboardInterrupt as stop:
        _print_error(_stop_message(stop))
        return INTERRUPTED
    except OSError as error:
        return _system_fault(error)
    return code if isinstance(code, int) else 0


def _system_fault(error: OSError) -> int:
    """The exit code where the system refuses: a name is too long, a folder goes while it is read.

    Raises:
        OSError: it is none of a file.
    """
    if isinstance(error, BrokenPipeError):  # standard output was closed: estune list | head
        sys.stderr.close()
        return 0
    if error.filename is None:
        raise error
    _print_error(f"{error.filename}: {error.strerror}; give another path")
    return InvalidInput.exit_code


def _usage_fault(error: CycloptsError) -> str:
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens:
        words = " ".join(error.unused_tokens)
        return (
            f"{words!r} belongs to no option; name its option, such as --data PATH, and quote a "
            "path that contains spaces"
        )
    return " ".join(str(error).split())


class Interrupt(KeyboardInterrupt):
    """A stop by a signal.

    A plain `KeyboardInterrupt` that leaves code made from a string, as a dataclass is made while a
    module is imported, lets Python end the process by SIGINT instead of with its exit code, even
    where it was caught. A subclass does not.
    """


class Interrupts:
    """Handler of SIGINT and SIGTERM: the first stops, the second waits, the third aborts the wait.

    A stop ends with a query for the rig's live gains; a second Ctrl-C must not cut that off.

    Attributes:
        count: Number of signals so far.
    """

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002  a handler
        """Handles one signal."""
        self.count += 1
        if self.count == 2:
            _print_error(
                "waiting for the rig to confirm its gains; "
                "press Ctrl-C again to exit without confirmation"
            )
        else:
            raise Interrupt


def _stop_message(stop: KeyboardInterrupt) -> str:
    """The gains that the rig confirmed, where a run was stopped, and how to continue it."""
    from estune.run.loop import Stopped  # noqa: PLC0415  slow to import

    if not isinstance(stop, Stopped):
        return f"stopped; {stop}".removesuffix("; ")
    rig = stop.description
    gains = rig.gains_text(rig.gains)
    again = f"; continue with: {stop.again}" if stop.again else ""
    return f"stopped; {rig.name} confirms that its own gains are live: {gains}{again}"


def _print_error(text: str) -> None:
    print(f"estune: {text}", file=sys.stderr, flush=True)
