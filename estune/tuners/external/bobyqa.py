"""Py-BOBYQA (Cartis et al. 2019): a trust region with a quadratic model, for noisy costs."""

import contextlib
import math
import threading
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Literal

import numpy as np

from estune.errors import InvalidInput
from estune.tuners.external.optimiser_cache import Optimiser, check_installed
from estune.tuners.external.tuner import ExternalTuner
from estune.tuners.search_space import Coordinates
from estune.tuners.settings import check_above_zero, check_logarithmic

MOST_TRIALS = 100_000  # Py-BOBYQA grows slow with this number, and not only with the trials made
WORSE_BY = math.log(2.0)
"""A censored trial counts as twice as costly as the worst safe one: its model needs a number."""


@dataclass(frozen=True, slots=True)
class Bobyqa(ExternalTuner):
    """Steps within a trust region about the best point of a quadratic model of the log cost.

    Attributes:
        space: What is tuned, on a logarithmic scale.
        radius: Of the trust region at first, in logarithms.
        least_radius: Where it is restarted from the first one, in logarithms.
        name: What the tuner is called.

    Raises:
        InvalidInput: a setting is out of its range, the bounds are too narrow for it, the scale
            is not logarithmic, or Py-BOBYQA is not installed.
    """

    radius: float = 0.5
    least_radius: float = 0.1
    name: Literal["bobyqa"] = "bobyqa"

    def __post_init__(self) -> None:
        check_installed("bobyqa", "pybobyqa")
        check_logarithmic("bobyqa", self.space)
        for what in ("radius", "least_radius"):
            check_above_zero("bobyqa", what, getattr(self, what))
        if not self.least_radius < self.radius:
            raise InvalidInput(
                f"bobyqa: least_radius {self.least_radius:g} is not below radius {self.radius:g}; "
                "make it smaller"
            )
        rows = zip(
            self.space.names, self.space.coordinates_low, self.space.coordinates_high, strict=True
        )
        for name, low, high in rows:
            if high - low < 2.0 * self.radius:
                raise InvalidInput(
                    f"bobyqa: the bounds of {name} are {high - low:.3g} apart in logarithms, less "
                    f"than twice the radius {self.radius:g}; widen them or make radius smaller"
                )

    def optimiser(self) -> Optimiser:
        """A solver that has been told of nothing."""
        return _Solver(self)


class _Closed(Exception):
    """Ends the solver's thread."""


class _Solver:
    """The solver in a thread of its own, for it calls the cost and not the other way round.

    Either the thread or its caller is at work, never both.
    """

    def __init__(self, tuner: Bobyqa) -> None:
        self._tuner = tuner
        self._points: SimpleQueue[Coordinates | Exception] = SimpleQueue()
        self._levels: SimpleQueue[float | None] = SimpleQueue()
        self._asked: Coordinates | None = None
        self._worst = -math.inf
        threading.Thread(target=self._solve, name="bobyqa", daemon=True).start()

    def ask(self) -> Coordinates:
        if self._asked is None:
            given = self._points.get()
            if isinstance(given, Exception):
                raise given
            self._asked = given
        return self._asked

    def tell(self, coordinates: Coordinates, level: float) -> None:  # noqa: ARG002  it knows where
        self.ask()
        if math.isfinite(level):
            self._worst = max(self._worst, level)
        else:
            level = WORSE_BY + (self._worst if math.isfinite(self._worst) else 0.0)
        self._asked = None
        self._levels.put(level)

    def close(self) -> None:
        """Ends the thread."""
        self._levels.put(None)

    def _cost(self, coordinates: Any) -> float:
        self._points.put(tuple(coordinates.tolist()))
        level = self._levels.get()
        if level is None:
            raise _Closed
        return level

    def _solve(self) -> None:
        import pybobyqa  # noqa: PLC0415  an extra

        space = self._tuner.space
        bounds = np.array(space.coordinates_low), np.array(space.coordinates_high)
        with contextlib.suppress(_Closed):
            try:
                solution = pybobyqa.solve(
                    self._cost,
                    np.array(space.coordinates(space.start)),
                    bounds=bounds,
                    rhobeg=self._tuner.radius,
                    rhoend=self._tuner.least_radius,
                    maxfun=MOST_TRIALS,
                    objfun_has_noise=True,
                    do_logging=False,
                )
                best = solution.x
                while True:  # it has given up: what it found is repeated
                    self._cost(best)
            except _Closed:
                raise
            except Exception as error:  # noqa: BLE001  for the caller to see
                self._points.put(error)
