"""Other units and another clock change nothing of a diagnosis but the units of its numbers."""

import math

import numpy as np
import pytest

import plants
from plants.conformance.effect import SHOWN
from plants.diagnosis.search.nameless_laws import NAMELESS
from plants.effects import EFFECTS
from plants.effects.parameter import ABOVE_ZERO
from tests.support_scaling import MACHINES, SCALINGS, Scaling, first_order, scaled_scale

ALL_AT_ONCE, UNSCALED = SCALINGS[-1], Scaling()


@pytest.mark.parametrize(
    "effect", [e for e in (*EFFECTS.values(), *NAMELESS) if not e.in_noise and not e.in_torque]
)
def test_bounds_of_a_fit_are_scaled_with_the_machine(effect):
    # Weight does not change with the clock: lengths go by the square of the time.
    s = Scaling(time=7.0, force=0.3, length=49.0, angle=20.0)
    others = scaled_scale(SHOWN, s)
    for name, p in effect.parameters().items():
        unit = "" if p.is_phase else p.unit
        factor = s.factor(unit, p.role)
        here, there = effect.range(name, SHOWN), effect.range(name, others)
        assert there == pytest.approx(np.multiply(factor, here), rel=1e-9), name
        if unit:  # of a number with a unit nature states its sign alone
            assert p.high == math.inf
            assert p.low in (-math.inf, ABOVE_ZERO, 0.0)


def diagnosed(machine):
    d = plants.explain(machine.model, machine.records)
    numbers = {
        f"{e.name}.{n}": (at, e.effect.parameters()[n])
        for e in d.effects
        for n, at in e.parameters.items()
    }
    return d, numbers


def check_like(d, numbers, machine, s=UNSCALED, rel=3e-3):
    """Compares a diagnosis with that of a machine in other units."""
    other, there = diagnosed(machine)
    assert other.verdict == d.verdict
    assert [e.name for e in other.effects] == [e.name for e in d.effects], s
    assert other.before.ratio == pytest.approx(d.before.ratio, rel=rel)
    assert other.after.ratio == pytest.approx(d.after.ratio, rel=rel)
    for name, (at, p) in numbers.items():
        factor = s.factor("" if p.is_phase else p.unit, p.role)
        off = abs(there[name][0].value / factor - at.value)
        assert off <= 0.1 * (at.high - at.low), (s, name)


def check_same(hidden, scalings):
    machine = MACHINES[hidden]()
    d, numbers = diagnosed(machine)
    assert [effect.name for effect in d.effects] == [hidden]
    for s in scalings:
        check_like(d, numbers, machine.scaled(s), s)


@pytest.mark.parametrize("hidden", ["dead_time", "torque_ripple", "cable_creep"])
def test_verdict_names_and_numbers_are_the_same_in_other_units(hidden):
    check_same(hidden, [ALL_AT_ONCE])


@pytest.mark.slow
@pytest.mark.parametrize("hidden", MACHINES)
def test_verdict_names_and_numbers_are_the_same_in_each_of_six_other_units(hidden):
    check_same(hidden, SCALINGS)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", MACHINES)
def test_verdict_names_and_numbers_are_the_same_with_other_rounding_and_order(hidden):
    machine = MACHINES[hidden]()
    d, numbers = diagnosed(machine)
    check_like(d, numbers, machine.rounded_otherwise())
    # A phase is told at the zero of the first record's encoder.
    numbers = {name: at for name, at in numbers.items() if not at[1].is_phase}
    # Of the first record another third is left out than of the second.
    check_like(d, numbers, machine._replace(records=machine.records[::-1]), rel=0.05)


@pytest.mark.slow
def test_delays_and_lags_are_told_apart_at_any_time_constant():
    right = {"dead_time": 0, "current_lag": 0}
    times = np.geomspace(0.2, 200.0, 20).tolist()
    delays = np.geomspace(0.05, 3.0, 20).tolist()  # from a sample to three time constants
    lags = np.geomspace(0.08, 0.7, 20).tolist()
    for n, time_s in enumerate(times):
        delay, lag = delays[7 * n % 20], lags[7 * n % 20]
        cases = {
            "dead_time": first_order(time_s / delay, delay_s=time_s, seed=n + 10),
            "current_lag": first_order(time_s / lag, lag_s=time_s, seed=n + 10),
        }
        for hidden, machine in cases.items():
            d, _ = diagnosed(machine)
            right[hidden] += [effect.name for effect in d.effects] == [hidden]
    assert min(right.values()) >= 19
