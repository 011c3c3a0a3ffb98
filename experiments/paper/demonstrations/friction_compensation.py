"""Friction and inertia compensation: the paper's Figs. 16 and 17, and its instability.

The reel holds the tension of a platform that a sinusoidal wrench moves along the cable. Friction
and inertia are fed forward from the encoder alone.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import coefficients, state_at_rest
from estune.core.pidf import step as pidf_step
from estune.core.quantities import FloatArray, check_not_negative
from estune.errors import InvalidInput
from estune.reel.friction import StribeckFriction
from estune.reel.velocity import DrumMotion, MotionState, Windows
from estune.reel.velocity import step as estimate
from experiments.paper.demonstrations.platform import TENSION_GAINS, Platform
from plants.models.reel import Reel

ENCODER_COUNTS = 2048.0
"""Of the paper's encoder, per turn."""

Compensation = Callable[[DrumMotion], float]
"""Feed-forward torque at a sample, N m, from the motion estimated at that sample."""

Signal = Any
"""A float or an array."""


@dataclass(frozen=True, slots=True)
class FeedForward:
    """Feed-forward of friction and inertia along the estimated motion.

    Attributes:
        friction: The identified dry friction.
        inertia_kgm2: Identified inertia J_m of all rotating parts at the drum, kg m2.
        fraction: Compensated share of the friction, from 0 to below 1.

    Raises:
        InvalidInput: a value is out of its range.
    """

    friction: StribeckFriction
    inertia_kgm2: float
    fraction: float = 0.8

    def __post_init__(self) -> None:
        check_not_negative("inertia", self.inertia_kgm2, "kg m2")
        if not 0.0 <= self.fraction < 1.0:
            raise InvalidInput(
                f"friction fraction is {self.fraction}; from 1 on the compensation drives the "
                "drum by itself, choose one from 0 to below 1"
            )

    def friction_Nm(self, motion: DrumMotion) -> Signal:
        """Friction compensation, N m, along the motion: (10) within its two limits.

        Args:
            motion: Estimated motion. Below its velocity bound the sign is uncertain; a velocity
                with an infinite bound, as at the first sample, is not compensated.
        """
        velocity = np.asarray(motion.velocity_rad_s)
        # The smallest float keeps an exact velocity, bound zero, from dividing zero by zero.
        scale = np.maximum(np.abs(velocity), np.maximum(motion.velocity_bound_rad_s, 5e-324))
        smooth_sign = velocity / scale
        torque = self.fraction * self.friction.size_Nm(velocity) * smooth_sign
        return torque if torque.ndim else float(torque)

    def inertia_Nm(self, motion: DrumMotion) -> Signal:
        """Inertia compensation T_m = J_m alpha_m, N m; zero below the noise floor."""
        return self.inertia_kgm2 * motion.acceleration_rad_s2


@dataclass(frozen=True)
class WrenchTrial:
    """A sinusoidal wrench on the platform while the reel holds its tension."""

    platform: Platform  # the platform and its reel
    feed_forward: FeedForward  # the compensation
    windows: Windows  # the velocity estimator
    gains: Gains = TENSION_GAINS  # gains of the tension PIDF
    wrench_N: float = 4.0  # amplitude of the force along the cable, N
    wrench_Hz: float = 1.0  # frequency of the force, Hz
    encoder_noise_rad: float = 0.0  # noise of the angle before quantisation, rad rms
    duration_s: float = 3.0  # length of the trial, s
    seed: int = 0  # seed of the noise of gauge and encoder


class WrenchTraces(NamedTuple):
    """Columns of one run, shape (samples,); forces are at the cable, N."""

    time_s: FloatArray  # time
    position_m: FloatArray  # platform's position, outward
    velocity_rad_s: FloatArray  # the drum's true velocity
    velocity_estimate_rad_s: FloatArray  # velocity estimated from the encoder
    tension_N: FloatArray  # tension of the cable
    effort_N: FloatArray  # effort, PIDF and feed-forward
    friction_N: FloatArray  # friction component of the feed-forward
    inertia_N: FloatArray  # inertia component of the feed-forward; zero below its noise floor
    true_friction_N: FloatArray  # dry friction (10) at the true velocity
    true_inertia_N: FloatArray  # inertia times the true acceleration


def run_wrench(
    trial: WrenchTrial,
    friction: Compensation | None = None,
) -> WrenchTraces:
    """Runs the trial.

    Args:
        trial: The trial.
        friction: Friction torque, N m, in place of `FeedForward.friction_Nm`.
    """
    bench, reel = trial.platform, trial.platform.reel
    compensate = friction or trial.feed_forward.friction_Nm
    c = coefficients(reel.controller, trial.gains)
    T, R = reel.tension_N, reel.drum_radius_m
    x, pidf, motion_state = bench.at_rest(), state_at_rest(T, T), MotionState()
    times = np.arange(round(trial.duration_s * reel.sampling_Hz)) / reel.sampling_Hz
    noise = np.random.default_rng(trial.seed).normal(size=(times.size, 2))
    noise *= reel.gauge_noise_N, trial.encoder_noise_rad
    count = 2.0 * math.pi / reel.encoder_counts
    rows = []
    for now, (gauge_noise, encoder_noise) in zip(times.tolist(), noise.tolist(), strict=True):
        tension = bench.tension_N(x)
        motion_state, motion = estimate(
            trial.windows, motion_state, now, count * round((x.angle_rad + encoder_noise) / count)
        )
        forward = compensate(motion) / R, trial.feed_forward.inertia_Nm(motion) / R
        pidf, feedback, _ = pidf_step(c, pidf, T, tension + gauge_noise)
        limit = reel.controller.output_max_N
        effort = min(max(float(feedback) + sum(forward), -limit), limit)
        rows.append(
            (x.position_m, x.velocity_rad_s, motion.velocity_rad_s, tension, effort, *forward)
        )
        wrench = trial.wrench_N * math.sin(2.0 * math.pi * trial.wrench_Hz * now)
        x = bench.step(x, effort, T + wrench)
    position, velocity, estimated, tensions, efforts, dry, inertial = np.array(rows).T
    acceleration = np.gradient(velocity, 1.0 / reel.sampling_Hz)
    return WrenchTraces(
        time_s=times,
        position_m=position,
        velocity_rad_s=velocity,
        velocity_estimate_rad_s=estimated,
        tension_N=tensions,
        effort_N=efforts,
        friction_N=dry,
        inertia_N=inertial,
        true_friction_N=bench.friction.torque_Nm(velocity) / R,
        true_inertia_N=reel.drum_inertia_kg_m2 * acceleration / R,
    )


def reference_wrench_trial() -> WrenchTrial:
    """The trial of Fig. 16 on the reference reel: high amplitude, and the paper's encoder."""
    reel = replace(Reel(cable_length_m=0.8, tension_N=15.0), encoder_counts=ENCODER_COUNTS)
    dry = StribeckFriction(coulomb_Nm=0.02, static_Nm=0.03, stribeck_rad_s=0.5)
    return WrenchTrial(
        Platform(reel, dry, damping_Ns_m=8.0, centring_N_m=20.0),
        FeedForward(dry, reel.drum_inertia_kg_m2),
        Windows(2.0 * math.pi / ENCODER_COUNTS),
    )


def run_high_and_low(
    trial: WrenchTrial, low_share: float = 0.1
) -> tuple[WrenchTraces, WrenchTraces]:
    """The data of Figs. 16 and 17: the trial, and one with a share of its wrench."""
    return run_wrench(trial), run_wrench(replace(trial, wrench_N=low_share * trial.wrench_N))
