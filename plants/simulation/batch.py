"""One simulated trial, and batches of them on all cores."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estune.core import pidf
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.profiles import AnyProfile, StepProfile
from plants.simulation.noise import NoiseSource
from plants.simulation.plant import Plant, drive_of

CHUNK = 128
"""Trials a thread takes at once: enough that the interpreter's lock, which only one thread can
hold between chunks, is seldom waited for; few enough that memory stays small."""

DIVERGED_AT = 100.0
"""A response has diverged where it passes the largest setpoint this many times over."""


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """A simulated trial; columns have shape (samples,), fewer if it diverged.

    Attributes:
        time_s: Time from the start.
        setpoint_N: The setpoint before its filter.
        tension_N: The measurement.
        effort_N: The controller's effort within its limits.
        angle_rad: The drum angle measured; zero where the plant has no drum.
        flags: `SATURATED` where the limits acted.
        diverged_at: The first sample that left the bound or was not finite; it and those after it
            are not in the columns. None if the trial ran to its end.
        reference_N: Tension outside the reel; None where that is the same.
    """

    time_s: FloatArray
    setpoint_N: FloatArray
    tension_N: FloatArray
    effort_N: FloatArray
    angle_rad: FloatArray
    flags: NDArray[np.uint8]
    diverged_at: int | None
    reference_N: FloatArray | None = None


def simulate(
    plant: Plant,
    gains: Gains,
    profile: AnyProfile | None = None,
    *,
    noise_N: FloatArray | None = None,
    bound_N: float | None = None,
) -> Response:
    """Runs one trial that starts settled at the preload.

    Args:
        plant: The plant; it brings the fixed part of the controller.
        gains: The controller's gains.
        profile: The setpoint; None is the plant's own step.
        noise_N: What the measurement noise adds, N, shape (samples,); None is no noise.
        bound_N: The trial ends where the measurement's size passes it; None is 100 times the
            largest setpoint.

    Raises:
        InvalidInput: the noise is of another length, or the profile does not suit the rate.
        PlantError: the plant cannot be simulated. One that merely diverges is no error.
    """
    profile = profile or plant.profile
    drive = drive_of(profile, plant.controller.sampling_Hz)
    time, setpoint = drive.time_s, drive.setpoint_N
    if noise_N is not None and noise_N.shape != time.shape:
        raise InvalidInput(
            f"the noise has shape {noise_N.shape} where the trial has {len(time)} samples"
        )
    row = np.array([pidf.coefficients(plant.controller, gains)])
    columns = plant.respond(
        row,
        drive,
        None if noise_N is None else noise_N[np.newaxis],
        # A response that is not finite has diverged whatever the bound.
        bound(profile) if bound_N is None else min(bound_N, sys.float_info.max),
    )
    ended = int(columns.ended[0])
    tension, effort, angle, flags, _, reference = columns.trial(0)
    if ended == len(time):
        return Response(time, setpoint, tension, effort, angle, flags, None, reference)
    kept = slice(ended)
    return Response(
        time[kept],
        setpoint[kept],
        tension[kept],
        effort[kept],
        angle[kept],
        flags[kept],
        ended,
        None if reference is None else reference[kept],
    )


def batch_costs(
    plant: Plant,
    gains: ArrayLike,
    step: StepProfile | None,
    cost: StepCost,
    *,
    seed: int | None = None,
    workers: int | None = None,
) -> FloatArray:
    """The cost of many sets of gains, on all cores; memory does not grow with their number.

    Args:
        plant: The plant.
        gains: P, I, D and setpoint filter, one row a trial, shape (trials, 4).
        step: The setpoint; None is the plant's own.
        cost: The cost (35).
        seed: Seed of the measurement noise, row n being trial n; None is no noise.
        workers: Threads; None is one for each core this process may use.

    Returns:
        Shape (trials,); NaN where the trial diverged.

    Raises:
        InvalidInput: a gain is out of its range, or the trial does not fit the cost.
        PlantError: the plant cannot be simulated.
    """
    profile = step or plant.profile
    rate = plant.controller.sampling_Hz
    drive = drive_of(profile, rate)
    rows = _coefficients(plant, gains)
    costs = np.empty(len(rows))

    def chunk(start: int) -> None:
        part = slice(start, min(start + CHUNK, len(rows)))
        noise = None if seed is None else _noise(plant, profile, seed, part)
        columns = plant.respond(rows[part], drive, noise, bound(profile))
        done = columns.ended == len(drive.setpoint_N)
        # What a diverged trial did not fill could be anything.
        columns.tension_N[~done], columns.effort_N[~done] = np.nan, np.nan
        costs[part] = cost.evaluate(
            rate,
            profile.step_index(rate),
            profile.step_N,
            drive.setpoint_N,
            columns.tension_N,
            columns.effort_N,
        )

    starts = range(0, len(rows), CHUNK)
    threads = min(workers or _cores(), len(starts))
    if threads <= 1:
        for start in starts:
            chunk(start)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(chunk, starts))  # the list is there to raise what a thread raised
    return costs


def bound(profile: AnyProfile) -> float:
    """Size of the measurement, N, past which a response to this profile has diverged."""
    low, high = profile.extremes_N
    return DIVERGED_AT * max(abs(low), abs(high), high - low)


def _cores() -> int:
    """Cores this process may use, where the system says; else all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _coefficients(plant: Plant, gains: ArrayLike) -> FloatArray:
    """The controllers' difference equations, shape (trials, 9)."""
    table = np.asarray(gains, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != 4:
        raise InvalidInput(
            f"the gains have shape {table.shape}; give one row a trial of P, I, D, "
            "setpoint_filter_s"
        )
    wrong = ~(np.isfinite(table).all(axis=1) & (table[:, 0] > 0.0) & (table >= 0.0).all(axis=1))
    if wrong.any():
        # The first wrong row, so that the one place that knows the limits can say what is wrong.
        Gains(*table[np.argmax(wrong)].tolist())
    c = pidf.symbolic_coefficients(plant.controller, *table.T)
    return np.stack([np.broadcast_to(value, len(table)) for value in c], axis=1)


def _noise(plant: Plant, profile: StepProfile, seed: int, part: slice) -> FloatArray:
    source, samples = NoiseSource(seed), profile.samples(plant.controller.sampling_Hz)
    return np.stack(
        [source.draw(n, samples, plant.noise_rms_N) for n in range(part.start, part.stop)]
    )
