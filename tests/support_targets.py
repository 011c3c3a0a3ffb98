"""Targets that cannot be tuned, by module:attribute, for tests of their error messages."""

from dataclasses import replace

import control

import plants
from estune.core.gains import Gains
from tests.support_runs import ArithmeticRig


def unstable():
    """Plant that its gains do not stabilise."""
    return plants.linear_plant(
        control.tf([1.0], [1.0, -50.0]), settling_time_s=0.2, gains=Gains(0.1, 0.1, 0.0, 0.0)
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
