"""Errors of fitted values: coloured residuals, groups that alone determine a value, laws."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import plants
from plants.diagnosis.models.free_parameters import Free, from_zero, positive, prior_deviation
from plants.diagnosis.search.intervals import FIRST_ZERO, greatest_shifts, intervals, jackknife
from plants.effects import Backlash, Cogging, CoulombFriction, Quantisation, ViscousDamping

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


class Machine:
    """Residuals that are a function of the values; by default straight along them."""

    def __init__(self, slopes, residuals, free=FREE, values=VALUES, *, law=None, drum=None):
        self.free, self.values, self.over = free, np.array(values), []
        self.index = SimpleNamespace(measurement=GROUP)
        self.slopes, self.drum = slopes, drum
        self.law = law or (lambda by: residuals + slopes @ by)

    def residuals(self, rows, _entries):
        return np.array([self.law(row - self.values) for row in rows])

    def linearise(self, values, moves, entries, residuals, over):
        self.over.append(over)
        over = np.maximum(over, 1e-6 * np.maximum(np.abs(values[moves]), 1e-3))
        rows = values + np.eye(values.size)[moves] * over[:, None]
        return residuals, ((self.residuals(rows, entries) - residuals) / over[:, None]).T

    def intervals(self, effects=(), left=(1.0, 1.0), channels=(), **options):
        first = self.law(np.zeros(self.values.size))
        fitted = SimpleNamespace(
            predictor=self, values=self.values, entries=np.arange(GROUP.size), residuals=first
        )
        fitter = SimpleNamespace(
            moves=lambda _: np.arange(len(self.free)),
            model=SimpleNamespace(model=self.drum),
            group=GROUP,
            floor=SimpleNamespace(channels=dict.fromkeys(channels)),
        )
        base, model = (
            SimpleNamespace(effects=of, fitted=fitted, J=J)
            for of, J in zip(((), effects), left, strict=True)
        )
        return intervals(fitter, model, base, **options)


def test_number_that_an_effect_corrects_has_no_interval_beside_the_effects():
    rng = np.random.default_rng(5)
    machine = Machine(rng.standard_normal((GROUP.size, 3)), rng.standard_normal(GROUP.size))
    assert set(machine.intervals((ViscousDamping,))) == {"drum_inertia_kg_m2", ADDED.name}
    assert FRICTION.name in machine.intervals()


@pytest.mark.parametrize("channels", [(), ("tension_N",)])
@pytest.mark.parametrize(
    ("effects", "left"),
    [
        ((), (1.0, 1.0)),
        ((), (3.0, 3.0)),
        ((ViscousDamping,), (5.0, 1.5)),
        ((ViscousDamping,), (0.8, 0.9)),  # more than without it, and less than the noise
    ],
)
def test_error_of_a_value_is_that_of_noise_of_laws_and_of_what_nothing_explains(
    effects, left, channels
):
    rng = np.random.default_rng(6)
    slopes = rng.standard_normal((GROUP.size, 3)) * [3e4, 3e3, 2e3]
    residuals = np.repeat(rng.standard_normal(GROUPS), EACH)  # coloured
    told = Machine(slopes, residuals).intervals(effects, left, channels)
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


def of_effect(effect, name, value, low, high, **fields):
    slug = effect.name
    return Free(f"{slug}.{name}", "", value, low, high, "linear", slug, **fields)


def unlike(number, seed=7):
    """Slopes that have nothing in common with each other, nor with the residuals beside them."""
    columns = np.random.default_rng(seed).standard_normal((GROUP.size, number + 1))
    columns, _ = np.linalg.qr(columns)
    return columns[:, :-1], 30.0 * columns[:, -1]


def test_differences_begin_with_a_tenth_and_are_then_as_large_as_errors():
    slopes, residuals = unlike(2)
    free = (FRICTION, of_effect(Quantisation, "step_N", 5.0, 0.0, 1e3, neutral=0.0))
    for steep, expected in ((1e4, (None, 0.03)), (1.0, (0.1, 0.1))):
        known = steep * slopes / [0.02, 5.0]
        machine = Machine(known, residuals, free, (0.02, 5.0))
        at = machine.intervals((Quantisation,))
        first, *_, last = np.array(machine.over) / [0.02, 5.0]
        assert first == pytest.approx([0.1, 0.1])
        error = 30.0 / steep  # at the most: of a residual that were along the value
        assert last[1] == pytest.approx(expected[1])
        if expected[0] is not None:
            assert last[0] == pytest.approx(expected[0])
        else:
            noise = np.sqrt((last[0] * 0.02) ** 2 + (0.0003 * 0.02) ** 2)
            half = 0.5 * np.log(at[FRICTION.name].high / at[FRICTION.name].low)
            assert half == pytest.approx(1.96 * noise / 0.02, rel=1e-3)
            assert 0.0 < last[0] < error


def test_error_over_leaps_is_that_of_the_slope_across_them():
    """Residuals that go up in stairs, some in a standard error."""
    slopes, residuals = unlike(1)
    noisy = residuals + np.repeat(np.random.default_rng(9).standard_normal(GROUPS), EACH)

    def leaping(by):
        return noisy + 1e5 * slopes @ (np.floor(by / 1e-6 + 0.5) * 1e-6)

    straight, stairs = (
        Machine(1e5 * slopes, noisy, (FRICTION,), (0.02,), law=law).intervals()[FRICTION.name]
        for law in (None, leaping)
    )
    assert (stairs.high - stairs.low) == pytest.approx(straight.high - straight.low, rel=0.1)


@pytest.mark.parametrize("drum", [None, plants.reference_reel()])
def test_phase_along_a_drive_is_told_at_the_first_zero_and_of_a_reel_where_it_is_taut(drum):
    """The zero and the phase shift a wave alike."""
    slopes, residuals = unlike(1)
    zero = Free(FIRST_ZERO, "rad", 0.0, -1.0, 1.0, "linear", "record 0")
    phase = of_effect(Cogging, "phase_rad", 1.0, -9.0, 9.0)
    alike = 1e4 * slopes @ np.ones((1, 2))
    noisy = residuals + 3e3 * slopes[:, 0] * np.where(GROUP % 2, 1.0, -1.0)
    told = Machine(alike, noisy, (zero, phase), (0.0, 1.0), drum=drum).intervals((Cogging,))
    assert set(told) == {phase.name}
    assert (told[phase.name].high < 1.1) == (drum is None)


def test_value_of_a_single_record_widens_what_is_alike_and_is_not_told():
    slopes, residuals = unlike(2)
    offset = Free("torque_offset_Nm[1]", "N m", 0.0, -1.0, 1.0, "linear", "record 1")
    halves = []
    for shared in (0.0, 0.999):
        mixed = 1e4 * slopes @ np.array([[1.0, shared], [0.0, np.sqrt(1.0 - shared**2)]])
        noisy = residuals + 30.0 * np.random.default_rng(8).standard_normal(GROUP.size)
        told = Machine(mixed, noisy, (FRICTION, offset), (0.02, 0.0)).intervals()
        assert set(told) == {FRICTION.name}
        halves.append(np.log(told[FRICTION.name].high / 0.02))
    assert halves[1] > 10.0 * halves[0]


TORQUE = of_effect(CoulombFriction, "torque_Nm", 0.0, 0.0, 1.0, neutral=0.0)


PLACES = np.geomspace(1e-6, 1.0, 24)
"""Where between a fit and a bound the sum of squares is looked at."""


def bent(bend, straight=(), residuals=None, **options):
    """The greatest torques told going along and by its derivative, of residuals in its square.

    The other values, straight, are all 1 and have a unit of 1.
    """
    names = ("drum_inertia_kg_m2", "viscous_friction_Nms")[: len(straight)]
    free = (*(positive(name, "", 1.0) for name in names), TORQUE)

    def law(by):
        return residuals + sum(v * x for v, x in zip(straight, by, strict=False)) + bend(by)

    machine = Machine(None, None, free, (*(1.0 for _ in names), 0.0), law=law)
    told = [machine.intervals((CoulombFriction,), along=a, **options) for a in (True, False)]
    return [each[TORQUE.name].high for each in told]


@pytest.mark.parametrize("left", [(1.0, 1.0), (9.0, 3.0), (1e6, 1.0)])
def test_value_at_a_bound_is_told_to_where_the_squares_have_grown_as_at_the_ends_of_others(left):
    """1.96^2 (c^2 + l^2); a part of the bend is as another value changes residuals."""
    slopes, residuals = unlike(3)
    inertia, friction, own = 1e3 * slopes.T
    residuals = residuals + 0.3 * np.repeat(np.random.default_rng(9).standard_normal(GROUPS), EACH)
    residuals -= slopes @ (slopes.T @ residuals)  # a fit leaves nothing along its values
    columns = np.stack([inertia, friction, 1e-6 * (inertia + own)])  # next to nothing
    noise = [jackknife(columns, residuals, GROUP, unequal=unequal) for unequal in (True, False)]
    colour = np.median((np.max(noise, axis=0) / greatest_shifts(columns)) ** 2)
    by_form = [1e-6, 0.04] @ np.array([left[0] - left[1], left[1] - 1.0]) * GROUP.size
    exact = (1.96 * np.sqrt(colour + by_form) / 1e3) ** 0.5
    for share, last in ((0.99, 15), (1.01, 14)):
        # With the others at their best the squares reach their limit at such a share of a place.
        stretch = exact / (PLACES[15] / share)

        def bend(by, stretch=stretch):
            return (inertia + own) * (by[-1] * stretch) ** 2

        along, straight = bent(bend, (inertia, friction), residuals, left=left)
        assert along == pytest.approx(PLACES[last])
        assert straight < 0.5 * along


def test_value_is_told_that_the_records_allow_while_the_others_stay():
    """They leave too much where they follow: residuals leap when another one moves."""
    slopes, residuals = unlike(2)
    inertia, own = 1e3 * slopes.T

    def smooth(by):
        return (10.0 * inertia + own) * by[-1] ** 2

    def leaping(by):
        return smooth(by) + 1e6 * own * (abs(by[0]) > 1e-3)

    stays, follows = (
        bent(law, (inertia,), residuals, left=(9.0, 3.0))[0] for law in (leaping, smooth)
    )
    assert PLACES[15] < stays < follows


def spans(free, values, effects, left, **options):
    """Widths of the intervals of values that the records do not show, at a noise of nothing."""
    slopes, residuals = unlike(len(free))
    told = Machine(1e-9 * slopes, 1e-9 * residuals, free, values).intervals(
        effects, left, **options
    )
    return [told[f.name].high - told[f.name].low for f in free]


@pytest.mark.parametrize(
    ("neutral", "value", "size"),
    [(None, 1.25, 1.25), (0.0, 1.25, 1.25), (1.0, 1.25, 0.25), (5.0, 1.25, 1.25), (1.0, 0.9, 0.1)],
)
def test_value_of_an_effect_may_be_off_by_its_distance_from_zero_or_where_it_does_nothing(
    neutral, value, size
):
    free = (of_effect(ViscousDamping, "damping_Nms", 1.0, -99.0, 99.0, neutral=neutral),)
    (width,) = spans(free, (value,), (ViscousDamping,), (9.0, 5.0))
    assert width == pytest.approx(2.0 * 1.96 * size, rel=1e-3)


def test_base_number_may_be_off_by_its_prior_deviation_and_by_the_least_share_of_itself():
    free = (Free("torque_offset_Nm", "N m", 4.0, -99.0, 99.0, "linear", "base"),)
    for left, off in (((5.0, 5.0), 4.0), ((1.0, 1.0), 0.0003 * 0.5)):
        (width,) = spans(free, (0.5,), (), left)
        assert width == pytest.approx(2.0 * 1.96 * off, rel=1e-3)


def test_law_that_is_the_least_like_its_machine_shifts_base_numbers():
    """Backlash is off by a tenth, viscous damping by a thousandth."""
    free = (
        Free("torque_offset_Nm", "N m", 4.0, -99.0, 99.0, "linear", "base"),
        of_effect(ViscousDamping, "damping_Nms", 1.0, -99.0, 99.0, neutral=0.0),
        of_effect(Backlash, "play_rad", 1.0, -99.0, 99.0, neutral=0.0),
    )
    widths = spans(free, (4.0, 2.0, 2.0), (ViscousDamping, Backlash), (9.0, 1.0))
    assert widths == pytest.approx(2.0 * 1.96 * np.array([0.4, 0.002, 0.2]), rel=1e-3)


def test_value_of_an_effect_that_the_model_declares_has_the_least_error_of_a_law():
    free = (of_effect(ViscousDamping, "damping_Nms", 4.0, -99.0, 99.0, neutral=0.0),)
    (width,) = spans(free, (0.5,), (), (1.0, 1.0))
    assert width == pytest.approx(2.0 * 1.96 * 0.001 * 0.5, rel=1e-3)


@pytest.mark.parametrize(
    ("effect", "name", "place", "told"),
    [
        (CoulombFriction, "creep_rad_s", 0.3, True),  # a shape of a friction
        (CoulombFriction, "torque_Nm", 0.3, False),
        (CoulombFriction, "torque_Nm", 1.0, True),  # at its bound
        (Backlash, "motor_share", 0.3, False),
        (None, "drum_inertia_kg_m2", 1.0, False),
    ],
)
def test_only_shapes_of_frictions_and_effects_at_their_bound_are_gone_along(
    effect, name, place, told
):
    """Residuals change near the fit alone, by no more than noise."""
    slopes, residuals = unlike(1)
    free = Free(name, "", place, 0.0, 1.0, "linear", "base")
    free = free if effect is None else of_effect(effect, name, place, 0.0, 1.0, neutral=place)

    def law(by):
        return residuals + 1e3 * slopes[:, 0] * np.clip(by[0], -5e-4, 5e-4)

    machine = Machine(None, None, (free,), (place,), law=law)
    effects = () if effect is None else (effect,)
    along, straight = (
        machine.intervals(effects, (1.0, 1.0), along=a)[free.name] for a in (True, False)
    )
    assert (along.high - along.low > straight.high - straight.low) == told


@pytest.mark.parametrize("value", [0.0, 0.2])
@pytest.mark.parametrize("scale", ["linear", "log"])
def test_value_is_gone_along_to_both_bounds_as_its_scale_has_them(value, scale):
    """Finely about the fit; of a factor by equal factors."""
    slopes, residuals = unlike(1)
    low, value = (0.1, value + 0.2) if scale == "log" else (0.0, value)
    name = f"{CoulombFriction.name}.creep_rad_s"
    free = Free(name, "", value, low, 1.0, scale, CoulombFriction.name)
    looked = []

    def law(by):
        looked.append(value + by[0])
        return residuals + 1e3 * slopes[:, 0] * np.clip(by[0], -5e-4, 5e-4)

    machine = Machine(None, None, (free,), (value,), law=law)
    machine.intervals((CoulombFriction,))
    looked.clear()
    told = machine.intervals((CoulombFriction,), along=True)[name]
    assert (told.low, told.high) == (pytest.approx(low), pytest.approx(1.0))
    beside = np.array(looked)[-(1 + 24 * (1 + (value > low))) :]
    for end in (low, 1.0) if value > low else (1.0,):
        expected = value + (end - value) * PLACES
        if scale == "log":
            expected = value * (end / value) ** (np.arange(1, 25) / 24.0)
        assert all(np.isclose(beside, at, rtol=1e-9).any() for at in expected)


def test_others_follow_by_a_step_in_their_own_units_and_within_their_bounds():
    slopes, residuals = unlike(2)
    other, own = 1e3 * slopes.T
    offset = Free("torque_offset_Nm", "N m", 4.0, 3.5, 9.0, "linear", "base")

    def law(by):
        return residuals + 0.5 * other * by[0] + (5.0 * other + own) * by[-1] ** 2

    machine = Machine(None, None, (offset, TORQUE), (4.0, 0.0), law=law)
    told = machine.intervals((CoulombFriction,), (9.0, 3.0), along=True)
    moved = 5.0 * told[TORQUE.name].high ** 2 / 0.5  # what takes up the other's part of the bend
    assert told[offset.name].low == pytest.approx(4.0 - moved, rel=1e-3)
    wide = machine.intervals((CoulombFriction,), (9e4, 3e4), along=True)
    assert wide[offset.name].low == 3.5


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_ends_lie_within_the_bounds(scale):
    free = (Free("torque_offset_Nm", "N m", 4.0, 3.5, 4.5, scale, "base"),)
    assert spans(free, (4.0,), (), (5.0, 5.0)) == [pytest.approx(1.0)]


def test_group_moves_a_value_by_no_more_than_two_prior_deviations():
    group = np.repeat(np.arange(2), EACH)
    columns = np.where(group == 0, 1.0, -1.0)[np.newaxis]
    residuals = np.where(group == 0, 1e3, -1e3)
    assert jackknife(columns, residuals, group) == pytest.approx(2.0)


def test_record_counts_by_the_share_of_what_is_known_that_is_due_to_it():
    """Of two that know 4 and 1 parts beside the prior's 1: w = 1 - 2/6 and 1 - 5/6."""
    group = np.array([0, 1])
    columns, residuals = np.array([[2.0, 1.0]]), np.array([0.1, 0.2])
    moved = np.array([2.0 * 0.1 / 2.0, 1.0 * 0.2 / 5.0])  # of the others and the prior
    due = np.array([1.0 - 2.0 / 6.0, 1.0 - 5.0 / 6.0])
    counted = np.minimum(1.0 / due - 1.0, 1.0)
    expected = np.sqrt(counted @ moved**2 / np.sum(counted / (1.0 / due - 1.0)))
    assert jackknife(columns, residuals, group, unequal=True) == pytest.approx([expected])


def test_prior_deviation_is_relative_on_a_log_scale_and_absolute_on_a_linear_one():
    inertia, friction = positive("inertia", "kg m^2", 2.0), from_zero("friction", "N m", 2.0, 5.0)
    assert [prior_deviation(inertia, value) for value in (0.1, 3.0)] == [0.1, 3.0]
    assert [prior_deviation(friction, value) for value in (0.1, 3.0)] == [2.0, 3.0]
