"""Errors of fitted values: coloured residuals, groups that alone determine a value, laws."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from plants.diagnosis.models.free_parameters import from_zero, positive, prior_deviation
from plants.diagnosis.search.intervals import greatest_shifts, intervals, jackknife
from plants.effects.viscous_damping import ViscousDamping

GROUPS, EACH = 40, 50


def test_jackknife_error_covers_the_spread_of_coloured_residuals():
    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(GROUPS), EACH)
    columns = np.stack([np.ones(group.size), np.sin(0.01 * np.arange(group.size))])
    normal = columns @ columns.T
    found, stated = [], []
    for _ in range(200):
        residuals = np.repeat(rng.standard_normal(GROUPS), EACH)  # one error a group
        found.append(np.linalg.solve(normal, columns @ residuals))
        left = residuals - found[-1] @ columns
        stated.append(jackknife(columns, left, group))
    assert np.mean(stated, axis=0) == pytest.approx(np.std(found, axis=0), rel=0.15)


def test_group_that_alone_determines_a_value_leaves_it_to_the_prior():
    group = np.repeat(np.arange(GROUPS), EACH)
    alone = np.where(group == 3, 100.0, 0.0)
    columns = np.stack([np.ones(group.size), alone])
    residuals = np.random.default_rng(2).standard_normal(group.size)
    assert jackknife(columns, residuals, group)[1] > 0.5


def test_single_group_says_nothing():
    assert jackknife(np.ones((1, 10)), np.ones(10), np.zeros(10, np.int64)) == pytest.approx([0.0])


def test_error_of_a_law_shifts_a_value_the_most_along_its_own_direction():
    rng = np.random.default_rng(3)
    columns = 10.0 * rng.standard_normal((3, 200)) + 30.0  # which are nearly alike
    own = columns.T @ np.linalg.inv(columns @ columns.T)[:, 0]
    errors = np.stack([own, *rng.standard_normal((20, 200))])
    errors /= np.linalg.norm(errors, axis=1)[:, None]
    shifted = np.abs(np.linalg.lstsq(columns.T, errors.T, rcond=None)[0][0])
    assert shifted[0] == pytest.approx(greatest_shifts(columns)[0], rel=1e-3)
    assert shifted[1:].max() < shifted[0]


def test_records_count_by_what_they_show_of_a_value():
    rng, shown = np.random.default_rng(4), np.array([1.0, 0.2, 0.05])
    group = np.repeat(np.arange(3), EACH)
    columns = np.stack([np.ones(group.size), 30.0 * shown[group]])
    normal = columns @ columns.T
    found, stated = [], []
    for _ in range(400):
        residuals = rng.standard_normal(group.size)
        found.append(np.linalg.solve(normal, columns @ residuals))
        left = residuals - found[-1] @ columns
        stated.append([jackknife(columns, left, group, unequal=kind)[1] for kind in (True, False)])
    by_share, alike = np.sqrt(np.mean(np.square(stated), axis=0))
    assert by_share == pytest.approx(np.std(found, axis=0)[1], rel=0.3)
    assert alike > 2.0 * by_share


def test_groups_that_know_nothing_of_a_value_do_not_narrow_its_interval():
    residuals = np.random.default_rng(4).standard_normal(1200)
    group = np.repeat(np.arange(12), 100)
    columns = np.where(group < 4, 10.0, 0.0)[np.newaxis]
    knowing = group < 4
    alone = jackknife(columns[:, knowing], residuals[knowing], group[knowing], unequal=True)
    assert jackknife(columns, residuals, group, unequal=True) == pytest.approx(alone, rel=1e-3)


FRICTION = positive("viscous_friction_Nms", "N m s/rad", 0.02)
ADDED = from_zero("viscous_damping.damping_Nms", "N m s/rad", 0.01, 1.0)
ADDED = replace(ADDED, owner="viscous_damping", neutral=0.0)
FREE = (positive("drum_inertia_kg_m2", "kg m2", 2e-3), FRICTION, ADDED)
VALUES = np.array([2e-3, 0.02, 0.01])
GROUP = np.repeat(np.arange(GROUPS), EACH)


def of_slopes(slopes, residuals, channels=()):
    """A fitter and a fit whose residuals are straight along the values."""
    fitted = SimpleNamespace(
        predictor=SimpleNamespace(
            free=FREE,
            index=SimpleNamespace(measurement=GROUP),
            linearise=lambda _values, moves, *_: (residuals, slopes[:, moves]),
        ),
        values=VALUES,
        entries=np.arange(GROUP.size),
        residuals=residuals,
    )
    fitter = SimpleNamespace(
        moves=lambda _: np.arange(3),
        model=SimpleNamespace(model=None),
        group=GROUP,
        floor=SimpleNamespace(channels=dict.fromkeys(channels)),
    )
    return fitter, fitted


def test_number_that_an_effect_corrects_has_no_interval_beside_the_effects():
    rng = np.random.default_rng(5)
    fitter, fitted = of_slopes(
        rng.standard_normal((GROUP.size, 3)), rng.standard_normal(GROUP.size)
    )
    base, damped = (
        SimpleNamespace(effects=e, fitted=fitted, J=1.0) for e in ((), (ViscousDamping,))
    )
    assert set(intervals(fitter, damped, base)) == {"drum_inertia_kg_m2", ADDED.name}
    assert FRICTION.name in intervals(fitter, base, base)


@pytest.mark.parametrize("channels", [(), ("tension_N",)])
@pytest.mark.parametrize(
    ("effects", "left"), [((), (1.0, 1.0)), ((), (3.0, 3.0)), ((ViscousDamping,), (5.0, 1.5))]
)
def test_error_of_a_value_is_that_of_noise_of_laws_and_of_what_nothing_explains(
    effects, left, channels
):
    rng, prior = np.random.default_rng(6), np.array([2e-3, 0.02, 0.01])
    slopes = rng.standard_normal((GROUP.size, 3)) * [3e4, 3e3, 2e3]
    residuals = np.repeat(rng.standard_normal(GROUPS), EACH)  # coloured
    fitter, fitted = of_slopes(slopes, residuals, channels)
    base, model = (
        SimpleNamespace(effects=of, fitted=fitted, J=J)
        for of, J in zip(((), effects), left, strict=True)
    )
    told = intervals(fitter, model, base)
    kept = [0, 2] if effects else [0, 1, 2]
    prior = np.array([prior_deviation(FREE[n], VALUES[n]) for n in kept])
    columns = slopes[:, kept].T * prior[:, None]
    of_noise = prior * np.maximum(
        jackknife(columns, residuals, GROUP), jackknife(columns, residuals, GROUP, unequal=True)
    )
    explained, unexplained = np.sqrt(
        np.maximum([left[0] - left[1], left[1] - 1.0], 0.0) * GROUP.size
    )
    by_length = prior * greatest_shifts(columns)
    for n, noise, unit, shift in zip(kept, of_noise, prior, by_length, strict=True):
        is_base = FREE[n] is not ADDED
        most = unit if is_base else VALUES[n]
        of_law = 0.001 * min(explained * shift, most) if effects else 0.0
        if not (effects or is_base):  # of an effect that the model declares
            of_law = 0.001 * VALUES[n]
        of_rest = min((0.2 if effects else 0.5) * unexplained * shift, most)
        calibrated = (0.001 if channels else 0.0003) * VALUES[n] if is_base else 0.0
        at = told[FREE[n].name]
        half = 1.96 * np.sqrt(noise**2 + of_law**2 + of_rest**2 + calibrated**2)
        if FREE[n].scale == "log":
            expected = VALUES[n] * np.exp(np.array([-1.0, 1.0]) * half / VALUES[n])
        else:
            expected = [max(VALUES[n] - half, FREE[n].low), min(VALUES[n] + half, FREE[n].high)]
        assert (at.low, at.high) == pytest.approx(expected), FREE[n].name


def test_prior_deviation_is_relative_on_a_log_scale_and_absolute_on_a_linear_one():
    inertia, friction = positive("inertia", "kg m^2", 2.0), from_zero("friction", "N m", 2.0, 5.0)
    assert [prior_deviation(inertia, value) for value in (0.1, 3.0)] == [0.1, 3.0]
    assert [prior_deviation(friction, value) for value in (0.1, 3.0)] == [2.0, 3.0]
