"""The exceptions of the project, in one small tree.

::

    EstuneError            1  any error with a message for the user
    ├── InvalidInput       2  a value given by the user is not usable
    ├── PlantError         3  a model cannot be simulated
    ├── RigError           4  a rig cannot be reached, is another one, or refuses
    │   ├── ProtocolError     a message on the link is invalid
    │   ├── StaleSetpoint     a setpoint was dropped, because it is an old one
    │   └── Interrupted       a trial was interrupted on a rig that moves: operator required
    ├── JournalError       5  a run cannot be read or written
    └── UnsafeStart        6  there are no safe initial gains

Each message is one line: what is wrong, where, and what to do about it. The number is the exit
code of the command line. A failed trial is not an exception but data: `estune.trial.Outcome`. A
tuning without a significant improvement is a result as well, with exit code 7, and one whose
better gains are not robust, with 8; a diagnosis with a reservation ends with 9, one of data with
faults to be corrected first with 10; a tuning whose limits the records do not show ends with 11,
one that breaks a limit with 12.
"""

from typing import ClassVar


class EstuneError(Exception):
    """An error with a message for the user. `exit_code` is that of the command line."""

    exit_code: ClassVar[int] = 1


class InvalidInput(EstuneError, ValueError):
    """A value given by the user is not usable."""

    exit_code = 2


class PlantError(EstuneError):
    """A model cannot be simulated: it is unstable, diverges or returns the wrong shape."""

    exit_code = 3


class RigError(EstuneError):
    """A rig cannot be reached, is another one, or refuses."""

    exit_code = 4


class ProtocolError(RigError):
    """A message on the link is invalid: of another version, or corrupt."""


class StaleSetpoint(RigError):
    """A setpoint was dropped: a newer one arrived before, or it was too long under way."""


class Interrupted(RigError):
    """A trial was interrupted on a rig that moves: an operator must check it before the next.

    Attributes:
        what: What happened, without the order to the operator, which the message ends with.
    """

    def __init__(self, what: str, then: str = "") -> None:
        """Args: what happened, and what the operator is to do behind the check."""
        super().__init__(what, then)
        self.what, self._then = what, then

    def __str__(self) -> str:
        return f"{self.what}; check the rig" + (f", then {self._then}" if self._then else "")


class JournalError(EstuneError):
    """A run cannot be read or written: locked, read-only, torn, or from a newer version."""

    exit_code = 5


class UnsafeStart(EstuneError):
    """There are no safe initial gains."""

    exit_code = 6
