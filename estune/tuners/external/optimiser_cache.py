"""Optimisers with a memory of their own, kept for the next call or made anew from a history.

What an optimiser proposes depends on the trials it was told of alone. So an answer is the same
whether the optimiser at hand has been told of all but the last trial, as in a run that goes on, or
a new one is told of every trial, as after a restart.
"""

import importlib.util
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Protocol

from estune.errors import InvalidInput
from estune.tuners.external.history import History
from estune.tuners.search_space import Coordinates

KEPT = 8
"""So many optimisers are kept; a thread may be waiting in each."""


class Optimiser(Protocol):
    """What is kept: an optimiser that is asked and told in turns."""

    def ask(self) -> Coordinates:
        """The next proposal; the same one until something is told."""
        ...

    def tell(self, coordinates: Coordinates, level: float) -> None:
        """Takes in a trial: where it was, and the logarithm of its cost, infinite if censored."""
        ...

    def close(self) -> None:
        """Ends whatever it holds."""
        ...


_kept: OrderedDict[Hashable, tuple[History, Optimiser]] = OrderedDict()


def proposal(settings: Hashable, history: History, begin: Callable[[], Optimiser]) -> Coordinates:
    """What an optimiser with these settings proposes after this history.

    Args:
        settings: What makes two optimisers alike.
        history: What it has been told.
        begin: Makes one that has been told of nothing.
    """
    # Taken out while it is at work: another thread that asks the same makes its own.
    known, optimiser = _kept.pop(settings, (None, None))
    done = 0 if known is None else len(known.levels)
    if optimiser is None or known is None or not _continues(history, known):
        if optimiser is not None:
            optimiser.close()
        optimiser, done = begin(), 0
    for coordinates, level in history.trials(done):
        optimiser.tell(coordinates, level)
    proposed = optimiser.ask()
    _kept[settings] = history, optimiser
    while len(_kept) > KEPT:
        _kept.popitem(last=False)[1][1].close()
    return proposed


def check_installed(tuner: str, package: str) -> None:
    """Refuses a tuner whose library is not there.

    Raises:
        InvalidInput: it is not.
    """
    if importlib.util.find_spec(package) is None:
        raise InvalidInput(
            f"tuner {tuner} needs the package {package}, which is not installed; get it with: "
            "pip install estune[peers]"
        )


def _continues(history: History, known: History) -> bool:
    return (
        history.levels[: len(known.levels)] == known.levels
        and history.coordinates[: len(known.coordinates)] == known.coordinates
    )
