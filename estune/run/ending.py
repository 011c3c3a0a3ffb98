"""End of a run."""

from enum import StrEnum


class RunEnding(StrEnum):
    """End of a run."""

    TUNED = "tuned"
    NO_IMPROVEMENT = "no significant improvement"
    STOPPED = "stopped"
    UNSAFE_START = "unsafe start"
    NOT_ROBUST = "not robust"

    @property
    def status(self) -> int:
        """Status of the `OptimizeResult`; zero is success."""
        return list(RunEnding).index(self)

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: no improvement is a result, not an error."""
        return {RunEnding.NO_IMPROVEMENT: 7, RunEnding.NOT_ROBUST: 8}.get(self, 0)
