"""Laws that the balance of torques names on joints of an integrator of its own."""

import numpy as np
import pytest

import plants
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.torque_balance.agreement import agreement
from plants.diagnosis.torque_balance.balance import torque_balance
from plants.diagnosis.torque_balance.judge import judge
from plants.effects import (
    CoulombFriction,
    DeadTime,
    DirectionalFriction,
    LinkGravity,
    LoadFriction,
    StribeckFriction,
)

LAWS = (CoulombFriction, DirectionalFriction, LinkGravity, LoadFriction, StribeckFriction)
INERTIA, VISCOUS = 2e-3, 4e-3
KINDS = {
    "complete": (0.0, 0.0, 0.0, 0.0),
    "coulomb": (6e-3, 0.0, 0.0, 0.0),
    "load": (0.0, 0.3, 0.02, 0.0),
    "directional": (0.0, 0.0, 0.0, 4e-3),
}
"""Dry friction, N m; load share; weight of the link, N m; directional friction, N m s/rad."""
NAMED = {
    "complete": set(),
    "coulomb": {"coulomb_friction"},
    "load": {"link_gravity", "load_friction"},
    "directional": {"directional_friction"},
}
TRUTH = {"coulomb_friction.torque_Nm": 6e-3, "load_friction.load_share": 0.3}


@pytest.fixture(scope="module")
def joints():
    """Angle and torque of a joint of each kind at 200 Hz, 20 s, a loop that follows two sines."""
    dry, share, weight, unlike = np.array(list(KINDS.values())).T
    rate, substeps, t = 200, 20, np.arange(4000) / 200.0
    wanted = 1.2 * np.sin(1.1 * t) + 0.5 * np.sin(3.1 * t + 1.0)
    wanted_rate = np.gradient(wanted, t)
    h = 1.0 / (rate * substeps)
    q, v = np.full(len(dry), wanted[0]), np.zeros(len(dry))
    angle, torque = np.empty((2, t.size, len(dry)))
    for k in range(t.size):
        held = 1.0 * (wanted[k] - q) + 0.06 * (wanted_rate[k] - v)
        angle[k], torque[k] = q, held
        friction = dry + share * np.abs(held)
        for _ in range(substeps):
            smooth = held - VISCOUS * v - weight * np.sin(q) - 0.5 * unlike * np.abs(v)
            free = v + h * smooth / INERTIA
            v = np.sign(free) * np.maximum(np.abs(free) - h * friction / INERTIA, 0.0)
            q = q + h * v
    return {kind: (angle[:, n], torque[:, n]) for n, kind in enumerate(KINDS)}


def judged(joint, bits, every, declared=()):
    angle, torque = joint
    step = 2.0 * np.pi / 2**bits
    whole = torque.size // every * every
    m = MeasuredRecord(
        name="joint",
        rig="arm",
        sampling_Hz=200.0 / every,
        loop="closed",
        time_s=np.arange(whole // every) * every / 200.0,
        current_A=torque[:whole].reshape(-1, every).mean(axis=1),
        angle_rad=np.round(angle[:whole:every] / step) * step,
    )
    # As owners know their machines: the inertia by a tenth, the friction by a third.
    model = plants.servo(1.1 * INERTIA, 0.7 * VISCOUS, sampling_Hz=m.sampling_Hz)
    balance = torque_balance([m], [BaseNumbers.of(model, m)], step / np.sqrt(12.0))
    return judge(balance, LAWS, declared)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("bits", "every"), [(10, 1), (10, 8), (16, 4)])
def test_laws_of_a_joint_are_named_whatever_the_rate_and_the_encoder(joints, kind, bits, every):
    said = judged(joints[kind], bits, every)
    assert {e.name for e in said.effects} == NAMED[kind]
    for name, value in said.values.items():
        if name in TRUTH:
            assert value.value == pytest.approx(TRUTH[name], rel=0.1)


def test_a_law_that_the_model_declares_changes_no_other(joints):
    alone, beside = (judged(joints["load"], 14, 1, declared) for declared in ((), (LinkGravity,)))
    assert [e.name for e in beside.effects] == ["load_friction"]
    share = "load_friction.load_share"
    assert beside.values[share].value == pytest.approx(alone.values[share].value, rel=1e-6)


@pytest.mark.parametrize(
    ("verdict", "believed", "tied", "weight"),
    [
        ("unknown", (), (), "balance"),
        ("none", (), (), "balance"),
        ("named", (CoulombFriction,), (), "both"),
        ("named", (StribeckFriction,), (), "both"),  # the family is the same
        ("named", (DeadTime,), (), "silent"),  # complete, and nothing that a balance could see
        ("named", (DirectionalFriction,), (), "contradiction"),
        ("ambiguous", (LoadFriction,), ("load_friction", "coulomb_friction"), "tie"),
    ],
)
def test_two_judges_agree_or_contradict_each_other(joints, verdict, believed, tied, weight):
    said = judged(joints["coulomb"], 14, 1)
    assert agreement(verdict, believed, tied, frozenset(), said).weight == weight
