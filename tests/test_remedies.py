"""Remedies: declared by every effect, predicted from a diagnosis, and what is refused."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.hardware.compensation.tables import CompensationTable
from estune.trial import TrialRequest
from estune.trial.tracking import tracking_of, tracking_profile
from plants.diagnosis.interval import Interval
from plants.diagnosis.report.page import page
from plants.diagnosis.result import BaseParameter, ModelErrors, NamedEffect
from plants.effects import EFFECTS, CoulombFriction, Effect, Port, parameter
from plants.effects.plant_scale import PlantScale
from plants.effects.remedy import Place, Remedy
from plants.remedies import offers, offers_for, text
from plants.remedies.behaviour import MEASURES, behaviour
from plants.remedies.offers import FORM, REVERSAL_MARGIN
from plants.simulation.compensation import compensation_of
from tests.support_diagnosis import deciding, diagnosis, interval
from tests.support_lanes import first_by_day
from tests.test_compensation import friction_table, rig_with

GAINS = Gains(0.78, 31.0, 0.0206, 0.0003)
REEL = plants.reference_reel()


def found(effect, spread=0.1, **changes):
    """A diagnosis that has found one effect."""
    fitted = {
        name: Interval(value, value * (1.0 - spread), value * (1.0 + spread), p.unit)
        for name, p in effect.parameters().items()
        for value in [getattr(effect, name)]
    }
    named = NamedEffect(effect.name, effect.title, fitted, "", effect)
    parts = {"effects": (named,), "augmented": REEL + effect, "calibrations": ()}
    return replace(diagnosis(), **parts | changes)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_declares_what_can_be_done(name):
    effect = EFFECTS[name]()
    numbers = SimpleNamespace(**vars(effect))
    for model in (REEL, plants.unloaded_reel()):
        remedies = type(effect).remedies(numbers, PlantScale.of(model))
        assert remedies
        for remedy in remedies:
            assert remedy.title
            assert remedy.effort
            assert remedy.sized_by in {"", *effect.parameters()}
            if remedy.tables:
                table = CompensationTable(**{k: dict(v) for k, v in remedy.tables.items()})
                assert (
                    table.plan(632.0, 8192, 0.025, 0.8, 120.0, newtons_per_ampere=20.0) is not None
                )


def measured_tracking(hidden, compensation):
    about_step = REEL.profile
    settling_s = REEL.describe("reel", None).settling_time_s
    profile = tracking_profile(about_step, settling_s)
    with rig_with(compensation, effects=[hidden], take_up_A=1.0) as rig:
        record = rig.run(TrialRequest("c", 0, GAINS, profile))
    return tracking_of(profile, settling_s, 632.0, record.setpoint_N - record.tension_N)


@pytest.mark.parametrize("name", first_by_day("Coulomb, large", "Dahl"))
def test_prediction_is_what_the_loop_then_measures(name):
    hidden, compensation = friction_table(name, 0.8)
    numbers = {key: value for key, value in hidden.items() if key != "name"}
    (offer,) = offers_for(found(EFFECTS[hidden["name"]](**numbers)), GAINS)
    assert offer.place is Place.LOOP
    assert offer.worth
    compensation["friction"] = dict(offer.tables["friction"])
    off, on = (measured_tracking(hidden, c) for c in (None, compensation))
    assert offer.ratios["tracking"].value == pytest.approx(on.rms / off.rms, abs=0.05)
    assert offer.ratios["tracking"].low <= offer.ratios["tracking"].value
    assert offer.ratios["reversal"].high >= on.reversal / off.reversal


def test_a_curve_of_the_gauge_is_seen_in_the_true_tension_alone():
    (offer,) = offers_for(found(EFFECTS["gauge_nonlinearity"](curvature_per_N=6e-3)), GAINS)
    assert offer.place is Place.CALIBRATION
    assert offer.ratios["tracking"].high < 0.3
    assert offer.ratios["cost"].value == pytest.approx(1.0, abs=0.1)


def test_uncertain_friction_is_refused_with_the_experiment_that_helps():
    d = found(CoulombFriction(torque_Nm=0.05), spread=0.5)
    (offer,) = offers_for(d, GAINS)
    assert "50 %" in offer.refused
    assert not offer.tables
    assert CoulombFriction.excitation in text.sentences(d, (offer,))[0]


@pytest.mark.parametrize(("spread", "share"), [(0.02, 0.8), (0.025, 0.75), (0.05, None)])
def test_a_factor_is_fed_forward_by_how_far_it_is_known_to_be_from_one(spread, share):
    """An attenuation of 0.9 that is known to 0.045 is a friction of 0.1 known to 45 %."""
    d = found(EFFECTS["eyelet_friction"](attenuation=0.9))
    (named,) = d.effects
    bounds = Interval(0.9, 0.9 - spread, 0.9 + spread, "")
    named = replace(named, parameters={**named.parameters, "attenuation": bounds})
    offer = next(
        o for o in offers_for(replace(d, effects=(named,)), GAINS) if o.place is Place.LOOP
    )
    assert bool(offer.refused) is (share is None)
    assert share is None or offer.tables["eyelet"]["fraction"] == pytest.approx(share)


def test_remedy_that_needs_no_share_of_a_number_is_offered_as_declared():
    effect = EFFECTS["current_saturation"]()
    declared = type(effect).remedies(SimpleNamespace(**vars(effect)), PlantScale.of(REEL))
    offered = offers_for(found(effect, spread=0.02), GAINS)
    tables = {r.title: {n: dict(t) for n, t in r.tables.items()} for r in declared}
    assert any(tables.values())
    for offer in offered:
        assert "fraction" not in str(tables[offer.title])
        assert {n: dict(t) for n, t in offer.tables.items()} == tables[offer.title]


def test_remedy_of_one_of_two_effects_is_told_beside_the_experiment_that_decides():
    d = found(CoulombFriction(0.05), verdict="ambiguous", next_experiment=deciding())
    gains, told = text.sentences(d, offers_for(d, GAINS))
    assert gains == "These are predictions for the gains P=0.78,I=31,D=0.0206,F=0.0003."
    assert told.startswith("The records allow another effect, whose remedy is another. ")
    assert text.sentences(d, ())[0].startswith("What is not named cannot be remedied. ")


def test_a_share_is_fed_forward_that_the_interval_allows():
    (offer,) = offers_for(found(CoulombFriction(torque_Nm=0.05), spread=0.25), GAINS)
    assert offer.tables["friction"]["fraction"] == pytest.approx(0.75)


def test_interval_of_a_prediction_is_that_of_machines_over_the_interval_of_the_diagnosis():
    effect, spread = CoulombFriction(torque_Nm=0.05), 0.25
    (offer,) = offers_for(found(effect, spread), GAINS)
    settling_s = REEL.describe("reel", None).settling_time_s
    fed = compensation_of(offer.tables, PlantScale.of(REEL), REEL.controller)
    ends = []
    for times in (1.0 - spread, 1.0 + spread):
        machine = REEL + CoulombFriction(torque_Nm=0.05 * times)
        with_it, without = (behaviour(machine, GAINS, settling_s, c) for c in (fed, None))
        ends.append(with_it[1] / without[1])
    predicted = offer.ratios["tracking"]
    width = predicted.high - predicted.low - 2.0 * FORM * (1.0 - predicted.value)
    assert width == pytest.approx(abs(ends[1] - ends[0]), rel=0.3)


def test_remedy_that_a_machine_of_the_interval_does_not_bear_is_offered_unpredicted(monkeypatch):
    monkeypatch.setattr(
        offers, "_ratios", lambda *_, seed: np.full(3, 0.5 if seed == 0 else np.nan)
    )
    (offer,) = offers_for(found(CoulombFriction(torque_Nm=0.05)), GAINS)
    assert (offer.ratios, offer.gains) == ({}, None)
    assert offer.tables


def test_prediction_of_a_friction_that_is_known_exactly_is_less_certain_at_reversals():
    (offer,) = offers_for(found(CoulombFriction(torque_Nm=0.05), spread=0.0), GAINS)
    above = {measure: ratio.high - ratio.value for measure, ratio in offer.ratios.items()}
    assert above.pop("reversal") >= REVERSAL_MARGIN
    assert max(above.values()) < REVERSAL_MARGIN


def test_sensitivity_with_a_notch_has_the_interval_of_the_modes_frequency():
    d = found(EFFECTS["structural_mode"](), spread=0.05)
    (notch,) = (offer for offer in offers_for(d, GAINS) if "mode" in offer.tables)
    ratio = notch.ratios["sensitivity"]
    assert ratio.low <= ratio.value <= ratio.high
    assert ratio.low < ratio.high


def test_interval_of_a_sensitivity_reaches_to_the_modes_of_least_and_greatest_frequency(
    monkeypatch,
):
    """Where Ms with the notch is that without it, times the frequency over that of the mode."""
    d = found(EFFECTS["structural_mode"](), spread=0.05)
    (named,) = d.effects
    monkeypatch.setattr(
        offers,
        "sensitivity",
        lambda machine, _, tables: machine.effects[-1].frequency_Hz if tables else 2.0,
    )
    drawn = [one.frequency_Hz for one in offers._draws(named)]
    ratio = offers._sensitivity(d.augmented, GAINS, named, {"mode": {}})
    expected = np.array([named.effect.frequency_Hz, min(drawn), max(drawn)]) / 2.0
    assert (ratio.value, ratio.low, ratio.high) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("name", "field", "sizes", "left"),
    [
        ("dead_time", "delay_s", (4e-3, 3e-3), 1e-3),  # no delay is below zero
        ("dead_time", "delay_s", (3e-3, 4e-3), 1e-3),
        ("gauge_offset", "offset_N", (0.4, 0.3), -0.1),
    ],
)
def test_remedy_leaves_what_its_number_is_off_by(name, field, sizes, left, monkeypatch):
    told, true = (EFFECTS[name](**{field: size}) for size in sizes)
    monkeypatch.setattr(
        offers,
        "behaviour",
        lambda machine, *_, **__: np.array([getattr(machine.effects[-1], field)]),
    )
    (named,) = found(told).effects
    (remedy,) = (r for r in type(told).remedies(told, PlantScale.of(REEL)) if r.removes)
    rig = REEL + told, REEL.describe("reel", GAINS)
    ratio = offers._ratios(rig, true, None, named, remedy, seed=0)
    assert ratio == pytest.approx([left / sizes[1]])


@pytest.mark.parametrize(
    ("closure", "left"), [(0.0, 1.0), (0.75, 0.5), (1.0, 0.0), (-0.2, 1.0), (1.1, 0.0)]
)
def test_unexplained_is_the_root_of_the_power_that_is_left(closure, left):
    assert offers._unexplained(closure) == pytest.approx(left)
    assert offers._unexplained(float("nan")) == 0.0


@pytest.mark.parametrize(("cost", "is_worth"), [(1.0, True), (1.03, False)])
def test_remedy_that_harms_one_measure_is_not_worth_its_gain_in_another(
    cost, is_worth, monkeypatch
):
    ratios = {"cost": cost, "tracking": 0.8, "reversal": 1.0, "rest": 1.0}
    monkeypatch.setattr(
        offers, "_ratios", lambda *_, **__: np.array([ratios[name] for name in MEASURES])
    )
    (offer,) = offers_for(found(CoulombFriction(torque_Nm=0.05)), GAINS)
    assert offer.worth is is_worth


@pytest.mark.parametrize(
    ("changes", "worth"),
    [
        ({"tracking": (0.975, 0.9, 1.1)}, True),
        ({"tracking": (0.985, 0.9, 1.1)}, False),
        ({"rest": (0.5, 0.4, 0.6)}, False),  # a gain at rest alone is no reason
        ({"cost": (0.9, 0.8, 1.0), "reversal": (1.025, 1.0, 1.1)}, False),
        ({"cost": (0.9, 0.8, 1.0), "reversal": (1.015, 1.0, 1.1)}, True),
        ({"cost": (0.9, 0.8, 1.0), "rest": (1.5, 1.015, 1.9)}, True),  # may be no loss
        ({"cost": (0.9, 0.8, 1.0), "rest": (1.5, 1.025, 1.9)}, False),
        ({"cost": (0.9, 0.8, 1.0), "sensitivity": (1.0, 0.9, 1.025)}, False),
        ({"cost": (0.9, 0.8, 1.0), "sensitivity": (1.0, 0.9, 1.015)}, True),
    ],
)
def test_remedy_is_worth_a_gain_of_two_per_cent_beside_no_such_loss(changes, worth):
    ratios = dict.fromkeys(MEASURES, offers.PredictedRatio(1.0, 1.0, 1.0))
    ratios |= {name: offers.PredictedRatio(*at) for name, at in changes.items()}
    assert offers._worth(ratios) is worth
    listed = [f"{name} {at.value:.2f} times" for name, at in ratios.items() if at.value > 1.02]
    told = f"predicted to be worse: {', '.join(listed)}" if listed else ""
    assert offers._predicted_harm(ratios) == told
    assert offers._worth({}) is None


@pytest.mark.parametrize(
    ("value", "low", "share"),
    [(2.0, 1.8, 0.8), (2.0, 1.0, 0.5), (2.0, -0.1, 0.0), (0.0, 0.0, 0.0), (-2.0, -1.0, 0.0)],
)
def test_share_that_is_fed_forward_is_at_most_that_of_the_lower_end_and_eight_tenths(
    value, low, share
):
    assert offers.safe_fraction(interval(value, value - low)) == pytest.approx(share)


@pytest.mark.parametrize(
    ("value", "half", "words"),
    [
        (2.0, 0.59, ""),
        (-2.0, 0.61, "size is known to 30 %, more than 30 %; measure slow turns, and explain"),
        (2.0, 2.0, "size is known to 100 %"),
        (2.0, np.inf, "size has no interval; measure slow turns"),
        (0.0, 0.1, "size has no interval"),
    ],
)
def test_number_is_too_uncertain_where_it_is_known_to_less_than_three_tenths(value, half, words):
    for shown in ("slow turns", ""):
        named = SimpleNamespace(effect=SimpleNamespace(excitation=shown))
        told = offers._too_wide(named, SimpleNamespace(sized_by="size"), interval(value, half))
        assert bool(told) is bool(words)
        assert words.replace("slow turns", shown or "more records of it") in told


def test_calibration_is_judged_with_the_effects_and_of_a_gauge_only_where_there_is_one():
    def moved(name, base, with_effects, **changes):
        given = float(name == "torque_gain")
        ends = interval(base, 0.01), interval(with_effects, 0.01)
        one = found(
            CoulombFriction(torque_Nm=0.05), calibrations=(BaseParameter(name, "", given, *ends),)
        )
        return bool(offers._calibrations(replace(one, **changes)))

    effects = found(CoulombFriction(torque_Nm=0.05)).effects
    for name, off in (("torque_gain", 1.17), ("gauge_offset_N", 0.6)):
        right = float(name == "torque_gain")
        assert moved(name, right, off, effects=effects)
        assert not moved(name, off, right, effects=effects)
        assert moved(name, off, right, effects=())
        assert not moved(name, right, off, effects=())
        without = SimpleNamespace(channels={})
        assert moved(name, off, off, noise=without) is (name == "torque_gain")


def test_nothing_is_predicted_of_an_open_loop_nor_of_what_changes_no_number(monkeypatch):
    def predicted(loop, tables, removes):
        model = SimpleNamespace(profile=SimpleNamespace(loop=loop))
        remedy = SimpleNamespace(removes=removes)
        return offers._predicted(SimpleNamespace(augmented=model), None, remedy, tables, None)

    for unpredicted in (("open", {"friction": {}}, 1.0), ("closed", {}, 0.0)):
        assert predicted(*unpredicted) == ({}, None)

    def refused(*_, **__):
        raise InvalidInput("the model cannot run")

    monkeypatch.setattr(offers, "_ratios", refused)
    (offer,) = offers_for(found(CoulombFriction(torque_Nm=0.05)), GAINS)
    assert (offer.ratios, offer.gains, offer.worth) == ({}, None, None)


def test_calibration_of_an_uncertain_number_is_offered_and_a_term_in_the_loop_is_not(monkeypatch):
    monkeypatch.setattr(offers, "_predicted", lambda *_: ({}, None))
    for name, place in (
        ("gauge_nonlinearity", Place.CALIBRATION),
        ("coulomb_friction", Place.LOOP),
    ):
        listed = offers_for(found(EFFECTS[name](), spread=0.5), GAINS)
        assert {bool(offer.refused) for offer in listed if offer.place is place} == {
            place is Place.LOOP
        }


def test_small_friction_is_listed_as_not_worth_it():
    (offer,) = offers_for(found(CoulombFriction(torque_Nm=2e-4)), GAINS)
    assert offer.worth is False
    assert "not worth it" in text.rows((offer,))[0][0]


@pytest.mark.parametrize(
    ("name", "given", "fitted"),
    [
        ("torque_gain", 1.0, 1.17),
        ("torque_gain", 1.0, 0.85),
        ("gauge_offset_N", 0.0, 0.6),
        ("gauge_offset_N", 0.0, -0.6),
    ],
)
def test_a_moved_calibration_is_the_only_remedy(name, given, fitted):
    """The gauge has a noise of 0.041 N."""
    moved = BaseParameter(name, "", given, interval(fitted, 0.02), interval(fitted, 0.01))
    offers = offers_for(found(CoulombFriction(torque_Nm=0.05), calibrations=(moved,)), GAINS)
    assert [offer.place for offer in offers] == [Place.CALIBRATION]
    assert "hang weights" in offers[0].title


@dataclass(frozen=True)
class OwnEffect(Effect):
    """A user's own effect with a remedy."""

    name = "own_effect"
    title = "an own effect"
    appearance = "it is seen"
    port = Port.GAUGE
    size_N: float = parameter(0.1, low=0.0, high=1.0, unit="N", neutral=0.0)

    @classmethod
    def remedies(cls, p, _plant):
        return (Remedy(Place.WORKSHOP, f"take {p.size_N:g} N away", sized_by="size_N"),)


def test_an_effect_of_ones_own_brings_its_remedies():
    (offer,) = offers_for(found(OwnEffect(0.2)), GAINS)
    assert offer.title == "take 0.2 N away"
    assert not offer.ratios


def test_prediction_is_for_the_gains_of_the_records_and_wider_where_more_is_unexplained():
    d = found(CoulombFriction(torque_Nm=0.05))
    left = replace(d, gains=GAINS, after=ModelErrors(0.3, 7.0, 0.5))
    (asked,), (unsure,) = offers_for(d, GAINS), offers_for(left)
    assert unsure.gains == GAINS
    for name in ("cost", "tracking"):
        one, other = asked.ratios[name], unsure.ratios[name]
        assert one.value == other.value
        if abs(one.value - 1.0) > 0.1:
            assert other.high - other.low > 1.2 * (one.high - one.low)


def test_what_is_predicted_to_grow_is_among_what_a_remedy_may_harm():
    for offer in offers_for(found(CoulombFriction(torque_Nm=0.05)), Gains(0.2, 60.0, 0.0, 0.0)):
        for name, ratio in offer.ratios.items():
            assert (f"{name} {ratio.value:.2f} times" in offer.harm) == (ratio.value > 1.02)


def test_page_and_json_tell_what_can_be_done():
    d = found(CoulombFriction(torque_Nm=0.05))
    section = next(s for s in page(d).sections if s.title == "What can be done")
    assert "along the known motion" in str(section)
    (row,) = d.to_json()["remedies"]
    assert row["ratios"]["tracking"]["value"] < 0.8
    assert row["tables"]["friction"]["fraction"] == 0.8
    assert np.isfinite([row["ratios"]["cost"][end] for end in ("low", "value", "high")]).all()


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_machines_are_drawn_from_the_interval_in_whatever_unit_and_within_the_bounds(
    unit, monkeypatch
):
    """The interval may be in another unit than the effect's own number."""
    monkeypatch.setattr(offers, "DRAWS", 2000)
    effect = CoulombFriction(torque_Nm=0.02)
    one = SimpleNamespace(effect=effect, parameters={})
    assert {draw.torque_Nm for draw in offers._draws(one)} == {0.02}  # nothing is known of it
    one.parameters["torque_Nm"] = Interval(0.02 * unit, 0.01 * unit, 0.03 * unit, "")
    torques = [draw.torque_Nm for draw in offers._draws(one)]
    assert np.quantile(torques, [0.025, 0.5, 0.975]) == pytest.approx([0.01, 0.02, 0.03], rel=0.05)
    one.parameters["torque_Nm"] = Interval(0.02 * unit, 0.0, 0.2 * unit, "")
    assert min(draw.torque_Nm for draw in offers._draws(one)) == 0.0  # friction drives nothing
    one.parameters["torque_Nm"] = Interval(0.02 * unit, -np.inf, np.inf, "")
    assert {draw.torque_Nm for draw in offers._draws(one)} == {0.02}


def test_interval_of_a_ratio_is_the_range_of_the_draws_and_what_is_unexplained_of_its_change():
    rows = np.array([[0.5, 0.9, 1.2, 1.0], [0.4, 0.95, 1.1, 1.02], [0.55, 0.85, 1.4, 0.01]])
    plain, wide = (offers._intervals(rows, 0.2, widened=widened) for widened in (False, True))
    for n, name in enumerate(MEASURES):
        low, high = rows[:, n].min(), rows[:, n].max()
        value, repeated = rows[0, n], 0.015 if name == "rest" else 0.0
        for found_, form, reversal in ((plain, 0.0, 0.0), (wide, 0.07, 0.1)):
            more = (0.2 + form) * abs(value - 1.0) + repeated
            over = reversal if name == "reversal" else 0.0
            at = found_[name]
            expected = (value, max(low - more, 0.0), high + more + over)
            assert (at.value, at.low, at.high) == pytest.approx(expected)


def test_effect_takes_the_place_of_one_of_its_kind_alone():
    hard = CoulombFriction(torque_Nm=0.04)
    model = offers.with_effect(REEL + CoulombFriction(), CoulombFriction(), hard)
    assert [one for one in model.effects if isinstance(one, CoulombFriction)] == [hard]
    assert len(model.effects) == len((REEL + CoulombFriction()).effects)
    with pytest.raises(InvalidInput, match="the model has no coulomb_friction"):
        offers.with_effect(REEL, CoulombFriction(), hard)
