"""Laws that the balance of torques names on joints of an integrator of its own."""

from dataclasses import replace

import numpy as np
import pytest

from plants.diagnosis.data.noise_floor import Noise
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
from tests.support_joints import Joint, record, turned

LAWS = (CoulombFriction, DirectionalFriction, LinkGravity, LoadFriction, StribeckFriction)
KINDS = {
    "complete": Joint(),
    "coulomb": Joint(dry=6e-3),
    "load": Joint(share=0.3, weight=0.02),
    "directional": Joint(unlike=4e-3),
}
NAMED = {
    "complete": set(),
    "coulomb": {"coulomb_friction"},
    "load": {"link_gravity", "load_friction"},
    "directional": {"directional_friction"},
}
TRUTH = {"coulomb_friction.torque_Nm": 6e-3, "load_friction.load_share": 0.3}


@pytest.fixture(scope="module")
def joints():
    """Angle and torque of a joint of each kind."""
    return dict(zip(KINDS, turned(KINDS.values()), strict=True))


def balance_of(joint, bits, every):
    m, model = record(joint, bits, every)
    step = 2.0 * np.pi / 2**bits
    encoder = Noise(step / np.sqrt(12.0), step, "steps")
    return torque_balance([m], [BaseNumbers.of(model, m)], encoder)


def judged(joint, bits, every, declared=()):
    return judge(balance_of(joint, bits, every), LAWS, declared)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("bits", "every"), [(10, 1), (10, 8), (16, 4)])
def test_laws_of_a_joint_are_named_whatever_the_rate_and_the_encoder(joints, kind, bits, every):
    said = judged(joints[kind], bits, every)
    assert {e.name for e in said.effects} == NAMED[kind]
    for name, value in said.values.items():
        if name in TRUTH:
            assert value.value == pytest.approx(TRUTH[name], rel=0.1)


def test_a_law_that_a_balance_could_see_is_denied_where_it_is_not_there(joints):
    def denied(kind, share):
        balance = balance_of(joints[kind], 14, 1)
        said = judge(balance, (CoulombFriction, LinkGravity), ())
        return said.denies(balance, LoadFriction, {"load_friction.load_share": share})

    assert denied("coulomb", 0.2)
    assert not denied("coulomb", 1e-4)  # too small to be seen
    assert not denied("load", 0.3)


def test_balance_of_records_of_unlike_rates_is_of_those_longer_than_its_kernel(joints):
    m, model = record(joints["coulomb"], 14)
    both = [replace(m, sampling_Hz=5e5, time_s=m.time_s * 4e-4), m]
    numbers = [BaseNumbers.of(model, one) for one in both]
    balance = torque_balance(both, numbers, Noise(1e-4, 0.0, "steps"))
    assert balance is not None
    assert np.isfinite(balance.torque_Nm).all()


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
