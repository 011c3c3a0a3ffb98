"""Records of another simulator or logger: a command and the sensor readings."""

import numpy as np

from plants.diagnosis.data.measured_record import MeasuredRecord


def open_loop(number, rate_Hz, current_A, *, tension_N=None, angle_rad=None):
    """Record without setpoint, preload, gains and flags."""
    return MeasuredRecord(
        name=f"record-{number}",
        rig="rig",
        sampling_Hz=rate_Hz,
        cable_length_m=None,
        preload_N=0.0,
        loop="open",
        profile="custom",
        gains=None,
        time_s=np.arange(current_A.size) / rate_Hz,
        setpoint_N=None,
        current_A=current_A,
        tension_N=tension_N,
        angle_rad=angle_rad,
        reference_N=None,
        flags=None,
    )
