"""The identified loop that a search moves on: what it predicts, and where its optimum lies."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.loop_model.half_widths import HalfWidths
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import LoopModel
from estune.loop_model.optimum import Optimum, RegionSearch, RobustnessLimits
from estune.loop_model.prediction import Prediction, StepTrial, predict
from estune.tuners.predictions import ComparedTrial, cost_noise, difference, log_of_cost
from estune.tuners.residual_surface import ResidualSurface
from estune.tuners.search_space import Coordinates, SearchSpace

FLAT = 0.01
"""Difference of predictions a logarithm back from the end of the reach, up to which that holds
nothing back: a setpoint filter of an eighth of a sample acts as none, 0.5 % of cost and limits."""


class SearchedLoop(NamedTuple):
    """An identified loop, and the region that a search of its optimum may reach.

    Attributes:
        space: The tuned parameters.
        trial: The step trial, with the effort at rest of the last one.
        limits: What the gains have to keep.
        surface: What trials measured beyond the model; None where it stands.
        base: Coordinates of the trial about which the search reaches.
        reach: Greatest distance from it in each logarithm.
    """

    fit: LoopFit
    space: SearchSpace
    trial: StepTrial
    limits: RobustnessLimits
    surface: ResidualSurface | None
    base: Coordinates
    reach: float

    def predicted(self, x: Coordinates) -> Prediction:
        """What is expected of a trial at some coordinates."""
        gains = self.space.gains(self.space.point(x))
        found = predict(self.fit.model, self.trial, gains, self.fit.noise_std)
        return self.surface.corrected(np.array(x), found) if self.surface else found

    def with_surface(
        self, trials: Sequence[ComparedTrial], known: Sequence[ComparedTrial]
    ) -> "SearchedLoop":
        """The loop with what trials measured beyond it, by the noise of all that are known."""
        alone = self._replace(surface=None)
        predicted = [alone.predicted(trial.x) for trial in trials]
        differences = [
            (trial.log_cost - log_of_cost(p), trial.overshoot - p.overshoot)
            for trial, p in zip(trials, predicted, strict=True)
        ]
        points, misfit = [trial.x for trial in trials], self.fit.model_misfit
        surface = ResidualSurface.fitted(points, differences, misfit, cost_noise(known))
        return self._replace(surface=surface)

    def search(self, model: LoopModel, beside: HalfWidths | None = None) -> RegionSearch:
        """The search for the optimum of a model within reach of the best trial.

        As far inside the limits as the half widths tell; as the assumed ones without them.
        """
        best, noise_std = np.array(self.base), self.fit.noise_std
        low, high = self.space.coordinate_bounds
        assumed = HalfWidths.assumed(noise_std / abs(self.trial.step.size))
        return RegionSearch(
            model=model,
            trial=self.trial,
            limits=self.limits.aimed(beside or assumed),
            gains_of=lambda x: self.space.gains(self.space.point(tuple(x.tolist()))),
            low=np.maximum(low, best - self.reach),
            high=np.minimum(high, best + self.reach),
            noise_std=noise_std,
            corrected=self.surface.corrected if self.surface else None,
        )

    def holds_back(self, optimum: Optimum) -> bool:
        """Whether the reach, not a bound of the space, holds the optimum back."""
        x = optimum.coordinates
        away = x - np.array(self.base)
        low, high = np.array(self.space.coordinate_bounds)
        inside = (x > low + 1e-6) & (x < high - 1e-6)
        held = np.flatnonzero(inside & (np.abs(away) > 0.99 * self.reach))
        back = [x - np.sign(away[i]) * np.eye(x.size)[i] for i in held]
        beside = (self.predicted(tuple(there.tolist())) for there in back)
        return any(difference(there, optimum.prediction) > FLAT for there in beside)
