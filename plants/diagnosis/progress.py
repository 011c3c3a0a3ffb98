"""Progress of a diagnosis."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the phase in words and the estimated share of the work that is done, 0 to 1."""


def silent(phase: str, done: float) -> None:
    """Reports nothing."""
    del phase, done


def portion(progress: Progress, start: float, end: float) -> Progress:
    """Progress of a part, given the shares of the whole at its start and end."""
    return lambda phase, done: progress(phase, start + (end - start) * done)
