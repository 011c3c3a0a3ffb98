"""Figs. 16 and 17: feed-forward of friction and inertia at high and at low velocity."""

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.constants import g

from estune.core.quantities import FloatArray
from estune.reel.gravity import gravity_force_N
from estune.support.plot_style import BLUE, GREEN, GREY, VERMILION, finish, legend, stacked
from experiments.paper import PaperFigure
from experiments.paper.demonstrations.friction_compensation import (
    WrenchTraces,
    WrenchTrial,
    reference_wrench_trial,
    run_high_and_low,
)

LOW_SHARE = 0.1
"""Wrench of Fig. 17 relative to that of Fig. 16."""


def uncompensated(trial: WrenchTrial) -> WrenchTrial:
    """The trial without feed-forward."""
    return replace(trial, feed_forward=replace(trial.feed_forward, inertia_kgm2=0.0, fraction=0.0))


def weight_N(trial: WrenchTrial, position_m: FloatArray) -> FloatArray:
    """Weight compensation (8), N, of a cable that hangs straight down: its upper limit."""
    reel = trial.platform.reel
    T = reel.tension_N
    length = reel.cable_length_m + position_m
    weight = gravity_force_N(reel.cable_density_kg_m * g, length, tension_1z_N=-T, tension_1_N=T)
    return np.asarray(weight)


def rms(signal: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(signal))))


def deviation(traces: WrenchTraces, trial: WrenchTrial) -> float:
    """Deviation of the tension from its setpoint, N rms."""
    return rms(traces.tension_N - trial.platform.reel.tension_N)


def active_share(traces: WrenchTraces) -> float:
    """Share of the samples with inertia compensation."""
    return float(np.mean(traces.inertia_N != 0.0))


def least_velocity_rad_s(trial: WrenchTrial) -> float:
    """The velocity whose angle over the longest window is the encoder's error."""
    windows = trial.windows
    span_s = windows.velocity_intervals / trial.platform.reel.sampling_Hz
    return windows.angle_error_rad / span_s


def draw(traces: WrenchTraces, trial: WrenchTrial) -> Figure:
    """Velocity, then each component of the feed-forward beside the true force."""
    figure, (velocity, friction, inertia) = stacked(3, 5.4)
    t = traces.time_s
    velocity.plot(t, traces.velocity_rad_s, color=GREY, linewidth=2.2, label="true")
    velocity.plot(
        t, traces.velocity_estimate_rad_s, color=BLUE, linewidth=0.9, label="from the encoder"
    )
    turning = np.abs(traces.velocity_rad_s) > least_velocity_rad_s(trial)
    true_friction = np.where(
        turning, traces.true_friction_N, np.nan
    )  # undetermined while the drum sticks
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
    """The true force and the fed-forward one, with the colour and name of the latter."""
    true, fed = forces
    colour, name = look
    ax.plot(t, true, color=GREY, linewidth=2.2, label=f"true {name}")
    ax.plot(t, fed, color=colour, linewidth=1.0, label="fed forward")


def figure_16(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one run suffices
    """Fig. 16: the platform moves far and fast."""
    trial = reference_wrench_trial()
    high, _ = run_high_and_low(trial)
    bare, _ = run_high_and_low(uncompensated(trial))
    inertia, friction = rms(high.true_inertia_N), rms(high.true_friction_N)
    inertia_left = rms(high.true_inertia_N - high.inertia_N)
    friction_left = rms(high.true_friction_N - high.friction_N)
    share = active_share(high)
    with_it, without = deviation(high, trial), deviation(bare, trial)
    weight = float(weight_N(trial, high.position_m).max())
    return PaperFigure(
        number=16,
        title="Force feed-forward compensation with high angular velocity",
        claim="Under a sinusoidal wrench of high amplitude each component of the feed-forward is "
        "active: the motor's inertia, friction, and the cable's weight.",
        holds=share > 0.5 and inertia_left < 0.5 * inertia and friction_left < 0.5 * friction,
        measured=f"Inertia is compensated in {100.0 * share:.0f} % of the samples and leaves "
        f"{inertia_left:.2f} of {inertia:.2f} N rms, friction {friction_left:.2f} of "
        f"{friction:.2f} N rms; the cable's weight is never more than {weight:.3f} N. The tension "
        f"deviates {with_it:.2f} N rms from its setpoint, {without:.2f} N without feed-forward.",
        rule="Inertia is compensated more than half of the time, and less than half of inertia "
        "and of friction remains, rms.",
        caveat=f"A wrench of {trial.wrench_N:g} N at {trial.wrench_Hz:g} Hz on a simulated "
        f"platform; an encoder of {trial.platform.reel.encoder_counts:.0f} counts a turn, the "
        f"paper's. {100.0 * trial.feed_forward.fraction:g} % of the friction is compensated, so "
        "that an error in its coefficients cannot drive the drum. The weight, of a cable that "
        "hangs straight down, is shown for its size and is not fed forward here.",
        numbers={
            "inertia_active_share": share,
            "inertia_N": inertia,
            "inertia_left_N": inertia_left,
            "friction_N": friction,
            "friction_left_N": friction_left,
            "weight_N": weight,
            "tension_deviation_N": with_it,
            "tension_deviation_bare_N": without,
        },
        figure=draw(high, trial),
    )


def figure_17(*, quick: bool = False) -> PaperFigure:  # noqa: ARG001  one run suffices
    """Fig. 17: the platform moves little."""
    trial = reference_wrench_trial()
    high, low = run_high_and_low(trial, LOW_SHARE)
    _, bare = run_high_and_low(uncompensated(trial), LOW_SHARE)
    reel = trial.platform.reel
    floor = trial.windows.acceleration_floor_rad_s2(reel.sampling_Hz)
    floor_N = trial.feed_forward.inertia_kgm2 * floor / reel.drum_radius_m
    share, share_high = active_share(low), active_share(high)
    inertia = rms(low.true_inertia_N)
    fed = float(np.abs(low.friction_N).max())
    with_it, without = deviation(low, trial), deviation(bare, trial)
    return PaperFigure(
        number=17,
        title="Force feed-forward compensation with low angular velocity",
        claim="At low speed a low-resolution encoder makes the computation of inertia nearly "
        "impossible, so it is compensated only above its noise floor.",
        holds=share == 0.0 and share_high > 0.0 and inertia < floor_N and fed > 0.0,
        measured=f"The noise floor of {floor:.1f} rad/s² is {floor_N:.2f} N at the cable; the "
        f"true inertia is {inertia:.2f} N rms, and is compensated in {100.0 * share:.0f} % of the "
        f"samples, against {100.0 * share_high:.0f} % in Fig. 16. Friction is still compensated, "
        f"by up to {fed:.2f} N. The tension deviates {with_it:.3f} N rms from its setpoint, "
        f"{without:.3f} N without feed-forward.",
        rule="The inertia, rms, lies below the noise floor and is never compensated, "
        "while friction is, and at high speed inertia is too.",
        caveat=f"The trial of Fig. 16 with a wrench of {LOW_SHARE * trial.wrench_N:g} N. The "
        "floor is that of full windows of the velocity estimator; at this speed the drum sticks "
        "and slips, and compensation changes the tension little.",
        numbers={
            "floor_rad_s2": floor,
            "floor_N": floor_N,
            "inertia_N": inertia,
            "inertia_active_share": share,
            "inertia_active_share_high": share_high,
            "friction_fed_N": fed,
            "tension_deviation_N": with_it,
            "tension_deviation_bare_N": without,
        },
        figure=draw(low, trial),
    )
