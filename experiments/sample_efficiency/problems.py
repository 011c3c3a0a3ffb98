"""The tuning problems: families of plants, each with a cost and weak initial gains."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import control
import numpy as np

import plants
from estune.core.cost import StepCost, default_cost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.prediction import StepTrial
from estune.loop_model.records import LoopRecord
from estune.trial.profiles import StepProfile
from estune.tuners.search_space import Coordinates, SearchSpace
from plants.models.linear_plant import LinearPlant
from plants.simulation.plant import Plant

SAMPLING_HZ = 632.0
ONE_SAMPLE_S = 1.0 / SAMPLING_HZ
DERIVATIVE_FILTER_S = 1.0 / (2.0 * math.pi * 80.0)
EFFORT_LIMIT = 4.0  # of the linear plants, in units of their step
BOUNDS_FACTOR = 50.0
"""Bounds of every search, over and under its start; the optima are up to 22 times away."""


def step_trial(plant: Plant, cost: StepCost) -> StepTrial:
    """The step trial of a plant."""
    step, controller = plant.profile, plant.controller
    rate = controller.sampling_Hz
    samples = step.samples(rate)
    return StepTrial(controller, cost, step.preload_N, step.shape(rate), samples)


@dataclass(frozen=True)
class Problem:
    """A tuning problem.

    Attributes:
        name: Short name.
        build: Creates the plant.
        cost: Cost of a trial.
        start: Weak gains, five to seven times as costly as the optimum.
    """

    name: str
    build: Callable[[], Plant]
    cost: StepCost
    start: Gains

    @cached_property
    def plant(self) -> Plant:
        """The plant with its controller."""
        return self.build()

    @property
    def space(self) -> SearchSpace:
        """The search space of every algorithm, about the start."""
        return SearchSpace.around(self.start, BOUNDS_FACTOR)

    @property
    def trial(self) -> StepTrial:
        """The step trial."""
        return step_trial(self.plant, self.cost)

    def costs(self, coordinates: FloatArray) -> FloatArray:
        """Costs without noise at logarithms of the gains, shape (points, 4); inf if diverged."""
        gains = np.exp(coordinates)
        costs = plants.batch_costs(self.plant, gains, None, self.cost, workers=1)
        return np.where(np.isfinite(costs), costs, np.inf)

    def record(self, coordinates: Coordinates) -> LoopRecord:
        """The signals of one trial, without noise.

        The noise of the costs is not of their signals: in a record with noise the expected cost,
        and so the optimum, would be another than the noise-free one that counts.
        """
        profile, rate = self.plant.profile, self.plant.controller.sampling_Hz
        gains = Gains(*np.exp(coordinates).tolist())
        r = plants.simulate(self.plant, gains)
        index = profile.step_index(rate)
        return LoopRecord.of_step(r.effort_N, r.tension_N, profile.step_N, index, gains)


def second_order(frequency_Hz: float, damping: float, dead_samples: float) -> LinearPlant:
    """A unit-gain second-order plant with limits on the effort, over eight of its periods."""
    w = 2.0 * math.pi * frequency_Hz
    return plants.linear_plant(
        control.tf([w * w], [1.0, 2.0 * damping * w, w * w]),
        dead_time_s=dead_samples * ONE_SAMPLE_S,
        sampling_Hz=SAMPLING_HZ,
        output_min_N=-EFFORT_LIMIT,
        output_max_N=EFFORT_LIMIT,
        derivative_filter_s=DERIVATIVE_FILTER_S,
        profile=StepProfile(0.0, 1.0, 2.0 * ONE_SAMPLE_S, 8.0 / frequency_Hz),
    )


def first_plant_of_2006() -> LinearPlant:
    """G1 of Killingsworth & Krstic: exp(-5 s)/(1 + 20 s), at 20 Hz."""
    return plants.linear_plant(
        control.tf([1.0], [20.0, 1.0]),
        dead_time_s=5.0,
        sampling_Hz=20.0,
        derivative_filter_s=0.1,
        profile=StepProfile(0.0, 1.0, 0.1, 100.0),
    )


WEAK_ON_A_REEL = Gains(0.4, 4.0, 0.003, 0.03)
"""At most four times as costly as the optimum, because a trial of a second bounds the cost of a
slow response; but four logarithms and more away from it, as the other starts."""


def _on_reel(name: str, length_m: float, build: Callable[[], Plant] | None = None) -> Problem:
    """A problem on the reference reel, with the default cost of a tuning."""
    build = build or partial(plants.reference_reel, length_m)
    w = plants.reference_reel(length_m).natural_frequency_rad_s
    cost = default_cost(2.0 * math.pi / w)
    return Problem(name, build, cost, WEAK_ON_A_REEL)


def _on_second_order(
    name: str, plant: tuple[float, float, float], move_weight: float, start: Gains
) -> Problem:
    """A problem on a `second_order` plant, with times in units of the settling time, a period."""
    cost = StepCost(1.0 / plant[0], time_unit="settling_time", move_weight=move_weight)
    return Problem(name, partial(second_order, *plant), cost, start)


def _reel_with_friction() -> Plant:
    return plants.reference_reel() + plants.CoulombFriction(torque_Nm=0.05)


_FAMILIES = (
    _on_reel("reel 0.5 m", 0.5),  # the shortest cable of the reference reel
    _on_reel("reel 1.4 m", 1.4),  # its longest
    _on_second_order("8 Hz", (8.0, 0.15, 1.0), 2.0, Gains(0.12, 6.0, 0.0015, 0.05)),
    _on_second_order("3 Hz", (3.0, 0.06, 1.0), 2.0, Gains(0.15, 3.0, 0.005, 0.1)),
    _on_second_order("20 Hz", (20.0, 0.7, 1.0), 2.0, Gains(0.1, 12.0, 0.0004, 0.024)),
    _on_second_order("dead time", (8.0, 0.15, 12.0), 5.0, Gains(0.08, 3.2, 0.002, 0.045)),
    _on_reel("friction", 0.8, _reel_with_friction),
    Problem("K-K G1", first_plant_of_2006, default_cost(20.0), Gains(1.3, 0.035, 0.8, 1.0)),
)
PROBLEMS = {problem.name: problem for problem in _FAMILIES}
"""The families by name."""
