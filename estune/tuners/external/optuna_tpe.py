"""Optuna's tree-structured Parzen estimator (Bergstra et al. 2011), multivariate."""

from dataclasses import dataclass
from typing import Any, Literal

from estune.errors import InvalidInput
from estune.tuners.external.optimiser_cache import Optimiser, check_installed
from estune.tuners.external.tuner import ExternalTuner
from estune.tuners.search_space import Coordinates


@dataclass(frozen=True, slots=True)
class OptunaTpe(ExternalTuner):
    """Searches the whole box between the bounds, so the bounds should be safe.

    It begins with the start and some random points, then samples where good trials were denser
    than others. The order of the costs alone matters to it.

    Attributes:
        space: What is tuned; sampled uniformly in its coordinates.
        startup_trials: Trials before the estimator is used.
        seed: Of its random numbers; those of a trial depend on it and the trial's number alone.
        name: What the tuner is called.

    Raises:
        InvalidInput: a setting is out of its range, or Optuna is not installed.
    """

    startup_trials: int = 10
    seed: int = 0
    name: Literal["optuna"] = "optuna"

    def __post_init__(self) -> None:
        check_installed("optuna", "optuna")
        if self.startup_trials < 1:
            raise InvalidInput(
                f"optuna: startup_trials is {self.startup_trials}; it must be at least 1"
            )
        if not 0 <= self.seed < 2**31:
            raise InvalidInput(f"optuna: seed is {self.seed}; it must lie from 0 to 2^31 - 1")

    def optimiser(self) -> Optimiser:
        """A study that has been told of nothing."""
        return _Study(self)


class _Study:
    """A study in memory; a sampler is made for each trial, so that its numbers are its own."""

    def __init__(self, tuner: OptunaTpe) -> None:
        import optuna  # noqa: PLC0415  an extra, and slow to import

        # Its level of logging belongs to whoever uses it besides.
        level = optuna.logging.get_verbosity()
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._study = optuna.create_study()
        optuna.logging.set_verbosity(level)
        self._tuner = tuner
        sides = zip(
            tuner.space.names,
            tuner.space.coordinates_low,
            tuner.space.coordinates_high,
            strict=True,
        )
        self._distributions: dict[str, optuna.distributions.BaseDistribution] = {
            name: optuna.distributions.FloatDistribution(low, high) for name, low, high in sides
        }
        self._asked: Any = None
        self._told = 0

    def ask(self) -> Coordinates:
        if self._asked is None:
            import optuna  # noqa: PLC0415  an extra, and slow to import

            self._study.sampler = optuna.samplers.TPESampler(
                seed=(self._tuner.seed + 7919 * self._told) % 2**32,
                multivariate=True,
                n_startup_trials=self._tuner.startup_trials,
            )
            self._asked = self._study.ask(self._distributions)
        return tuple(self._asked.params[name] for name in self._tuner.space.names)

    def tell(self, coordinates: Coordinates, level: float) -> None:
        if self._asked is None:
            import optuna  # noqa: PLC0415  an extra, and slow to import

            self._study.add_trial(
                optuna.trial.create_trial(
                    params=dict(zip(self._tuner.space.names, coordinates, strict=True)),
                    distributions=self._distributions,
                    value=level,
                )
            )
        else:
            self._study.tell(self._asked, level)
        self._asked, self._told = None, self._told + 1

    def close(self) -> None:
        """Nothing is held."""
