"""Joints of an integrator of its own: a loop that follows two sines, with laws of friction."""

from typing import NamedTuple

import numpy as np

import plants
from plants.diagnosis.data.measured_record import MeasuredRecord

INERTIA, VISCOUS = 2e-3, 4e-3
RATE_Hz, MODE_Hz = 200, 6.0


class Joint(NamedTuple):
    """What a joint has beside its inertia and viscous friction.

    Attributes:
        dry: Dry friction, N m.
        share: Share of the torque that its gear loses.
        weight: Weight of its link, N m.
        unlike: Friction that differs by direction, N m s/rad.
        cogging: Torque of seven waves a turn, N m.
        warming: Share of the viscous friction that is gone at the end.
        elastic: 1 where two fifths of the inertia are behind a spring, else 0.
    """

    dry: float = 0.0
    share: float = 0.0
    weight: float = 0.0
    unlike: float = 0.0
    cogging: float = 0.0
    warming: float = 0.0
    elastic: float = 0.0


def turned(joints, sweep_rad=0.0):
    """Angle and torque of each joint, 20 s; a sweep may be added."""
    dry, share, weight, unlike, cogging, warming, elastic = np.array(list(joints)).T
    substeps, t = 20, np.arange(20 * RATE_Hz) / RATE_Hz
    wanted = 1.2 * np.sin(1.1 * t) + 0.5 * np.sin(3.1 * t + 1.0)
    wanted += sweep_rad * np.sin(2.0 * np.pi * (1.0 + 0.3 * t) * t)
    wanted_rate = np.gradient(wanted, t)
    h = 1.0 / (RATE_Hz * substeps)
    near, far = INERTIA * (1.0 - 0.4 * elastic), 0.4 * INERTIA
    w = 2.0 * np.pi * MODE_Hz
    q, v = np.full(len(dry), wanted[0]), np.zeros(len(dry))
    behind, moving = q, v
    angle, torque = np.empty((2, t.size, len(dry)))
    for k in range(t.size):
        held = 1.0 * (wanted[k] - q) + 0.06 * (wanted_rate[k] - v)
        angle[k], torque[k] = q, held
        friction = dry + share * np.abs(held)
        viscous = VISCOUS * (1.0 - warming * k / t.size)
        for _ in range(substeps):
            spring = elastic * far * (w**2 * (behind - q) + 0.02 * w * (moving - v))
            smooth = held - viscous * v - weight * np.sin(q) - 0.5 * unlike * np.abs(v)
            free = v + h * (smooth + spring - cogging * np.sin(7.0 * q + 0.4)) / near
            v = np.sign(free) * np.maximum(np.abs(free) - h * friction / near, 0.0)
            q = q + h * v
            moving = moving - h * spring / far
            behind = behind + h * moving
    return [(angle[:, n], torque[:, n]) for n in range(len(dry))]


def record(joint, bits, every=1):
    """Each of a few samples of a joint, its angle as an encoder reads it, and a model of it."""
    angle, torque = joint
    step = 2.0 * np.pi / 2**bits
    whole = torque.size // every * every
    m = MeasuredRecord(
        name="joint",
        rig="arm",
        sampling_Hz=RATE_Hz / every,
        loop="closed",
        time_s=np.arange(whole // every) * every / RATE_Hz,
        current_A=torque[:whole].reshape(-1, every).mean(axis=1),
        angle_rad=np.round(angle[:whole:every] / step) * step,
    )
    # As owners know their machines: the inertia by a tenth, the friction by a third.
    return m, plants.servo(1.1 * INERTIA, 0.7 * VISCOUS, sampling_Hz=m.sampling_Hz)
