"""Reels with effects, run in CasADi's virtual machine: nothing is compiled."""

from dataclasses import fields
from functools import lru_cache
from types import SimpleNamespace
from typing import NamedTuple

import casadi as ca
import numpy as np

import plants
from estune.core import pidf
from estune.core.gains import Gains
from estune.trial.profiles import StepProfile
from plants.effects import Port, Site
from plants.models.reel_equations import cable_stiffness_N_m
from plants.simulation.trial_loop import Batch, VirtualLoop, loop_functions

REEL = plants.reference_reel(gauge_noise_N=0.0)
RATE = REEL.sampling_Hz
SUBSTEP_s = 0.25 / RATE
GAINS = Gains(1.0, 40.0, 0.015, 0.004)
UP = StepProfile(15.0, 20.0, 0.05, 0.3)
DOWN = StepProfile(15.0, -14.5, 0.05, 0.3)  # through slack


@lru_cache(maxsize=128)
def _loop(structure):
    return VirtualLoop(loop_functions(structure.equations()))


def trial(reel, profile=UP, gains=GAINS):
    """The columns of one closed-loop trial that ends only where it is not finite."""
    batch = Batch(
        reel.parameter_values,
        np.array([pidf.coefficients(reel.controller, gains)]),
        profile.preload_N,
        profile.setpoint(reel.sampling_Hz),
        None,
        reel.delay_samples,
        np.finfo(float).max,
    )
    return _loop(reel.structure).run(batch).trial(0)


class Rollout(NamedTuple):
    """What a reel did under an effort: columns by sample, and the current in force."""

    tension: np.ndarray  # as read
    outside: np.ndarray  # as read, where there is no gauge outside
    theta: np.ndarray
    omega: np.ndarray
    current: np.ndarray


@lru_cache(maxsize=128)
def _sample(structure, delay):
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


def rest(reel, preload=15.0):
    """State (angle first) and effort of the settled reel."""
    start, _ = _sample(reel.structure, reel.delay_samples)
    _, state, effort = start(reel.parameter_values, preload)
    return np.asarray(state).ravel(), float(effort)


def rollout(reel, effort, preload=15.0):
    """The reel under an effort, from rest."""
    start, sample = _sample(reel.structure, reel.delay_samples)
    constants, state, _ = start(reel.parameter_values, preload)
    run = sample.mapaccum(len(effort))
    _, seen = run(state, ca.repmat(constants, 1, len(effort)), np.asarray(effort)[None])
    return Rollout(*np.asarray(seen))


def readings(reel, effort, preload=15.0):
    """Tension read as a CasADi function of the reel's parameters."""
    start, sample = _sample(reel.structure, reel.delay_samples)
    p = ca.MX.sym("p", reel.parameter_values.size)
    constants, state, _ = start(p, preload)
    run = sample.mapaccum(len(effort))
    _, seen = run(state, ca.repmat(constants, 1, len(effort)), np.asarray(effort)[None])
    return p, ca.vertcat(seen[0, :].T, 100.0 * seen[2, :].T)  # 0.01 rad counts as much as 1 N


class Law:
    """One effect's law by itself, in numbers: what goes in is imposed."""

    def __init__(self, effect, reel=REEL, preload=15.0):
        attributes = {f.name: getattr(reel, f.name) for f in fields(reel)}
        self.reel = SimpleNamespace(
            **attributes,
            preload_N=preload,
            stiffness_N_m=cable_stiffness_N_m(reel, preload),
            gravity_m_s2=9.80665,
            sample_s=1.0 / RATE,
            substep_s=SUBSTEP_s,
            torque_per_velocity=1e6,  # a drum that nothing slows
        )
        self.effect = effect
        self.p = SimpleNamespace(**vars(effect), **effect.prepare(self._own(), self.reel))
        self.state = ca.DM.zeros(effect.states)

    def _own(self):
        return SimpleNamespace(**vars(self.effect))

    def site(self, velocity=0.0, angle=0.0, tension=0.0, port=None):
        port = port or self.effect.port
        often = port in (Port.DRUM, Port.CABLE, Port.EYELET)
        span = SUBSTEP_s if often else 1.0 / RATE
        mass = self.reel.torque_per_velocity
        return Site(port, span, angle, velocity, velocity, tension, mass)

    def settle(self, signal, **site):
        """The signal that has to go in for this one to come out steadily."""
        self.state, inside = self.effect.rest(self.p, self.state, signal, self.site(**site))
        return float(inside)

    def pass_(self, signal, **site):
        """The signal after one visit."""
        self.state, out = self.effect.respond(self.p, self.state, signal, self.site(**site))
        return float(out)


def wander(samples, low, high, seed=1):
    """An effort that wanders smoothly between two values."""
    steps = np.convolve(np.random.default_rng(seed).normal(size=samples + 24), np.hanning(24))
    steps = steps[24 : samples + 24]
    return low + (high - low) * (steps - steps.min()) / np.ptp(steps)
