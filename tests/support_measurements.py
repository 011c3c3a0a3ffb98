"""Records of another simulator or logger: a command and the sensor readings."""

import numpy as np

from plants.diagnosis.data.measured_record import MeasuredRecord


def open_loop(number, rate_Hz, current_A, *, tension_N=None, angle_rad=None):
    """Record without setpoint, preload, gains and flags."""
    return MeasuredRecord(
        name=f"record-{number}",
        rig="rig",
        sampling_Hz=rate_Hz,
        loop="open",
        time_s=np.arange(current_A.size) / rate_Hz,
        current_A=current_A,
        tension_N=tension_N,
        angle_rad=angle_rad,
    )
