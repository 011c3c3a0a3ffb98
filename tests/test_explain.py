"""What `explain` says of records of machines that share no code with it.

Which machines it gets right is promised over blocks of seeds, in test_hidden_block.py.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import casadi as ca
import pytest

import plants
from estune.errors import InvalidInput, PlantError
from experiments import hidden_machines
from experiments.measured_data import cut
from experiments.paper.identify.excitation import Band, multisine
from experiments.paper.identify.open_loop import open_loop_record
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.effects import EFFECTS, Effect, GaugeOffset, Port, parameter
from tests.support_hidden import drawn, skip_without_compiler

FEW = ("viscous_damping", "gain_error", "gauge_offset", "dead_time", "rate_limit")
"""Effects that explain neither a drag that grows with the square nor dry friction."""


def all_but(family):
    """Few effects, and in the slow lane all that are not of the family of one."""
    others = [name for name in EFFECTS if hidden_machines.family(name) != family]
    return pytest.mark.parametrize(
        "others", [FEW, pytest.param(others, marks=pytest.mark.slow)], ids=["few", "all"]
    )


@pytest.fixture(autouse=True, scope="module")
def _compiler():
    skip_without_compiler()


@dataclass(frozen=True)
class AirDrag(Effect):
    """A drag that grows with the square of the velocity, as a package of one's own declares it."""

    name: ClassVar[str] = "air_drag"
    title: ClassVar[str] = "drag of the air"
    appearance: ClassVar[str] = "more current the faster it turns, and more than in proportion"
    excitation: ClassVar[str] = "a run at top speed"
    port: ClassVar[Port] = Port.DRUM
    torque_Nms2: float = parameter(1e-3, low=0.0, high=10.0, unit="N m s2/rad2", neutral=0.0)

    @staticmethod
    def respond(p, state, signal, site):
        del signal
        omega = site.start_velocity_rad_s
        return state, -p.torque_Nms2 * omega * ca.fabs(omega)


@all_but("bent_viscous_friction")
def test_undeclared_effect_is_unknown_until_it_is_declared(others):
    given, records = drawn(501, "outside_unloaded", "quadratic_drag")
    without = plants.explain(given, records, effects=others)
    assert without.verdict == "unknown"
    assert not without.effects
    reports = []
    found = plants.explain(
        given, records, effects=[*others, AirDrag], progress=lambda *report: reports.append(report)
    )
    assert "fitting drag of the air" in dict(reports)
    assert [done for _, done in reports] == sorted(done for _, done in reports)
    assert reports[-1] == ("done", 1.0)
    assert (found.verdict, [effect.name for effect in found.effects]) == ("named", ["air_drag"])
    assert found.after.gap < 0.3 * found.before.gap
    assert AirDrag in [type(effect) for effect in found.augmented.effects]
    assert found.shown_by["air_drag"] == AirDrag.excitation


def test_unknown_verdict_says_what_the_error_looks_like():
    # The sentence is of what the error looks like, not of the effects that were tried.
    tried = ["gain_error", "gauge_offset", "coulomb_friction"]
    found = plants.explain(*drawn(601, "outside", "sensitivity_drift"), effects=tried)
    assert found.verdict == "unknown"
    assert "It looks like a gain of the gauge that changes with time." in found.sentence


@all_but("coulomb_friction")
def test_omitted_truth_is_not_replaced_by_another_name(others):
    given, records = drawn(700, "unloaded", "coulomb_friction")
    found = plants.explain(given, records, effects=others)
    assert found.verdict == "unknown"
    assert found.where.blocks[0].name == "force"


@pytest.fixture(scope="module")
def rubbing():
    """Diagnosis of a drum with dry friction."""
    return plants.explain(*drawn(700, "unloaded", "coulomb_friction"))


@pytest.mark.slow
def test_verdict_depends_neither_on_order_nor_on_cut_of_the_files(rubbing):
    given, records = drawn(700, "unloaded", "coulomb_friction")
    parts = [part for m in records[::-1] for part in cut(m, 2)]
    found = [rubbing, plants.explain(given, parts)]
    assert {one.verdict for one in found} == {"named"}
    assert {tuple(e.name for e in one.effects) for one in found} == {("coulomb_friction",)}
    sizes = [one.effects[0].parameters["torque_Nm"].value for one in found]
    assert sizes == pytest.approx([sizes[0]] * 2, rel=0.02)


def test_sound_drum_gives_the_same_answer_again():
    given, records = drawn(501, "none_unloaded")
    first, again = (plants.explain(given, records) for _ in range(2))
    assert first.verdict == "none"
    assert first.to_json() == again.to_json()


@pytest.mark.parametrize(
    ("seed", "variant", "hidden_", "named"),
    [
        (50003, "none_unloaded", None, []),  # its inertia and friction are both 5 % off
        # A gain does as well as a zero.
        pytest.param(50023, "none_no_encoder", None, [], marks=pytest.mark.slow),
        (501, "plain", "gauge_offset", ["gauge_offset"]),
        (504, "unloaded", "gain_error", ["gain_error"]),
    ],
)
def test_wrong_base_parameter_is_named_only_where_it_alone_explains_the_error(
    seed, variant, hidden_, named
):
    numbers = ["gain_error", "viscous_damping", "gauge_offset"]
    found = plants.explain(*drawn(seed, variant, hidden_), effects=numbers)
    assert [effect.name for effect in found.effects] == named
    assert found.verdict == ("named" if named else "none")


def test_calibrations_that_moved_are_the_finding_and_not_a_part_of_none():
    reel = plants.reference_reel()
    sines = multisine(reel.sampling_Hz, Band(1.0, 60.0, periods=2), 4.0)
    read = replace(reel, effects=(GaugeOffset(1.0),))
    m = MeasuredRecord.of(open_loop_record(read, sines, seed=0))
    # The current is known, and not what torque it makes.
    driven = replace(m, loop="closed", setpoint_N=None)
    given = replace(reel, torque_constant_Nm_A=1.09 * reel.torque_constant_Nm_A)
    numbers = ["gain_error", "viscous_damping", "gauge_offset"]
    found = plants.explain(given, [driven], effects=numbers)
    assert (found.verdict, [e.name for e in found.effects]) == (
        "named",
        ["gain_error", "gauge_offset"],
    )
    for effect, truth in zip(found.effects, (1.0 / 1.09 - 1.0, 1.0), strict=True):
        (at,) = effect.parameters.values()
        assert at.low <= truth <= at.high
        assert at.high - at.low < 0.2 * abs(truth)
    assert "gauge_offset_N was 0 N and is 1" in found.sentence
    assert "torque_gain was 1 and is 0.91" in found.sentence


def test_candidates_have_probabilities_in_json(rubbing):
    first, *rest = rubbing.to_json()["candidates"]
    assert first["name"] == "coulomb_friction"
    assert first["probability"] > 0.9
    assert all(0.0 <= one["probability"] <= 1.0 + 1e-9 for one in rest)


def test_records_of_another_rig_are_refused_by_name():
    given, records = drawn(501, "none_unloaded")
    stray = replace(records[0], rig="another", name="stray", source="stray")
    found = plants.explain(given, [*records, stray])
    (refused,) = [f for f in found.findings if f.level == "refused"]
    assert refused.source == "stray"
    assert "another" in refused.sentence
    assert found.verdict == "none"
    assert [one.kind for one in found.limitations] == ["records_refused"]
    assert found.sentence.startswith("1 of")


def test_unusable_input_is_refused_by_name():
    given, records = drawn(501, "none_unloaded")
    with pytest.raises(InvalidInput, match="no record"):
        plants.explain(given, [])
    with pytest.raises(PlantError, match="diagnosed_by"):
        plants.explain(object(), records)
    with pytest.raises(InvalidInput, match="no_such_effect"):
        plants.explain(given, records, effects=["no_such_effect"])
