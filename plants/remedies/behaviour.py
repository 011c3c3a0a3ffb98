"""Behaviour and sensitivity of a simulated loop, with the compensations of a remedy or without."""

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from estune.core.cost import default_cost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.loop_model.fitting import fit_loop
from estune.loop_model.margins import robustness
from estune.trial import TrialRequest
from estune.trial.description import RigLimits
from estune.trial.loop_records import loop_signals
from estune.trial.profiles import AnyProfile
from estune.trial.tracking import rest_of, resting_profile, tracking_of, tracking_profile
from plants.simulation.batch import divergence_limit_N, simulate_drive
from plants.simulation.compensation import TrialCompensation
from plants.simulation.plant import drive_of

MEASURES = ("cost", "tracking", "reversal", "rest")
"""What a loop is judged by; see `estune.trial.tracking`."""
RECORDS = 3
"""Steps that are identified together, as of a short run."""


def behaviour(
    plant: Any,
    gains: Gains,
    settling_time_s: float,
    remedy: TrialCompensation | None = None,
    *,
    truth: Callable[[FloatArray], FloatArray] | None = None,
    limits: RigLimits | None = None,
    seed: int = 0,
) -> FloatArray:
    """`MEASURES` of a plant's loop; the cost counts the whole current.

    Rest is judged by the gauge, as hunting shows there; the others by the tension outside.

    Args:
        plant: A plant model.
        remedy: Compensations beside the controller; None for none.
        truth: Tension that is there at a reading of the gauge, of which tracking and reversal then
            are; None where the gauge reads the tension.
        limits: Limits within which the triangle is as wide as they allow; None for the usual one.
        seed: Of the noise.

    Returns:
        Cost, then tracking, reversal and rest in N, shape (4,); NaN where the loop diverges.
    """
    step = plant.profile
    resting = resting_profile(step, settling_time_s)
    triangle = tracking_profile(step, settling_time_s, limits)
    rate = plant.controller.sampling_Hz
    tension, current, outside = _run(plant, gains, resting, remedy, seed=2 * seed)
    _, wanted, *_ = drive_of(resting, rate)
    used = step.samples(rate)
    if tension.size < wanted.size:
        return np.full(len(MEASURES), np.nan)
    cost = default_cost(settling_time_s).evaluate(
        rate, step.shape(rate), wanted[:used], outside[:used], current[:used]
    )
    read, _, outside = _run(plant, gains, triangle, remedy, seed=2 * seed + 1)
    followed = outside if truth is None else truth(read)
    _, asked, *_ = drive_of(triangle, rate)
    error = asked[: followed.size] - followed
    tracked = tracking_of(triangle, settling_time_s, rate, error)
    return np.array([float(cost), *tracked, rest_of(settling_time_s, rate, tension)])


def _run(
    plant: Any, gains: Gains, profile: AnyProfile, remedy: TrialCompensation | None, seed: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tension at the gauge, effort of the motor, and tension outside of an eyelet, N."""
    drive = drive_of(profile, plant.controller.sampling_Hz)._replace(compensation=remedy)
    noise = plant.noise_rms_N * np.random.default_rng(seed).standard_normal(drive.time_s.size)
    done = simulate_drive(plant, gains, drive, noise, divergence_limit_N(profile))
    outside = done.tension_N if done.reference_N is None else done.reference_N
    return done.tension_N, done.effort_N, outside


def sensitivity(plant: Any, gains: Gains, tables: Mapping[str, Mapping[str, Any]]) -> float:
    """Ms of the loop identified from simulated steps; infinite where they do not identify it.

    A notch is part of the loop that the gains see, as it is in the records of a rig.
    """
    rig = plant.rig(gains=gains)
    about = rig.describe()
    text = json.dumps({name: dict(one) for name, one in tables.items()}) if tables else ""
    records = []
    for number in range(RECORDS):
        request = TrialRequest("margins", number, gains, about.step, compensation=text)
        signals = loop_signals(rig.run(request), about.step, about)
        if signals.record is None:
            return math.inf
        records.append(signals.record)
    fit = fit_loop(records, about.controller.sampling_Hz, about.settling_time_s)
    return robustness(fit.model, gains, about.controller).sensitivity
