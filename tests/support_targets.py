"""Targets that cannot be tuned, by module:attribute, for tests of their error messages."""

from dataclasses import replace

import control
import numpy as np

import plants
from estune.core.gains import Gains
from estune.trial.profiles import StepProfile
from tests.support_runs import ArithmeticRig


def unstable():
    """Plant that its gains do not stabilise."""
    return plants.linear_plant(
        control.tf([1.0], [1.0, -50.0]), settling_time_s=0.2, gains=Gains(0.1, 0.1, 0.0, 0.0)
    )


def slowly_unstable():
    """A lag and a mode; at the initial gains an oscillation grows, at a low cost."""
    w = 2.0 * np.pi * 12.0
    mode = control.tf([w * w], [1.0, 2.0 * 0.02 * w, w * w])
    return plants.linear_plant(
        control.tf([1.0], [0.05, 1.0]) * mode,
        sampling_Hz=632.0,
        gains=Gains(0.1, 3.0, 0.001, 0.02),
        noise_rms_N=0.003,
        profile=StepProfile(0.0, 1.0, 0.2, 1.4),
        settling_time_s=0.3,
    )


def diverging():
    """Function whose output diverges to infinity."""

    def step(state, _effort, _dt_s):
        return state * 10.0 + 1.0, state

    return plants.python_plant(
        step, 1.0, sampling_Hz=1000.0, settling_time_s=0.1, gains=Gains(1.0, 1.0, 0.0, 0.0)
    )


def misshapen():
    """Function that returns an array instead of one number."""

    def step(state, effort, _dt_s):
        return state, (effort, effort)

    return plants.python_plant(
        step, 1.0, sampling_Hz=1000.0, settling_time_s=0.1, gains=Gains(1.0, 1.0, 0.0, 0.0)
    )


class _Short(ArithmeticRig):
    def run(self, request):
        record = super().run(request)
        columns = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags")
        return replace(record, **{name: getattr(record, name)[:30] for name in columns})


def short():
    """Rig that sends half the samples and reports the trial as done."""
    return _Short()
