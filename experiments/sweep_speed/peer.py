"""A reel as a rig whose trials python-control simulates."""

from datetime import UTC, datetime

import control
import numpy as np

from estune.trial import Outcome, TrialRecord, TrialRequest
from experiments.inert_rig import MotionlessRig
from experiments.reference_trial import nonlinear_start, nonlinear_system
from plants.models.reel import Reel
from plants.simulation.noise import NoiseSource


class PeerRig(MotionlessRig):
    """A reel simulated by python-control; implements `estune.trial.Rig`."""

    def __init__(self, reel: Reel, seed: int) -> None:
        self._reel = reel
        self._noise = NoiseSource(seed)
        super().__init__(reel.describe("python-control", None))

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial by `input_output_response`."""
        reel, profile = self._reel, request.profile
        setpoint = profile.setpoint(reel.sampling_Hz)
        noise = self._noise.draw(request.number, setpoint.size, reel.noise_rms_N)
        time = np.arange(setpoint.size) / reel.sampling_Hz
        response = control.input_output_response(
            nonlinear_system(reel, request.gains, 0.0),
            time,
            np.vstack([setpoint, noise]),
            nonlinear_start(reel),
        )
        # The last state is the current commanded one sample ago.
        current = np.append(response.states[7][1:], response.states[7][-1])
        return TrialRecord(
            trial_id=request.trial_id,
            rig=self._description.name,
            sampling_Hz=reel.sampling_Hz,
            cable_length_m=reel.cable_length_m,
            preload_N=profile.preload_N,
            gains=request.gains,
            outcome=Outcome.DONE,
            reason="",
            started_at=datetime.now(UTC).isoformat(),
            software=f"python-control {control.__version__}",
            time_s=time,
            setpoint_N=setpoint,
            tension_N=np.ravel(response.outputs),
            current_A=current,
            angle_rad=response.states[0],
            flags=np.zeros(setpoint.size, np.uint8),
        )
