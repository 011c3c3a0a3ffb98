"""Machines and their records in other units of time, force, length and angle."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import control
import numpy as np
from scipy.signal import lfilter

import plants
from experiments.look_alikes import excitations, record
from plants.effects import EFFECTS, Effect, RecordScale, Role
from plants.models.linear_plant import LinearPlant
from plants.models.reel import Reel
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


SCALINGS = (
    Scaling(time=1e-3),
    Scaling(time=1e3),
    Scaling(force=1e4),
    Scaling(force=1e-4),
    Scaling(length=1.0 / 30.0, angle=1.0 / 30.0),
    Scaling(time=7.0, force=0.3, length=20.0, angle=20.0),
)


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
        **dict.fromkeys(("current_rms_A", "current_max_A"), "A"),
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

    model: object
    records: Sequence[object]

    def scaled(self, s: Scaling) -> "Machine":
        """The same machine and motion in other units."""
        return self._replace(
            model=_scaled_model(self.model, s), records=[self._record(m, s) for m in self.records]
        )

    def rounded_otherwise(self) -> "Machine":
        """The same with all that was measured multiplied by 1 + 1e-12."""

        def rounded(m):
            measured = ("setpoint_N", "tension_N", "angle_rad", "current_A")
            columns = {n: getattr(m, n) for n in measured}
            return replace(m, **{n: c * (1 + 1e-12) for n, c in columns.items() if c is not None})

        return self._replace(records=[rounded(m) for m in self.records])

    def _record(self, m, s):
        output = s.angle if isinstance(self.model, LinearPlant) else s.force
        factors = {"time_s": s.time, "setpoint_N": s.force, "tension_N": output}
        factors |= {"angle_rad": s.angle, "cable_length_m": s.length, "preload_N": s.force}
        known = {n: getattr(m, n) for n in factors}
        changed = {n: factors[n] * value for n, value in known.items() if value is not None}
        return replace(m, sampling_Hz=m.sampling_Hz / s.time, **changed)


def _scaled_model(model, s):
    if isinstance(model, LinearPlant):
        (A,), (B,), (C,) = model.model.A, model.model.B, model.model.C
        gain = -s.angle / s.force * C * B / A[0]
        lag = control.tf([gain], [-s.time / A[0], 1.0])
        return plants.linear_plant(lag, sampling_Hz=model.controller.sampling_Hz / s.time)
    torque, rate = s.torque, s.angle / s.time
    factors = {
        "drum_radius_m": s.length / s.angle,
        "drum_inertia_kg_m2": torque * s.time / rate,
        "viscous_friction_Nms": torque / rate,
        "torque_constant_Nm_A": torque,
        "dead_time_s": s.time,
        "sampling_Hz": 1.0 / s.time,
        "derivative_filter_s": s.time,
        "encoder_counts": 1.0 / s.angle,
    }
    if isinstance(model, Reel):
        factors |= {
            "cable_length_m": s.length,
            "viscous_friction_per_length_Ns": torque / rate / s.length,
            "structure_stiffness_N_m": s.force / s.length,
            "cable_density_kg_m": s.force / s.length,
            "gauge_Hz": 1.0 / s.time,
            **dict.fromkeys(("tension_N", "tension_min_N", "tension_max_N"), s.force),
            **dict.fromkeys(("cable_EA_N", "gauge_noise_N"), s.force),
        }
    return replace(model, **{name: f * getattr(model, name) for name, f in factors.items()})


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


def servo(*, dry=0.0, lag_s=0.0, limit=math.inf, ripple=0.0, drag=0.0):
    """A motor with its load, as its owner believes it and as it moved."""
    rate_Hz, J, b, substeps = 250.0, 3e-3, 4e-3, 16
    dt = 1.0 / rate_Hz / substeps

    def recorded(seed):
        rng, t = np.random.default_rng(seed), np.arange(2000) / rate_Hz
        lines = 0.25 * np.arange(1, 25)
        waves = np.cos(2.0 * np.pi * np.outer(t, lines) + rng.uniform(0.0, 2.0 * np.pi, 24))
        u = 0.05 * waves @ (1.0 / np.hypot(1.0, lines))
        u += 0.045 * np.sign(np.sin(0.4 * np.pi * t))
        angle, q, w, drive = np.empty(t.size), 0.0, 0.0, 0.0
        kept = math.exp(-dt / lag_s) if lag_s else 0.0
        for k, effort in enumerate(np.clip(u, -limit, limit).tolist()):
            angle[k] = q
            for _ in range(substeps):
                drive = effort + (drive - effort) * kept
                torque = drive - ripple * math.sin(12.0 * q) - drag * w * abs(w)
                free = (J * w + dt * torque) / (J + dt * b)
                most = dt * dry / (J + dt * b)
                w = 0.0 if abs(free) <= most else free - math.copysign(most, free)
                q += dt * w
        step = 2.0 * np.pi / 8192
        return open_loop(seed, rate_Hz, u, angle_rad=np.round(angle / step) * step)

    model = plants.servo(1.02 * J, 0.95 * b, sampling_Hz=rate_Hz)
    return Machine(model, [recorded(n) for n in (1, 2)])


def reel(effect: Effect) -> Machine:
    """The reference reel with an effect, which its owner's model lacks."""
    model = plants.reference_reel()
    commands = excitations(model.sampling_Hz)
    kinds = ("slow reversals", "noise", "steps")
    records = [record(model + effect, k, commands[k], n) for n, k in enumerate(kinds)]
    return Machine(model, records)


MACHINES = {
    "dead_time": lambda: first_order(2.0, delay_s=0.7, seed=1),
    "current_lag": lambda: first_order(2.0, lag_s=0.5, seed=1),
    "coulomb_friction": lambda: servo(dry=0.02),
    "current_saturation": lambda: servo(limit=0.08),
    "torque_ripple": lambda: servo(ripple=0.01),
    "bent_viscous_friction": lambda: servo(drag=3e-4),
    "eyelet_friction": lambda: reel(EFFECTS["eyelet_friction"](attenuation=0.93)),
    "cable_creep": lambda: reel(EFFECTS["cable_creep"](0.3, 0.3)),
    "structural_mode": lambda: reel(EFFECTS["structural_mode"](0.6, 25.0)),
    "gauge_nonlinearity": lambda: reel(EFFECTS["gauge_nonlinearity"](0.012)),
}
"""Machines by the effect that is hidden in them."""
