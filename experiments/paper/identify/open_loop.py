"""Open-loop record of an excitation on a simulated reel."""

import math
from datetime import UTC, datetime

import numpy as np

from estune.errors import InvalidInput, PlantError
from estune.trial import Outcome, TrialRecord
from experiments.paper.identify.excitation import BroadbandExcitation
from plants.models.reel import SAFE_GAINS, Reel
from plants.simulation.batch import simulate_drive
from plants.simulation.noise import NoiseSource
from plants.simulation.plant import SOFTWARE, TrialSetpoint


def open_loop_record(
    reel: Reel, excitation: BroadbandExcitation, seed: int | None = 0
) -> TrialRecord:
    """Open-loop record of an excitation added to a reel's preload, starting at rest.

    The command is the current: setpoint x drum radius / torque constant. The record names the
    reel's safe gains, but no controller acts.

    Args:
        reel: The reel, with its effects.
        excitation: An excitation at the reel's sampling rate.
        seed: Seed of the gauge noise; None is no noise.

    Raises:
        InvalidInput: the excitation has another rate.
        PlantError: the response is not finite.
    """
    if abs(excitation.sampling_Hz / reel.sampling_Hz - 1.0) > 1e-9:
        raise InvalidInput(
            f"the excitation is made for {excitation.sampling_Hz:g} Hz, the reel runs at "
            f"{reel.sampling_Hz:g} Hz; make it at the reel's rate"
        )
    setpoint = reel.tension_N + excitation.waveform_N
    time = np.arange(setpoint.size) / reel.sampling_Hz
    noise = None
    if seed is not None and reel.noise_rms_N > 0.0:
        noise = NoiseSource(seed).draw(0, setpoint.size, reel.noise_rms_N)
    drive = TrialSetpoint(time, setpoint, reel.tension_N, open_loop=True)
    response = simulate_drive(reel, SAFE_GAINS, drive, noise, math.inf)
    if response.diverged_at is not None:
        raise PlantError(
            f"the reel's response is not finite from sample {response.diverged_at} on; lower the "
            "excitation's peak, or check the effects' parameters"
        )
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
        time_s=response.time_s,
        setpoint_N=response.setpoint_N,
        tension_N=response.tension_N,
        current_A=response.effort_N / reel.newtons_per_ampere,
        angle_rad=response.angle_rad,
        flags=response.flags,
        reference_N=response.reference_N,
        loop="open",
        profile=excitation.profile,
    )
