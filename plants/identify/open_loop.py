"""An excitation run on a simulated reel in open loop."""

from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from estune.errors import InvalidInput, PlantError
from estune.trial import SATURATED, FloatArray, Outcome, TrialRecord
from plants.identify.excitation import Excitation
from plants.noise import NoiseSource
from plants.plant import SOFTWARE
from plants.reel import SAFE_GAINS, Reel
from plants.reel_equations import ReelStructure


def open_loop_record(reel: Reel, excitation: Excitation, seed: int | None = 0) -> TrialRecord:
    """The record a reel gives of an excitation on top of its preload, from rest.

    The command goes straight to the current loop: current = setpoint x drum radius / torque
    constant. The controller plays no part; the record's gains are the reel's safe ones.

    Args:
        reel: The reel, with its effects.
        excitation: Made at the reel's sampling rate.
        seed: Seed of the gauge noise; None is no noise.

    Raises:
        InvalidInput: the excitation is made for another rate.
        PlantError: the response is not finite.
    """
    if abs(excitation.sampling_Hz / reel.sampling_Hz - 1.0) > 1e-9:
        raise InvalidInput(
            f"the excitation is made for {excitation.sampling_Hz:g} Hz, the reel runs at "
            f"{reel.sampling_Hz:g} Hz; make it at the reel's rate"
        )
    setpoint = reel.tension_N + excitation.waveform_N
    samples = setpoint.size
    noise = np.zeros(samples)
    if seed is not None and reel.noise_rms_N > 0.0:
        noise = NoiseSource(seed).draw(0, samples, reel.noise_rms_N)
    tension, angle, reference = _respond(reel, setpoint, noise)
    bad = np.flatnonzero(~(np.isfinite(tension) & np.isfinite(angle)))
    if bad.size:
        raise PlantError(
            f"the reel's response is not finite from sample {bad[0]} on; lower the excitation's "
            "peak, or check the effects' parameters"
        )
    limit = reel.current_limit_A * reel.newtons_per_ampere
    return TrialRecord(
        trial_id=f"open-{excitation.profile}-{'clean' if seed is None else seed}",
        rig="simulated-reel",
        sampling_Hz=reel.sampling_Hz,
        cable_length_m=reel.cable_length_m,
        preload_N=reel.tension_N,
        gains=SAFE_GAINS,
        outcome=Outcome.DONE,
        reason="",
        started_at=datetime.now(UTC).isoformat(),
        software=SOFTWARE,
        time_s=np.arange(samples) / reel.sampling_Hz,
        setpoint_N=setpoint,
        tension_N=tension,
        current_A=np.clip(setpoint, -limit, limit) / reel.newtons_per_ampere,
        angle_rad=angle,
        flags=np.where(np.abs(setpoint) > limit, SATURATED, 0).astype(np.uint8),
        reference_N=reference if reel.structure.has_outside_gauge else None,
        loop="open",
        profile=excitation.profile,
    )


def _respond(
    reel: Reel, effort_N: FloatArray, noise_N: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tension, angle and tension outside the eyelet at each sample, shape (samples,) each."""
    start, loop = _open_loop(reel.structure, reel.delay_samples, effort_N.size)
    constants, rest = start(reel.parameter_values, reel.tension_N)
    _, measured = loop(rest, constants, np.vstack([effort_N, noise_N]))
    tension, angle, reference = np.asarray(measured, dtype=np.float64)
    return tension, angle, reference


@lru_cache(maxsize=16)
def _open_loop(structure: ReelStructure, delay: int, samples: int) -> tuple[Any, Any]:
    """Start and whole run of the reel without a controller, as CasADi functions.

    start: (parameters, preload) -> (constants, state and drives under way at rest).
    run: (state and drives, constants, efforts and noises) -> (the same later, measurements).
    """
    plant = structure.equations()
    parameters, preload = plant.prepare.sx_in()
    constants, rest, rest_effort = plant.prepare(parameters, preload)
    _, drive = plant.drive(constants, rest, rest_effort)
    start = ca.Function(
        "start",
        [parameters, preload],
        [constants, ca.vertcat(rest, ca.repmat(drive, delay + 1, 1))],
    )
    c, x, _, noise = plant.observe.sx_in()
    under_way, effort = ca.SX.sym("under_way", delay + 1), ca.SX.sym("effort")
    observed, measurement, angle = plant.observe(c, x, under_way[0], noise)
    outside = measurement if plant.outside is None else plant.outside(c, observed)
    driven, drive = plant.drive(c, observed, effort)
    drives = ca.vertcat(under_way, drive)
    moved = plant.move(c, driven, drives[0], drives[1])
    sample = ca.Function(
        "sample",
        [ca.vertcat(x, under_way), c, ca.vertcat(effort, noise)],
        [ca.vertcat(moved, drives[1:]), ca.vertcat(measurement, angle, outside)],
    )
    return start, sample.mapaccum("run", samples)
