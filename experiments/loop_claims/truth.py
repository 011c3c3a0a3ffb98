"""True properties of a loop, by its own plant: cost, overshoot, Ms, constrained optimum."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cma
import numpy as np

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.margins import SampledPlant, controller_response, is_stable
from estune.core.quantities import ComplexArray, FloatArray
from estune.interop import sampled_model
from plants.models.linear_plant import LinearPlant
from plants.simulation.plant import Plant

NOISE_DRAWS = 4
"""Draws of the measurement noise in the mean cost."""

SEED = 777_000  # of those draws; no search has this seed
ANGLES = np.concatenate([np.geomspace(1e-4, 0.1, 300), np.linspace(0.1, math.pi, 1500)])
EVALUATIONS = 400
"""Evaluations of the cost from each start."""

RANGE = 6.0
PENALTY = 20.0
"""Logarithms of cost per unit beyond a limit, while the constrained optimum is sought."""


class Truth(NamedTuple):
    """True properties of a loop with some gains.

    Attributes:
        cost: Mean cost over the measurement noise; infinite where the loop diverges.
        overshoot: Without noise, as a share of the step.
        sensitivity: Ms of the plant's linear part; NaN without one.
    """

    cost: float
    overshoot: float
    sensitivity: float


class LinearPart(NamedTuple):
    """Response of a plant's own linear model on `ANGLES`.

    Attributes:
        plant: The sampled model.
        response: G, shape (angles,).
    """

    plant: SampledPlant
    response: ComplexArray


def linear_part(plant: Plant) -> LinearPart | None:
    """The plant's own linear model, sampled; None without one."""
    model = plant.describe("plant", Gains(1.0, 1.0, 0.0, 0.0)).linear_model
    if model is None:
        return None
    sampled = sampled_model(model, plant.controller)
    return LinearPart(sampled, sampled.response(ANGLES))


def true_sensitivity(plant: Plant, gains: Gains) -> float:
    """Ms of the loop with the plant's own linear model; NaN without one, infinite if unstable."""
    return _sensitivity(linear_part(plant), plant, gains)


def _sensitivity(part: LinearPart | None, plant: Plant, gains: Gains) -> float:
    if part is None:
        return math.nan
    if not is_stable(part.plant, gains, plant.controller):
        return math.inf
    loop = controller_response(gains, plant.controller, ANGLES) * part.response
    return float(np.max(1.0 / np.abs(1.0 + loop)))


def with_noise(plant: Plant, share: float) -> Plant:
    """The plant; a linear one without noise gets some, a share of its step."""
    if plant.noise_rms_N or not isinstance(plant, LinearPlant):
        return plant
    noise = share * abs(plant.profile.step_N)
    return replace(plant, mounting=replace(plant.mounting, noise_rms_N=noise))


@dataclass(frozen=True)
class TrueLoop:
    """A plant and a cost, whose truth is computed.

    Attributes:
        plant: The plant.
        cost: The cost of a trial.
    """

    plant: Plant
    cost: StepCost

    @cached_property
    def _linear_part(self) -> LinearPart | None:
        return linear_part(self.plant)

    def at(self, gains: Gains) -> Truth:
        """Cost, overshoot and sensitivity of gains."""
        plant, step = self.plant, self.plant.profile
        rows = np.tile(gains.as_tuple(), (NOISE_DRAWS, 1))
        costs = plants.batch_costs(plant, rows, None, self.cost, seed=SEED, workers=1)
        quiet = plants.simulate(plant, gains)
        sensitivity = _sensitivity(self._linear_part, plant, gains)
        if not np.isfinite(costs).all() or quiet.diverged_at is not None:
            return Truth(math.inf, math.inf, sensitivity)
        after = quiet.tension_N[step.step_index(plant.controller.sampling_Hz) :]
        peak = float(np.max((after - step.preload_N) / step.step_N)) - 1.0
        return Truth(float(np.mean(costs)), max(peak, 0.0), sensitivity)


def constrained_optimum(
    loop: TrueLoop,
    starts: list[FloatArray],
    max_sensitivity: float,
    overshoot: float,
    evaluations: int = EVALUATIONS,
) -> tuple[Gains, Truth]:
    """The gains of least true cost within limits, by CMA-ES from several starts.

    Args:
        loop: The plant and the cost.
        starts: Logarithms of gains, shape (4,) each.
        max_sensitivity: Limit of Ms.
        overshoot: Limit of the overshoot.
        evaluations: Of the cost, from each start.
    """

    def rank(x: FloatArray) -> float:
        at = loop.at(Gains(*np.exp(x).tolist()))
        if not math.isfinite(at.cost):
            return 20.0
        Ms = 0.0 if math.isnan(at.sensitivity) else math.log(at.sensitivity / max_sensitivity)
        beyond = max(min(Ms, 5.0), 0.0) + max(at.overshoot - overshoot, 0.0)
        return math.log(at.cost) + PENALTY * beyond

    found = []
    for number, start in enumerate(starts):
        options = {
            "bounds": [list(start - RANGE), list(start + RANGE)],
            "verbose": -9,
            "maxfevals": evaluations,
            "seed": number + 1,
        }
        strategy = cma.CMAEvolutionStrategy(start, 0.5, options)
        while not strategy.stop():
            asked = strategy.ask()
            strategy.tell(asked, [rank(np.array(x)) for x in asked])
        found.append((float(strategy.result.fbest), np.array(strategy.result.xbest)))
    gains = Gains(*np.exp(min(found, key=lambda pair: pair[0])[1]).tolist())
    return gains, loop.at(gains)
