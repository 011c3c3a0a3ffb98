"""Result of a check."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class State(StrEnum):
    """State of what was checked; `fix` needs the remedy."""

    FINE = "fine"
    FIX = "fix"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check.

    Attributes:
        check: What was checked, in a word or two.
        state: Its state.
        sentence: The observation.
        remedy: What to do about it; may be empty.
        figures: Measured values, by name with unit.
    """

    check: str
    state: State
    sentence: str
    remedy: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)


def fine(check: str, sentence: str, **figures: float) -> CheckResult:
    """A passed check."""
    return CheckResult(check, State.FINE, sentence, figures=figures)


def fix(check: str, sentence: str, remedy: str, **figures: float) -> CheckResult:
    """A failed check."""
    return CheckResult(check, State.FIX, sentence, remedy, figures)


def unknown(check: str, sentence: str, remedy: str = "", **figures: float) -> CheckResult:
    """A check without a conclusion; the remedy is the way to one."""
    return CheckResult(check, State.UNKNOWN, sentence, remedy, figures)
