"""What a check came to."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class State(StrEnum):
    """Whether something is to be done."""

    FINE = "fine"
    FIX = "fix"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What one check came to.

    Attributes:
        check: What was looked at, in a word or two.
        state: Whether something is to be done.
        sentence: What was found.
        remedy: What to do about it; empty where nothing is.
        figures: What was measured, by name with its unit.
    """

    check: str
    state: State
    sentence: str
    remedy: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)


def fine(check: str, sentence: str, **figures: float) -> CheckResult:
    """Nothing is to be done."""
    return CheckResult(check, State.FINE, sentence, figures=figures)


def fix(check: str, sentence: str, remedy: str, **figures: float) -> CheckResult:
    """Something must be mended."""
    return CheckResult(check, State.FIX, sentence, remedy, figures)


def unknown(check: str, sentence: str, remedy: str = "", **figures: float) -> CheckResult:
    """It cannot be told; the remedy says how it could."""
    return CheckResult(check, State.UNKNOWN, sentence, remedy, figures)
