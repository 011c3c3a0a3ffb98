"""Commands of estune in processes of their own, and what they print and serve."""

import http.client
import subprocess
from contextlib import AbstractContextManager

from estune.support.child_process import child_process

WITHIN_S = 60.0


def command(*arguments: object) -> AbstractContextManager["subprocess.Popen[str]"]:
    """A command of estune in a process, killed at the end."""
    words = map(str, arguments)
    return child_process("estune", *words, stderr=subprocess.DEVNULL)


def printed(process: "subprocess.Popen[str]", begin: str) -> str:
    """The rest of the first line that begins so."""
    assert process.stdout is not None  # noqa: S101  opened as a pipe
    for line in process.stdout:
        if line.startswith(begin):
            return line.removeprefix(begin).strip()
    raise RuntimeError(f"the process ended before it printed {begin!r}")


def stream(address: str, view: str) -> http.client.HTTPResponse:
    """The events of a page."""
    netloc = address.split("/")[2]
    connection = http.client.HTTPConnection(netloc, timeout=WITHIN_S)
    connection.request("GET", f"/api/events?view={view}")
    return connection.getresponse()
