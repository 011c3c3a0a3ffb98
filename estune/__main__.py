"""`python -m estune`, and the script `estune`: the command line.

Python puts the working directory first on the path of `-m`. It is moved to the end, where the
script has it, so that a `plants.py` of the user does not hide the installed package.
"""

import signal
import sys
from pathlib import Path


def main() -> None:
    """Runs the command line; Ctrl-C while it is imported ends it without a traceback.

    The handler raises `SystemExit`: a `KeyboardInterrupt` that leaves code made from a string, as
    dataclasses are, would let Python end the process by SIGINT even where it was caught.
    """
    signal.signal(signal.SIGINT, _stop)
    from estune.cli import main as command_line  # noqa: PLC0415  Ctrl-C is handled from here on

    command_line()


def _stop(*_: object) -> None:
    print("estune: stopped before anything was done", file=sys.stderr)
    sys.exit(130)  # as of a stopped command


if __name__ == "__main__":
    if sys.path and Path(sys.path[0]).resolve() == Path.cwd():
        del sys.path[0]  # `main` of the command line appends it
    main()
