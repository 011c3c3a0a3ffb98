"""End of a run."""

from enum import StrEnum


class RunEnding(StrEnum):
    """Why a run ended, as its first line and its exit code say it."""

    TUNED = "tuned"
    NO_IMPROVEMENT = "no significant improvement"
    STOPPED = "stopped"
    UNSAFE_START = "unsafe start"
    NOT_ROBUST = "not robust"
    LIMITS_NOT_SHOWN = "tuned, limits not shown"
    LIMIT_BROKEN = "tuned, but a limit is broken"

    @property
    def status(self) -> int:
        """Status of the `OptimizeResult`; zero is success."""
        return list(RunEnding).index(self)

    @property
    def is_tuned(self) -> bool:
        """Whether the tuned gains are significantly better than the initial ones."""
        return self in (RunEnding.TUNED, RunEnding.LIMITS_NOT_SHOWN, RunEnding.LIMIT_BROKEN)

    @property
    def is_offered(self) -> bool:
        """Whether its gains are offered to be made live: they are better, and break no limit."""
        return self.is_tuned and self is not RunEnding.LIMIT_BROKEN

    @property
    def good(self) -> bool | None:
        """Whether the ending is shown as good; None is neither good nor bad."""
        bad = (RunEnding.UNSAFE_START, RunEnding.NOT_ROBUST, RunEnding.LIMIT_BROKEN)
        return True if self is RunEnding.TUNED else False if self in bad else None

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: zero only where the result may be used as it is."""
        return {
            RunEnding.NO_IMPROVEMENT: 7,
            RunEnding.NOT_ROBUST: 8,
            RunEnding.LIMITS_NOT_SHOWN: 11,
            RunEnding.LIMIT_BROKEN: 12,
        }.get(self, 0)
