"""The platform at the boundary of its workspace: the paper's Fig. 18, with and without hand-over.

The user pushes the platform beyond the boundary, where the tension distribution has no solution.
The hybrid controller holds the cable's length at the boundary there, and controls the tension
inside.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.gains import Gains
from estune.core.pidf import PidfState, coefficients, state_at_rest
from estune.core.pidf import step as pidf_step
from estune.core.quantities import FloatArray
from estune.reel import hybrid
from estune.reel.friction import StribeckFriction
from experiments.paper.demonstrations.platform import TENSION_GAINS, Platform
from plants.models.reel import Reel

POSITION_GAINS = Gains(P=2000.0, I=6000.0, D=120.0, setpoint_filter_s=0.0)
RULES = hybrid.SwitchingRules(tension_min_N=2.0, margin_N=1.0)


@dataclass(frozen=True)
class BoundaryTrial:
    """The trial and the controller of Fig. 18."""

    platform: Platform  # the platform and its reel
    position: Gains = POSITION_GAINS  # gains of the position PIDF, N/m, N/(m s), N s/m
    tension: Gains = TENSION_GAINS  # gains of the tension PIDF
    rules: hybrid.SwitchingRules = RULES  # switching rules
    boundary_m: float = 0.02  # boundary of the workspace, m from the platform's start; above zero
    push_N: float = 5.0  # outward force of the user, N
    push_swing_N: float = 6.0  # amplitude of its variation, N
    push_Hz: float = 0.7  # frequency of its variation, Hz
    duration_s: float = 6.0  # length of the trial, s
    seed: int = 0  # seed of the gauge's noise


class BoundaryTraces(NamedTuple):
    """Columns of one run, shape (samples,)."""

    time_s: FloatArray  # time
    position_m: FloatArray  # platform's position, outward
    tension_N: FloatArray  # tension of the cable
    effort_N: FloatArray  # commanded effort
    in_tension: NDArray[np.bool_]  # selection S: whether the tension is controlled
    # Difference of the effort to that of the previous controller at a switch; zero elsewhere.
    jump_N: FloatArray


def run_boundary(trial: BoundaryTrial) -> tuple[BoundaryTraces, BoundaryTraces]:
    """The data of Fig. 18: the trial with and without the hand-over (36)-(37)."""
    return _run(trial, hand_over=True), _run(trial, hand_over=False)


def parallel_step(
    c: hybrid.HybridCoefficients,
    state: hybrid.HybridState,
    signals: hybrid.HybridSignals,
    in_tension: hybrid.Selection,
) -> tuple[hybrid.HybridState, FloatArray]:
    """One sample without hand-over: both controllers run in parallel and S selects an effort.

    The integral of the inactive controller winds up, and a switch releases it.
    """
    r_p, y_p, r_t, y_t = signals
    position, s_p, _ = pidf_step(c.position, state.position, r_p, y_p)
    tension, s_t, _ = pidf_step(c.tension, state.tension, r_t, y_t)
    effort = np.where(in_tension, np.asarray(s_t), np.asarray(s_p))
    return hybrid.HybridState(position, tension, in_tension), effort


def _run(trial: BoundaryTrial, *, hand_over: bool) -> BoundaryTraces:
    reel, bench = trial.platform.reel, trial.platform
    c = hybrid.HybridCoefficients(
        coefficients(reel.controller, trial.position), coefficients(reel.controller, trial.tension)
    )
    x = bench.at_rest()
    T = reel.tension_N
    wound = reel.drum_radius_m * x.angle_rad
    hold = wound - trial.boundary_m
    state = hybrid.HybridState(PidfState(T, hold, wound), state_at_rest(T, T), in_tension=True)
    advance = hybrid.step if hand_over else parallel_step
    times = np.arange(round(trial.duration_s * reel.sampling_Hz)) / reel.sampling_Hz
    noise = np.random.default_rng(trial.seed).normal(0.0, reel.gauge_noise_N, times.size)
    count = 2.0 * math.pi / reel.encoder_counts
    rows = []
    for now, error in zip(times.tolist(), noise.tolist(), strict=True):
        tension = bench.tension_N(x)
        read = tension + error
        wound = reel.drum_radius_m * count * round(x.angle_rad / count)
        solved = x.position_m <= trial.boundary_m
        selected = trial.rules.select(state.in_tension, read, solved)
        signals = hybrid.HybridSignals(
            hold, wound, trial.rules.tension_setpoint_N(T, solved), read
        )
        _, unswitched = advance(c, state, signals, state.in_tension)
        state, effort = advance(c, state, signals, selected)
        rows.append((x.position_m, tension, effort, selected, effort - unswitched))
        swing = trial.push_swing_N * math.sin(2.0 * math.pi * trial.push_Hz * now)
        x = bench.step(x, float(effort), T + trial.push_N + swing)
    position, tensions, efforts, selections, jumps = np.array(rows).T
    return BoundaryTraces(times, position, tensions, efforts, selections > 0.0, jumps)


def reference_boundary_trial() -> BoundaryTrial:
    """The trial on the reference reel at 0.8 m and 15 N, with dry friction at its drum."""
    reel = Reel(cable_length_m=0.8, tension_N=15.0)
    friction = StribeckFriction(coulomb_Nm=0.02, static_Nm=0.03, stribeck_rad_s=0.5)
    return BoundaryTrial(Platform(reel, friction))
