"""Scales of a machine in other units, and plants of any time constant with their records."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import control
import numpy as np
from scipy.signal import lfilter

import plants
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.effects import RecordScale, Role
from plants.models.linear_plant import LinearPlant
from tests.support_measurements import open_loop


class Scaling(NamedTuple):
    """What times, forces, lengths and angles are multiplied by."""

    time: float = 1.0
    force: float = 1.0
    length: float = 1.0
    angle: float = 1.0

    @property
    def torque(self) -> float:
        """Of the force at an arm, which is a length of cable per angle."""
        return self.force * self.length / self.angle

    def factor(self, unit: str, role: Role = Role.SHAPE) -> float:
        """What a number of a unit of the effects is multiplied by."""
        if role in (Role.PERIODS, Role.PHASE):
            return 1.0 / self.angle if role is Role.PERIODS else 1.0
        torque, rate = self.torque, self.angle / self.time
        return {
            "": 1.0,
            "s": self.time,
            "Hz": 1.0 / self.time,
            "A": 1.0,
            "A/s": 1.0 / self.time,
            "N": self.force,
            "N/s": self.force / self.time,
            "1/N": 1.0 / self.force,
            "1/N2": 1.0 / self.force**2,
            "m": self.length,
            "kg/m": self.force / self.length,
            "rad": self.angle,
            "rad/s": rate,
            "N m": torque,
            "N m s/rad": torque / rate,
            "N m s2/rad2": torque / rate**2,
        }[unit]


def scaled_scale(records: RecordScale, s: Scaling) -> RecordScale:
    """What records show, in other units."""
    units = {
        "sample_s": "s",
        "record_s": "s",
        "window_s": "s",
        "torque_rms_Nm": "N m",
        "torque_max_Nm": "N m",
        "angle_rms_rad": "rad",
        **dict.fromkeys(("velocity_rms_rad_s", "velocity_max_rad_s"), "rad/s"),
        "velocity_min_rad_s": "rad/s",
        "current_max_A": "A",
        "current_rate_A_s": "A/s",
        "angle_noise_rad": "rad",
        "tension_noise_N": "N",
        "reading_max_N": "N",
        "stretch_max_m": "m",
        "preload_N": "N",
        "cable_length_m": "m",
    }
    values = {n: s.factor(unit) * getattr(records, n) for n, unit in units.items()}
    return records._replace(**values, turn_periods=records.turn_periods / s.angle)


class Machine(NamedTuple):
    """A plant as its owner believes it, and its records."""

    model: LinearPlant
    records: Sequence[MeasuredRecord]


def first_order(time_s, *, delay_s=0.0, lag_s=0.0, seed=0, samples=1600, per_time=20):
    """A plant of gain 2, as given and as recorded, with noise of 1 % of the step."""
    rng, step_s, fine = np.random.default_rng(seed), time_s / per_time, 40

    def recorded(number):
        levels = rng.choice([-1.0, -0.5, 0.0, 0.5, 1.0], size=samples // 40 + 1)
        u = np.repeat(levels, 40)[:samples]
        late, part = divmod(delay_s * fine / step_s, 1.0)
        earlier = np.concatenate([np.zeros(int(late) + 1), np.repeat(u, fine)])
        n = samples * fine
        x = (1.0 - part) * earlier[1 : n + 1] + part * earlier[:n]
        for constant in filter(None, (lag_s, time_s)):
            kept = math.exp(-step_s / fine / constant)
            x = lfilter([0.0, 1.0 - kept], [1.0, -kept], x)
        y = 2.0 * x[::fine] + 0.02 * rng.standard_normal(samples)
        m = open_loop(number, 1.0 / step_s, u, tension_N=y)
        return replace(m, setpoint_N=u, current_A=None)

    plant = plants.linear_plant(control.tf([2.0], [time_s, 1.0]), sampling_Hz=1.0 / step_s)
    return Machine(plant, [recorded(n) for n in range(2)])
