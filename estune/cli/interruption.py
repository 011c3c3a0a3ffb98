"""The command by which a stopped one is continued."""

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from estune.run.loop import Stopped


@contextmanager
def continued_by_same_command(folder: Path, given: Path | None) -> Iterator[None]:
    """Says, where the block is stopped, that the same command continues all of its runs.

    Args:
        folder: The folder in which the command stores its runs.
        given: The folder that its options name, or None.
    """
    try:
        yield
    except Stopped as stop:
        words = ["estune", *sys.argv[1:], *([] if given else ["--folder", str(folder)])]
        stop.again = shlex.join(words)
        raise


@contextmanager
def stopped_outside_trials() -> Iterator[None]:
    """Says, where a tuning is stopped before its trials or after them, that no gains changed."""
    try:
        yield
    except Stopped:
        raise
    except KeyboardInterrupt:
        sentence = "no trial was running, so the rig's live gains are as they were"
        raise KeyboardInterrupt(sentence) from None


@contextmanager
def continued_with_credentials(security: Path | None) -> Iterator[None]:
    """Adds the credentials file to the command that continues a run that is stopped."""
    try:
        yield
    except Stopped as stop:
        if stop.again and security is not None:
            stop.again += f" --security {shlex.quote(str(security))}"
        raise
