"""CPU time and memory of a whole command, with the start of Python."""

import os
import sys
from pathlib import Path
from typing import NamedTuple

from estune.errors import EstuneError

_ENDINGS = (0, 7, 8)
"""Exit codes of commands that did their work: 7 and 8 are runs whose initial gains are kept."""


class CommandCosts(NamedTuple):
    """Process time of a command and its children, s, and its peak memory, MB."""

    cpu_s: float
    peak_MB: float


def command_costs(*arguments: object) -> CommandCosts:
    """Runs `estune` with these arguments, its output unread.

    Raises:
        EstuneError: it failed.
    """
    command = [sys.executable, "-m", "estune", *map(str, arguments)]
    with Path(os.devnull).open("wb") as nothing:
        output = [(os.POSIX_SPAWN_DUP2, nothing.fileno(), 1)]
        pid = os.posix_spawn(sys.executable, command, os.environ, file_actions=output)
        _, status, usage = os.wait4(pid, 0)
    if (code := os.waitstatus_to_exitcode(status)) not in _ENDINGS:
        raise EstuneError(f"estune {arguments[0]} ended with {code}; its errors stand above")
    return CommandCosts(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0)
