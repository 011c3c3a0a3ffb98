"""The exceptions of the project, in one small tree.

::

    EstuneError            1  anything estune can name
    ├── InvalidInput       2  a value given by the user lies outside what it may be
    ├── PlantError         3  a model cannot be simulated
    ├── RigError           4  a rig cannot be reached, is not the one meant, or refuses
    │   ├── ProtocolError     what came over the link cannot be understood
    │   └── Interrupted       a trial was cut off on a rig that moves: somebody must see to it
    ├── JournalError       5  a run cannot be read or written
    └── UnsafeStart        6  no safe gains to begin from or to fall back on

Each message is one line: what is wrong, where, and what to do about it. The number is the exit
code of the command line. A trial that fails is not an exception but data: `estune.trial.CellOutcome`.
A tuning that ends with no significant improvement is none either: it is a result, and its exit
code is 7.
"""

from typing import ClassVar


class EstuneError(Exception):
    """Anything estune can name. `exit_code` is what the command line returns for it."""

    exit_code: ClassVar[int] = 1


class InvalidInput(EstuneError, ValueError):
    """A value given by the user lies outside what it may be."""

    exit_code = 2


class PlantError(EstuneError):
    """A model cannot be simulated: it is unstable, diverges or answers in the wrong shape."""

    exit_code = 3


class RigError(EstuneError):
    """A rig cannot be reached, is not the one meant, or refuses."""

    exit_code = 4


class ProtocolError(RigError):
    """What came over the link cannot be understood: another version, a corrupt frame."""


class Interrupted(RigError):
    """A trial was cut off on a rig that moves: somebody must see to it before it is run again."""


class JournalError(EstuneError):
    """A run cannot be read or written: locked, read-only, torn, or from a newer version."""

    exit_code = 5


class UnsafeStart(EstuneError):
    """There are no safe gains to begin from or to fall back on."""

    exit_code = 6
