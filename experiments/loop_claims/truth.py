"""True properties of a loop, by its own plant: cost, overshoot, Ms, constrained optimum."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.margins import SampledPlant, controller_response, is_stable
from estune.core.quantities import FloatArray
from estune.trial.profiles import StepProfile
from plants.effects import (
    CoulombFriction,
    DahlHysteresis,
    GaugeDrift,
    MainsInterference,
    StribeckFriction,
)
from plants.models.linear_plant import LinearPlant
from plants.models.reel import Reel
from plants.simulation.plant import Plant

NOISE_DRAWS = 4
"""Draws of the measurement noise in the mean cost."""

SEED = 777_000  # of those draws; no search has this seed
ANGLES = np.concatenate([np.geomspace(1e-4, 0.1, 300), np.linspace(0.1, math.pi, 1500)])
ABOUT = np.concatenate([-(2.0 ** np.arange(-1.0, 8.0, 0.25)), 2.0 ** np.arange(-1.0, 8.0, 0.25)])
"""Angles of the response, and further ones about each resonance, in its half widths."""

PERIOD, PERIODS = 4096, 3
"""Samples of the small multisine by which Ms is measured, and how often it is repeated."""

MULTISINE = 1e-3
"""Standard deviation of it, as a share of the step."""

GROWING = 1.2
"""Ratio of the last period to the one before, from which a loop is unstable."""

NOT_OF_THE_LOOP = (
    CoulombFriction,
    DahlHysteresis,
    StribeckFriction,
    GaugeDrift,
    MainsInterference,
)
"""Effects that hold the drum in a small multisine, or add to the measurement whatever the loop
does, and would be read as an Ms of 300: Ms is that of the loop without them."""

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
        sensitivity: Ms of the whole plant, but for `NOT_OF_THE_LOOP`.
    """

    cost: float
    overshoot: float
    sensitivity: float


def true_sensitivity(plant: Plant, gains: Gains) -> float:
    """Ms of the loop with the whole plant, infinite if it is unstable.

    Of a linear plant by its own model. Otherwise a small multisine is added to the measurement at
    the end of the step, and Ms is the largest ratio of what is measured to what was added.
    """
    if isinstance(plant, LinearPlant) and not plant.effects:
        return _linear_sensitivity(plant, gains)
    if isinstance(plant, Reel):
        kept = tuple(e for e in plant.effects if not isinstance(e, NOT_OF_THE_LOOP))
        plant = replace(plant, effects=kept)
    return _measured_sensitivity(plant, gains)


def _linear_sensitivity(plant: LinearPlant, gains: Gains) -> float:
    sampled = plant.sampled
    if not is_stable(sampled, gains, plant.controller):
        return math.inf
    theta = _angles(sampled)
    loop = controller_response(gains, plant.controller, theta) * sampled.response(theta)
    return float(np.max(1.0 / np.abs(1.0 + loop)))


def _angles(sampled: SampledPlant) -> FloatArray:
    """The grid, finer about the resonances of a plant."""
    modes = sampled.modes[sampled.modes.imag > 0.0]
    about = (modes.imag[:, np.newaxis] - np.outer(modes.real, ABOUT)).ravel()
    return np.union1d(ANGLES, about[(about > ANGLES[0]) & (about < math.pi)])


def _measured_sensitivity(plant: Plant, gains: Gains) -> float:
    """The multisine at rest, after one period in which the loop settles."""
    step, rate = plant.profile, plant.controller.sampling_Hz
    level, size = step.preload_N + step.step_N, abs(step.step_N)
    profile = StepProfile(level, 1e-9 * size, 2.0 / rate, PERIODS * PERIOD / rate)
    lines = np.arange(1, PERIOD // 2)
    spectrum = np.zeros(PERIOD // 2 + 1, complex)
    # Phases of Schroeder, which keep the sum low.
    spectrum[lines] = np.exp(1j * math.pi * lines * (lines - 1) / lines.size)
    period = np.fft.irfft(spectrum, PERIOD)
    added = np.resize(MULTISINE * size * period / period.std(), profile.samples(rate))
    response = plants.simulate(plant, gains, profile=profile, noise_N=added)
    if response.diverged_at is not None:
        return math.inf
    measured = response.tension_N - level
    before, last = measured[-2 * PERIOD : -PERIOD], measured[-PERIOD:]
    if last.std() > GROWING * before.std():
        return math.inf
    ratio = np.fft.rfft(last)[lines] / np.fft.rfft(added[-PERIOD:])[lines]
    return float(np.abs(ratio).max())


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

    def at(self, gains: Gains) -> Truth:
        """Cost, overshoot and sensitivity of gains."""
        plant, step = self.plant, self.plant.profile
        rows = np.tile(gains.as_tuple(), (NOISE_DRAWS, 1))
        costs = plants.batch_costs(plant, rows, None, self.cost, seed=SEED, workers=1)
        quiet = plants.simulate(plant, gains)
        sensitivity = true_sensitivity(plant, gains)
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
        Ms = math.log(at.sensitivity / max_sensitivity)
        beyond = max(min(Ms, 5.0), 0.0) + max(at.overshoot - overshoot, 0.0)
        return math.log(at.cost) + PENALTY * beyond

    import cma  # noqa: PLC0415  slow to import

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
