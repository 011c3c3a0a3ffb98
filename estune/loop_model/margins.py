"""Stability margins over frequency, of several loops at once: each takes a fifth of one alone."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.closed_loops import ClosedLoops, Inputs, closed_loops
from estune.loop_model.model import Laws, LoopModel
from estune.loop_model.poles import ComplexArray

GRID_POINTS = 250
LOWEST_rad = 1e-4
POINTS_PER_TURN = 24
"""Grid of the frequency response; Ms is refined between its points."""

_OCTAVES = 2.0 ** np.arange(-1.0, 7.5, 0.5)
ABOUT_A_POLE = np.concatenate([-_OCTAVES, [0.0], _OCTAVES])
"""Further points of the grid about each pole, in half widths of its resonance. Without them a mode
of damping 0.03 was read as Ms 1.60 for 1.84; with them modes of damping 0.001 as with 200 000
points to 0.3 %."""

BANDS = 16
"""Bands of the grid, of as many points each, in each of which the largest |S| is found. With 1, 8,
16 and 32 of them a search for the optimum of loops with modes took a mean of 152, 46, 26 and 33
evaluations."""

ZOOM_REACH, ZOOMED = 0.6, 13
"""Share of the distance to the next points of the grid, and number of points, of a second grid
about the lowest |1 + L| of each band: resonances of the closed loop are not those of the plant."""


class Robustness(NamedTuple):
    """Stability margins of the linear loop.

    Attributes:
        sensitivity: Ms, the largest |S| over frequency; infinite where the loop is unstable.
        phase_margin_deg: Smallest phase margin over all gain crossovers, degrees; infinite
            without a crossover, NaN where the loop is unstable.
        peaks: Largest |S| in each band of frequency: where two peaks are level, the largest of
            all has a kink along the gains, and these have none.
    """

    sensitivity: float
    phase_margin_deg: float
    peaks: tuple[float, ...]


UNSTABLE = Robustness(math.inf, math.nan, (math.inf,) * BANDS)


class FrequencyGrid(NamedTuple):
    """Frequency responses that the margins are computed from, on grids of angles.

    Attributes:
        theta: Angles, rad/sample, from well below the loop's rates to half the sampling rate,
            shape (models, angles) as all of them.
        later: q^-1 = exp(-i theta).
        zeros: q^-(d+1) B.
        poles: A.
    """

    theta: FloatArray
    later: ComplexArray
    zeros: ComplexArray
    poles: ComplexArray

    @classmethod
    def at(cls, models: Sequence[LoopModel], theta: FloatArray) -> "FrequencyGrid":
        """The responses of models of one order and dead time at some angles of each."""
        # By sines of real angles, which take a third of the time of complex exponentials.
        half, turned = np.sin(0.5 * theta), (models[0].dead_samples + 1) * theta
        difference = 2.0 * half * half + 1j * np.sin(theta)
        later, late = 1.0 - difference, np.cos(turned) - 1j * np.sin(turned)
        poles = np.ones_like(later)
        for sections in zip(*(model.sections for model in models), strict=True):
            powers = np.array([section.powers for section in sections])
            poles = poles * _polynomial_at(powers, difference)
        numerator = np.array([model.numerator for model in models])
        zeros = late * _polynomial_at(numerator, difference)
        return cls(theta, later, zeros, poles)


def frequency_response(model: LoopModel, theta: FloatArray) -> ComplexArray:
    """G(exp(i theta)) of a model for angles in rad/sample, shape (angles,)."""
    at = FrequencyGrid.at([model], theta[np.newaxis])
    return np.asarray(at.zeros[0] / at.poles[0])


@lru_cache(maxsize=64)
def frequency_grid(models: tuple[LoopModel, ...]) -> FrequencyGrid:
    """The grids of models: logarithmic, finer for the dead time and about each resonance."""
    angles = _angles(models[0].dead_samples)
    theta = np.broadcast_to(angles, (len(models), angles.size))
    pairs = [model.sections[: model.order // 2] for model in models]
    logs = np.array([[pair.log_poles for pair in each] for each in pairs])
    if logs.size:
        # A pole that does not swing has no resonance: its points go to the end of the grid.
        resonances = np.where(logs.imag > 0.0, logs, math.pi * 1j).reshape(len(models), -1, 1)
        widths = np.maximum(np.abs(resonances.real), 1e-6)
        about = np.clip(resonances.imag + widths * ABOUT_A_POLE, LOWEST_rad, math.pi)
        theta = np.sort(np.concatenate([theta, about.reshape(len(models), -1)], axis=1), axis=1)
    return FrequencyGrid.at(models, theta)


@lru_cache(maxsize=16)
def _angles(dead_samples: int) -> FloatArray:
    """Angles of the grid of all models with a dead time."""
    turns = POINTS_PER_TURN * (dead_samples + 2) // 2
    return np.union1d(
        np.geomspace(LOWEST_rad, math.pi, GRID_POINTS), np.linspace(0.0, math.pi, turns)[1:]
    )


def _polynomial_at(coefficients: FloatArray, x: ComplexArray) -> ComplexArray:
    """Polynomials at x of one row for all, or one for each; coefficients (polynomials, terms)."""
    value = coefficients[:, -1:] + np.zeros_like(x)
    for power in range(coefficients.shape[1] - 2, -1, -1):
        value *= x
        value += coefficients[:, power : power + 1]
    return value


class LoopResponse(NamedTuple):
    """The loop on the grid of a model, shape (angles,) each.

    Attributes:
        theta: Angles, rad/sample.
        controller: C_y = S/R.
        loop: L.
    """

    theta: FloatArray
    controller: ComplexArray
    loop: ComplexArray
    stable: bool


@lru_cache(maxsize=8)
def loop_response(model: LoopModel, gains: Gains, settings: ControllerSettings) -> LoopResponse:
    """The loop of a model and a controller over frequency."""
    grid, laws = frequency_grid((model,)), Laws.of([gains], settings)
    measured, R = _law_at(laws, grid.later)
    controller = measured / R
    loop = grid.zeros / grid.poles * controller
    characteristic = grid.poles * R + grid.zeros * measured
    stable = bool(_are_stable([model], laws, characteristic)[0])
    return LoopResponse(grid.theta[0], controller[0], loop[0], stable)


def _law_at(laws: Laws, later: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """S and R at q^-1."""
    return _polynomial_at(laws.measurement, later), _polynomial_at(laws.denominator, later)


def _are_stable(
    models: Sequence[LoopModel], laws: Laws, characteristic: ComplexArray
) -> NDArray[np.bool_]:
    """Whether loops are stable, by their characteristic polynomials over frequency, (loops,).

    A loop is stable where its characteristic polynomial in q^-1 has no zero within the unit
    circle. Its value at zero is above zero; so it is above zero at one, too, and makes no turn
    about the origin as theta goes from 0 to pi: it ends above zero, and crosses the negative real
    axis as often one way as the other.
    """
    poles = [math.prod(float(s.powers[0]) for s in model.sections) for model in models]
    zeros = np.array([model.numerator[0] for model in models])
    at_one = poles * laws.denominator.sum(axis=1) + zeros * laws.measurement.sum(axis=1)
    x, y = characteristic.real, characteristic.imag
    upper = y >= 0.0
    turned = x[:, :-1] * y[:, 1:] - x[:, 1:] * y[:, :-1]
    down = upper[:, :-1] & ~upper[:, 1:] & (turned > 0.0)
    up = ~upper[:, :-1] & upper[:, 1:] & (turned < 0.0)
    turns = np.count_nonzero(down, axis=1) - np.count_nonzero(up, axis=1)
    stable: NDArray[np.bool_] = (at_one > 0.0) & (x[:, -1] > 0.0) & (turns == 0)  # not with NaN
    return stable


def robustness(model: LoopModel, gains: Gains, settings: ControllerSettings) -> Robustness:
    """Ms and phase margin of the loop of a model and a controller."""
    return robustness_of([model], [gains], settings)[0]


def robustness_of(
    models: Sequence[LoopModel], gains: Sequence[Gains], settings: ControllerSettings
) -> list[Robustness]:
    """Ms and phase margin of several loops.

    Args:
        models: Of one order and dead time; one for all gains, or one for each.
        gains: One for all models, or one for each.
        settings: The fixed part of the controller.
    """
    found = compiled_loops(models, gains, settings)
    return found[0] if found else _robustness_of(models, Laws.of(gains, settings))


def compiled_loops(
    models: Sequence[LoopModel],
    gains: Sequence[Gains],
    settings: ControllerSettings,
    inputs: Inputs | None = None,
) -> tuple[list[Robustness], ClosedLoops] | None:
    """The margins of several loops and their answers to some inputs; None without a compiler."""
    grid = _compiled_grid(models[0].dead_samples)
    found = closed_loops(models, Laws.of(gains, settings), grid, inputs)
    if found is None:
        return None
    rows = zip(found.stable, found.margin_deg.tolist(), found.peaks.tolist(), strict=True)
    return [
        Robustness(max(peaks), margin, tuple(peaks)) if stable else UNSTABLE
        for stable, margin, peaks in rows
    ], found


@lru_cache(maxsize=16)
def _compiled_grid(dead_samples: int) -> tuple[FloatArray, FloatArray, int]:
    """The grid as `closed_loops` takes it."""
    theta = _angles(dead_samples)
    half, late = 0.5 * theta, (dead_samples + 1) * theta
    table = np.array([theta, np.sin(half), np.cos(half), np.cos(late), np.sin(late)])
    return table, ABOUT_A_POLE, BANDS


def _robustness_of(models: Sequence[LoopModel], laws: Laws) -> list[Robustness]:
    """The same without a compiler."""
    count = max(len(models), len(laws.setpoint))
    grid = frequency_grid(tuple(models))
    S, R = _law_at(laws, grid.later)
    forward, feedback = grid.poles * R, grid.zeros * S
    characteristic = forward + feedback
    stable = _are_stable(models, laws, characteristic)
    scale = np.abs(forward)
    with np.errstate(divide="ignore", invalid="ignore"):
        size, magnitude = np.abs(characteristic) / scale, np.abs(feedback) / scale
    least = _lowest_in_bands(models, laws, grid.theta, size)
    margins = np.full(count, math.inf)
    loud = magnitude > 1.0
    row, at = np.nonzero(loud[:, :-1] != loud[:, 1:])
    before, after = np.log(magnitude[row, at]), np.log(magnitude[row, at + 1])
    share = before / (before - after)
    here, following = (feedback[row, k] / forward[row, k] for k in (at, at + 1))
    angles = np.angle(-here) + share * np.angle(following / here)
    np.minimum.at(margins, row, np.degrees(np.abs(angles)))
    peaks = (1.0 / least).tolist()
    return [
        Robustness(max(peaks[i]), float(margins[i]), tuple(peaks[i])) if stable[i] else UNSTABLE
        for i in range(count)
    ]


def _lowest_in_bands(
    models: Sequence[LoopModel], laws: Laws, theta: FloatArray, size: FloatArray
) -> FloatArray:
    """Lowest |1 + L| in each band, shape (loops, bands).

    Args:
        models: One for all loops, or one for each.
        laws: Their controllers.
        theta: Angles, shape (models, angles).
        size: |1 + L| there, shape (loops, angles).
    """
    count, angles = size.shape
    rows = np.arange(count)[:, np.newaxis]
    # Bands share the points at their borders, about which each of them may be refined.
    ends = np.linspace(0, angles - 1, BANDS + 1).astype(int)
    offsets = np.arange(np.diff(ends).max() + 1)
    inside = np.minimum(ends[:-1, np.newaxis] + offsets, ends[1:, np.newaxis])
    lowest = inside[np.arange(BANDS), np.argmin(size[:, inside], axis=2)]
    inner = np.clip(lowest, ends[:-1] + 1, ends[1:] - 1)
    own = rows if len(models) > 1 else np.zeros_like(rows)
    begin, middle, end = (theta[own, inner + side][..., np.newaxis] for side in (-1, 0, 1))
    share = ZOOM_REACH * np.linspace(-1.0, 1.0, ZOOMED)
    near = middle + share * np.where(share < 0.0, middle - begin, end - middle)
    zoom = FrequencyGrid.at(models, near.reshape(count, -1))
    S, R = _law_at(laws, zoom.later)
    forward = zoom.poles * R
    zoomed = (np.abs(forward + zoom.zeros * S) / np.abs(forward)).reshape(-1, ZOOMED)
    refined = _refined(zoomed).reshape(count, BANDS)
    return np.where(inner == lowest, refined, size[rows, lowest])


def _refined(values: FloatArray) -> FloatArray:
    """Minimum of a parabola through the logarithms of smallest values and their neighbours.

    Of the values themselves it falls below zero where one neighbour is far above the other.

    Args:
        values: Shape (loops, angles).

    Returns:
        Shape (loops,).
    """
    lowest, rows = np.argmin(values, axis=1), np.arange(len(values))
    inner = np.clip(lowest, 1, values.shape[1] - 2)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        left, middle, right = (np.log(values[rows, inner + side]) for side in (-1, 0, 1))
        bend = left - 2.0 * middle + right
        refined = np.exp(middle - (left - right) ** 2 / (8.0 * bend))
    usable = (inner == lowest) & (bend > 0.0)  # not with NaN
    return np.asarray(np.where(usable, refined, values[rows, lowest]))
