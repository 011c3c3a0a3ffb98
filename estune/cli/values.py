"""Options that commands share, and values written as text: `P=0.1:10`, `cable_length_m=1.1`."""

import ast
import os
import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.completion import CompletionContext

from estune.core.setting import share
from estune.errors import InvalidInput

if TYPE_CHECKING:
    from estune.remote.security import Security

Flag = Annotated[bool, Parameter(negative=(), show_default=False)]
"""An option without a value."""

Json = Annotated[Flag, Parameter(help="Print JSON.")]
Quiet = Annotated[Flag, Parameter(help="Show no progress.")]
RigName = Annotated[
    str | None, Parameter(help="Name of the rig, if several answer at the endpoint.")
]
RunsFolder = Annotated[Path, Parameter(help="Folder of runs.")]
SecurityFile = Annotated[
    Path | None, Parameter(help="Credentials file, if the rig requires authentication.")
]
"""Options that many commands have."""

OptionalText = Annotated[str, Parameter(show_default=False)]
"""A text that is empty unless given."""

Values = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)]
"""An option that may be repeated."""

Effects = Annotated[
    tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)
]
"""Effects of the user's own, each as module:Class."""


def _run_names(context: CompletionContext) -> Iterable[str]:
    """Names of the runs in the folder that is given, or else in the default one."""
    from estune.run.journal import FILE_NAME, RUNS  # noqa: PLC0415  slow to import

    folder = Path(context["folder"].raw or RUNS)
    return sorted(path.parent.name for path in folder.glob(f"*/{FILE_NAME}"))


RunName = Annotated[str, Parameter(completer=_run_names)]
"""A run: its name, or its folder."""


def settings_from(texts: Iterable[str]) -> dict[str, Any]:
    """Settings written `name=value`; a value is a number, True, False or None, or else text.

    Raises:
        InvalidInput: one of them has no name or no value.
    """
    settings = {}
    for name, value in map(_split, texts):
        try:
            settings[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            settings[name] = value
    return settings


def security_from(path: Path | None) -> "Security":
    """The settings in a security file; without a file, no authentication.

    Raises:
        InvalidInput: something in the file is wrong.
    """
    from estune.remote.security import OPEN, read_security  # noqa: PLC0415  slow to import

    return OPEN if path is None else read_security(path)


def command_line(command: str, *words: object, **options: object) -> str:
    """A command to be pasted into a shell, with those of the options that are given."""
    given = {f"--{name}": value for name, value in options.items() if value is not None}
    rest = [word for option in given.items() for word in option]
    return shlex.join(map(str, ["estune", command, *words, *rest]))


def check_folder_exists(option: str, path: Path | None) -> None:
    """Refuses an output file whose folder does not exist, or that is a folder.

    Raises:
        InvalidInput: there is no such folder, or no file can be written there.
    """
    if path is None:
        return
    if not path.parent.is_dir():
        raise InvalidInput(f"there is no folder {path.parent}; make it, or give another {option}")
    if path.is_dir():
        raise InvalidInput(f"{path} is a folder; give the name of a file in it to {option}")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InvalidInput(f"{path} cannot be written; give another {option}")


_NEXT = re.compile(r",(?=\s*\w+\s*=)")
"""The comma between two assignments: one within a name stays, as in `Temp, °C`."""


def words_from(option: str, texts: Iterable[str]) -> dict[str, str]:
    """Words written `name=word`, several of them with commas between.

    Raises:
        InvalidInput: one of them is not of that form.
    """
    pairs = [part.partition("=") for text in texts for part in _NEXT.split(text) if part]
    for name, equals, word in pairs:
        if not (name and equals and word):
            raise InvalidInput(f"{option} {name}{equals}{word} is not of the form NAME=VALUE")
    return {name.strip(): word.strip() for name, _, word in pairs}


def numbers_from(texts: Iterable[str]) -> dict[str, float]:
    """Numbers written `name=number`.

    Raises:
        InvalidInput: one of them is not of that form.
    """
    return {name: _number(name, value) for name, value in map(_split, texts)}


def share_from(name: str, text: str, bare_most: float | None = None) -> float:
    """A share written as a number or in per cent: 0.01 or 1%.

    Raises:
        InvalidInput: it is neither, or a number above `bare_most` without a per cent sign.
    """
    _number(name, text.strip().removesuffix("%"))
    try:
        return share(text, bare_most)
    except ValueError as error:
        raise InvalidInput(f"{name}: {error}") from None


def ranges_from(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Ranges written `name=low:high`.

    Raises:
        InvalidInput: one of them is not of that form.
    """
    ranges = {}
    for name, value in map(_split, texts):
        low, colon, high = value.partition(":")
        if not colon:
            raise InvalidInput(f"{name}={value} is no range; write {name}=LOW:HIGH")
        ranges[name] = (_number(name, low), _number(name, high))
    return ranges


def _split(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise InvalidInput(f"{text!r} is not of the form NAME=VALUE")
    return name.strip(), value.strip()


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInput(f"{name}: {text!r} is not a number") from None
