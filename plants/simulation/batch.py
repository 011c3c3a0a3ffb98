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
from plants.simulation.plant import Plant, TrialSetpoint, drive_of

CHUNK = 128
"""Trials per task of a thread: few waits for the interpreter's lock, and little memory."""

DIVERGED_AT = 100.0
"""Measurement at which a response has diverged, relative to the largest setpoint."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Response:
    """A simulated trial; columns have shape (samples,), fewer if it diverged.

    Attributes:
        time_s: Time from the start.
        effort_N: The motor's effort, limited, with what is fed forward.
        angle_rad: Measured drum angle; zero where the plant has no drum.
        flags: `SATURATED` where the limits acted.
        diverged_at: First sample outside the bound or not finite, at which the columns end; None
            for a complete trial.
        reference_N: Tension outside the reel; None where it is the same.
        terms: Compensations; see `Columns`.
    """

    time_s: FloatArray
    setpoint_N: FloatArray
    tension_N: FloatArray
    effort_N: FloatArray
    angle_rad: FloatArray
    flags: NDArray[np.uint8]
    diverged_at: int | None
    reference_N: FloatArray | None = None
    terms: FloatArray | None = None

    def __repr__(self) -> str:
        end = "complete" if self.diverged_at is None else f"diverged at sample {self.diverged_at}"
        return f"Response({len(self.time_s)} samples, {end})"


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
        plant: The plant, with the fixed part of the controller.
        profile: The setpoint; None is the plant's own step.
        noise_N: Measurement noise, N, shape (samples,); None is no noise.
        bound_N: Magnitude of the measurement at which the trial ends; None is 100 times the
            largest setpoint.

    Raises:
        InvalidInput: the noise is of another length, or the profile does not suit the rate.
        PlantError: the plant cannot be simulated; divergence is no error.
    """
    profile = profile or plant.profile
    drive = drive_of(profile, plant.controller.sampling_Hz)
    if noise_N is not None and noise_N.shape != drive.time_s.shape:
        raise InvalidInput(
            f"the noise has shape {noise_N.shape} where the trial has {len(drive.time_s)} samples"
        )
    limit_N = divergence_limit_N(profile) if bound_N is None else bound_N
    return simulate_drive(plant, gains, drive, noise_N, limit_N)


def simulate_drive(
    plant: Plant, gains: Gains, drive: TrialSetpoint, noise_N: FloatArray | None, bound_N: float
) -> Response:
    """Runs one trial of any drive; see `simulate`."""
    row = np.array([pidf.coefficients(plant.controller, gains)])
    noise = None if noise_N is None else noise_N[np.newaxis]
    # A response that is not finite has diverged, even with an infinite bound.
    columns = plant.respond(row, drive, noise, min(bound_N, sys.float_info.max))
    ended, samples = int(columns.ended[0]), len(drive.time_s)
    tension, effort, angle, flags, _, reference, terms = columns.trial(0)
    used = slice(ended)
    return Response(
        drive.time_s[used],
        drive.setpoint_N[used],
        tension[used],
        effort[used],
        angle[used],
        flags[used],
        None if ended == samples else ended,
        None if reference is None else reference[used],
        None if terms is None else terms[used],
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
    """Costs of many sets of gains, computed on all cores in bounded memory.

    Args:
        gains: P, I, D and setpoint filter, one row per trial, shape (trials, 4).
        step: The setpoint; None is the plant's own step.
        seed: Seed of the measurement noise; row n is trial n. None is no noise.
        workers: Threads; None is one per core available to this process.

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
        columns = plant.respond(rows[part], drive, noise, divergence_limit_N(profile))
        done = columns.ended == len(drive.setpoint_N)
        # A diverged trial leaves the rest of its columns undefined.
        columns.tension_N[~done], columns.effort_N[~done] = np.nan, np.nan
        costs[part] = cost.evaluate(
            rate, profile.shape(rate), drive.setpoint_N, columns.tension_N, columns.effort_N
        )

    starts = range(0, len(rows), CHUNK)
    threads = min(workers or _cores(), len(starts))
    if threads <= 1:
        for start in starts:
            chunk(start)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(chunk, starts))  # the list re-raises an exception of a thread
    return costs


def divergence_limit_N(profile: AnyProfile) -> float:
    """Magnitude of the measurement beyond which a response has diverged, N."""
    low, high = profile.extremes
    return DIVERGED_AT * max(abs(low), abs(high), high - low)


def _cores() -> int:
    """Cores available to this process, if the system reports them; otherwise all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _coefficients(plant: Plant, gains: ArrayLike) -> FloatArray:
    """Coefficients of the controllers' difference equations, shape (trials, 9)."""
    table = np.asarray(gains, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != 4:
        raise InvalidInput(
            f"the gains have shape {table.shape}; give one row per trial of P, I, D, "
            "setpoint_filter_s"
        )
    wrong = ~(np.isfinite(table).all(axis=1) & (table[:, 0] > 0.0) & (table >= 0.0).all(axis=1))
    if wrong.any():
        # `Gains` owns the limits and their messages.
        Gains(*table[np.argmax(wrong)].tolist())
    c = pidf.symbolic_coefficients(plant.controller, *table.T)
    return np.stack([np.broadcast_to(value, len(table)) for value in c], axis=1)


def _noise(plant: Plant, profile: StepProfile, seed: int, part: slice) -> FloatArray:
    source, samples = NoiseSource(seed), profile.samples(plant.controller.sampling_Hz)
    return np.stack(
        [source.draw(n, samples, plant.noise_rms_N) for n in range(part.start, part.stop)]
    )
