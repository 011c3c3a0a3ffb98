"""The phases of a run."""

from enum import StrEnum


class Phase(StrEnum):
    """Phase of a run."""

    BASELINE = "baseline"
    SEARCH = "search"
    EXCITE = "excite"
    CHOOSE = "choose"
    CONFIRM = "confirm"
