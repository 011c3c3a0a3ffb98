"""Reels with effects, run in CasADi's virtual machine: nothing is compiled."""

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from estune.core import pidf
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.trial.profiles import StepProfile
from plants.models.reel import Reel, reference_reel
from plants.models.reel_equations import ReelStructure
from plants.simulation.plant import Columns
from plants.simulation.trial_loop import Batch, CasadiLoop, loop_functions

REEL = reference_reel(gauge_noise_N=0.0)
RATE = REEL.sampling_Hz
GAINS = Gains(1.0, 40.0, 0.015, 0.004)
UP = StepProfile(15.0, 20.0, 0.05, 0.3)
DOWN = StepProfile(15.0, -14.5, 0.05, 0.3)  # through slack


@lru_cache(maxsize=128)
def _loop(structure: ReelStructure) -> CasadiLoop:
    return CasadiLoop(loop_functions(structure.equations()))


def trial(reel: Reel, profile: StepProfile = UP, gains: Gains = GAINS) -> Columns:
    """The columns of one closed-loop trial that ends only where it is not finite."""
    batch = Batch(
        reel.parameter_values,
        np.array([pidf.coefficients(reel.controller, gains)]),
        profile.preload_N,
        profile.setpoint(reel.sampling_Hz),
        None,
        reel.delay_samples,
        float(np.finfo(float).max),
    )
    return _loop(reel.structure).run(batch).trial(0)


class Rollout(NamedTuple):
    """Response of a reel to an effort: columns by sample, and the current in force."""

    tension: FloatArray  # as read
    outside: FloatArray  # as read, where there is no gauge outside
    theta: FloatArray
    omega: FloatArray
    current: FloatArray


@lru_cache(maxsize=128)
def _sample(structure: ReelStructure, delay: int) -> tuple[ca.Function, ca.Function]:
    """Start, and one sample without a controller, as CasADi functions."""
    e = structure.equations()
    p, preload = e.prepare.sx_in()
    constants, rest, effort = e.prepare(p, preload)
    _, drive = e.drive(constants, rest, effort)
    begin = ca.vertcat(rest, ca.repmat(drive, delay + 1, 1))
    start = ca.Function("start", [p, preload], [constants, begin, effort])
    c, x, *_ = e.observe.sx_in()
    under_way, u = ca.SX.sym("under_way", delay + 1), ca.SX.sym("u")
    observed, tension, _ = e.observe(c, x, under_way[0], 0.0)
    outside = tension if e.outside is None else e.outside(c, observed)
    driven, drive = e.drive(c, observed, u)
    drives = ca.vertcat(under_way, drive)
    following = ca.vertcat(e.move(c, driven, drives[0], drives[1]), drives[1:])
    seen = ca.vertcat(tension, outside, x[0], x[1], drives[1])
    sample = ca.Function("sample", [ca.vertcat(x, under_way), c, u], [following, seen])
    return start, sample


def rest(reel: Reel, preload_N: float = 15.0) -> tuple[FloatArray, float]:
    """State (angle first) and effort of the settled reel."""
    start, _ = _sample(reel.structure, reel.delay_samples)
    _, state, effort = start(reel.parameter_values, preload_N)
    return np.asarray(state).ravel(), float(effort)


def rollout(reel: Reel, effort_N: ArrayLike, preload_N: float = 15.0) -> Rollout:
    """The reel under an effort, shape (samples,), from rest."""
    start, sample = _sample(reel.structure, reel.delay_samples)
    constants, state, _ = start(reel.parameter_values, preload_N)
    effort = np.asarray(effort_N)[None]
    run = sample.mapaccum(effort.size)
    _, seen = run(state, ca.repmat(constants, 1, effort.size), effort)
    return Rollout(*np.asarray(seen))


def readings(reel: Reel, effort_N: ArrayLike, preload_N: float = 15.0) -> tuple[Any, Any]:
    """Symbols of the reel's parameters, and what it reads under an effort as an expression."""
    start, sample = _sample(reel.structure, reel.delay_samples)
    p, effort = ca.MX.sym("p", reel.parameter_values.size), np.asarray(effort_N)[None]
    constants, state, _ = start(p, preload_N)
    run = sample.mapaccum(effort.size)
    _, seen = run(state, ca.repmat(constants, 1, effort.size), effort)
    return p, ca.vertcat(seen[0, :].T, 100.0 * seen[2, :].T)  # 0.01 rad counts as much as 1 N


def wander(samples: int, low: float, high: float, seed: int = 1) -> FloatArray:
    """An effort that wanders smoothly between two values, shape (samples,)."""
    steps = np.convolve(np.random.default_rng(seed).normal(size=samples + 24), np.hanning(24))
    steps = steps[24 : samples + 24]
    found: FloatArray = low + (high - low) * (steps - steps.min()) / np.ptp(steps)
    return found
