"""What is fed forward for friction, inertia and weight, for Figs. 16 and 17."""

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.constants import g

from estune.core.quantities import FloatArray
from estune.reel.gravity import gravity_force_N
from estune.support.plot_style import BLUE, GREEN, GREY, VERMILION, finish, legend, stacked
from plants.demonstrations.friction_compensation import WrenchTraces, WrenchTrial


def uncompensated(trial: WrenchTrial) -> WrenchTrial:
    """The same trial with nothing fed forward."""
    return replace(trial, feed_forward=replace(trial.feed_forward, inertia_kgm2=0.0, fraction=0.0))


def weight_N(trial: WrenchTrial, position_m: FloatArray) -> FloatArray:
    """Weight compensation (8), N, of a cable that hangs straight down: the most there can be."""
    reel = trial.platform.reel
    T = reel.tension_N
    length = reel.cable_length_m + position_m
    weight = gravity_force_N(reel.cable_density_kg_m * g, length, tension_1z_N=-T, tension_1_N=T)
    return np.asarray(weight)


def rms(signal: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(signal))))


def deviation(traces: WrenchTraces, trial: WrenchTrial) -> float:
    """How far the tension strays from its setpoint, N rms."""
    return rms(traces.tension_N - trial.platform.reel.tension_N)


def active_share(traces: WrenchTraces) -> float:
    """Share of the samples at which inertia is compensated."""
    return float(np.mean(traces.inertia_N != 0.0))


def least_velocity_rad_s(trial: WrenchTrial) -> float:
    """The velocity whose angle over the longest window is the encoder's error."""
    windows = trial.windows
    span_s = windows.velocity_intervals / trial.platform.reel.sampling_Hz
    return windows.angle_error_rad / span_s


def draw(traces: WrenchTraces, trial: WrenchTrial) -> Figure:
    """Velocity, then each component fed forward beside what it stands for."""
    figure, (velocity, friction, inertia) = stacked(3, 5.4)
    t = traces.time_s
    velocity.plot(t, traces.velocity_rad_s, color=GREY, linewidth=2.2, label="true")
    velocity.plot(
        t, traces.velocity_estimate_rad_s, color=BLUE, linewidth=0.9, label="from the encoder"
    )
    turning = np.abs(traces.velocity_rad_s) > least_velocity_rad_s(trial)
    true_friction = np.where(turning, traces.true_friction_N, np.nan)  # stuck, it may be anything
    _pair(friction, t, (true_friction, traces.friction_N), (VERMILION, "friction while it turns"))
    _pair(inertia, t, (traces.true_inertia_N, traces.inertia_N), (GREEN, "inertia"))
    inertia.plot(
        t, weight_N(trial, traces.position_m), color=BLUE, linestyle=(0, (4, 1.5)),
        linewidth=1.0, label="cable's weight, at most",
    )  # fmt: skip
    finish(velocity, "velocity, rad/s")
    finish(friction, "force, N")
    finish(inertia, "force, N", "time, s")
    for ax in (velocity, friction, inertia):
        legend(ax)
    return figure


def _pair(
    ax: Axes, t: FloatArray, forces: tuple[FloatArray, FloatArray], look: tuple[str, str]
) -> None:
    """The true force and the one fed forward, with the colour and name of the latter."""
    true, fed = forces
    colour, name = look
    ax.plot(t, true, color=GREY, linewidth=2.2, label=f"true {name}")
    ax.plot(t, fed, color=colour, linewidth=1.0, label="fed forward")
