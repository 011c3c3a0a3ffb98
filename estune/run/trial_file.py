"""A single trial as a file: its profile, its gains and its purpose.

```json
{
  "estune_trial": 1,
  "name": "slow-triangle-open",
  "why": "coulomb_friction and dahl_hysteresis differ most here",
  "profile": {"kind": "triangle", "preload_N": 15.0, "amplitude_N": 8.0, "period_s": 4.0, ...},
  "gains": null
}
```

Without gains the trial runs with the live ones. The file is checked as strictly as messages on the
link: unknown or missing fields, wrong types, NaN and infinities are refused.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.run.loop import Stopped
from estune.support.whole_file import replace_file
from estune.trial import Rig, TrialRecord, TrialRequest, record_frame
from estune.trial.profiles import Profile

if TYPE_CHECKING:
    from pydantic import TypeAdapter

SUFFIX = ".trial.json"
VERSION: Literal[1] = 1


@dataclass(frozen=True, slots=True)
class TrialFile:
    """Contents of a trial file.

    Attributes:
        name: Name of the trial; its id begins with it. Letters, digits, - and _ only.
        profile: The setpoint.
        gains: Gains of the trial; None means the live ones.

    Raises:
        InvalidInput: the name contains other characters.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    name: str
    profile: Profile
    gains: Gains | None = None
    why: str = ""
    estune_trial: Literal[1] = VERSION

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,100}", self.name):
            raise InvalidInput(f"trial name {self.name!r} may hold only letters, digits, - and _")

    def write(self, folder: Path) -> Path:
        """Writes the file as `<name>.trial.json`.

        Raises:
            InvalidInput: it cannot be written there.
        """
        path = folder / f"{self.name}{SUFFIX}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            replace_file(path, _adapter().dump_json(self, indent=2) + b"\n")
        except OSError as error:
            raise InvalidInput(f"{path}: {error.strerror or error}") from error
        return path


def read_trial(path: Path) -> TrialFile:
    """The trial of a file.

    Raises:
        InvalidInput: there is no such file, or it is not a trial.
    """
    try:
        return _adapter().validate_json(path.read_bytes())
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}; give a trial file") from error
    except ValueError as error:
        raise InvalidInput(f"{path}: {record_frame.one_line(error)}") from error


def run_trial(
    rig: Rig, trial: TrialFile, *, now: Callable[[], datetime] = datetime.now
) -> TrialRecord:
    """Runs one trial on a rig, under an id with the time of day.

    Raises:
        InvalidInput: the rig has no limits, or refuses the trial; nothing moved.
        RigError: the rig cannot be reached.
        Stopped: interrupted (a KeyboardInterrupt); the rig is back at its live gains.
    """
    run = f"{trial.name}-{now().astimezone():%Y%m%d-%H%M%S-%f}"
    try:
        about = rig.describe()
        about.check_limited()
        about.check_motion(trial.profile)
        gains = trial.gains or about.gains
        return rig.run(TrialRequest(run, 0, gains, trial.profile))
    except KeyboardInterrupt:
        raise Stopped(rig.abort(), None) from None


@cache
def _adapter() -> "TypeAdapter[TrialFile]":
    from pydantic import TypeAdapter  # noqa: PLC0415  slow to import, not needed by every command

    return TypeAdapter(TrialFile)
