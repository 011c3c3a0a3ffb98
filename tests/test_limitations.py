"""What records cannot tell, found before any effect is."""

import re
from dataclasses import replace

import numpy as np
import pytest

import plants
from estune.errors import InvalidInput
from plants.diagnosis.result import FAULTY, LIMITED
from plants.effects import CoulombFriction
from plants.models.unloaded_reel import UnloadedReel
from tests.support_measurements import open_loop

RATE_Hz = 500.0
DRIVE = UnloadedReel(sampling_Hz=RATE_Hz, dead_time_s=0.0)


def drive(current_A, *, inertia=2e-3, friction=0.01, dry=0.0):
    """Angle of a drum with viscous and dry friction, rounded to encoder steps."""
    velocity, angle, out = 0.0, 0.0, []
    for torque in 0.5 * current_A:
        out.append(angle)
        for _ in range(8):
            velocity += (torque - friction * velocity) / inertia / RATE_Hz / 8
            velocity -= np.clip(
                velocity, -dry / inertia / RATE_Hz / 8, dry / inertia / RATE_Hz / 8
            )
            angle += velocity / RATE_Hz / 8
    step = 2.0 * np.pi / 8192.0
    return np.round(np.array(out) / step) * step


def records(**drum):
    """A sweep and a slow wave."""
    t = np.arange(1500) / RATE_Hz
    for n, current in enumerate([0.1 * np.sin(9.0 * t * t), 0.08 * np.sin(4.0 * t)]):
        yield open_loop(n, RATE_Hz, current, angle_rad=drive(current, **drum))


def kinds(found):
    return [one.kind for one in found.limitations]


@pytest.fixture(scope="module")
def sound():
    return plants.explain(DRIVE, list(records()))


def test_good_records_have_no_limitations(sound):
    assert sound.verdict == "none"
    assert kinds(sound) == []


def test_motion_in_one_direction_is_stated_first():
    t = np.arange(1500) / RATE_Hz
    current = 0.1 + 0.08 * np.sin(4.0 * t)
    one_way = [open_loop(n, RATE_Hz, current, angle_rad=drive(current)) for n in range(2)]
    found = plants.explain(DRIVE, one_way)
    assert "one_direction" in kinds(found)
    assert found.sentence.startswith("all motion is in one direction")
    assert found.to_json()["limitations"][0]["kind"] == "one_direction"


def test_stage_is_told_of_in_its_own_words():
    moving = [replace(m, angle_rad=m.angle_rad) for m in records(inertia=7e-3)]
    stage = plants.stage(2e-3, 0.01, force_constant_N_A=0.5, encoder_step_m=2 * np.pi / 8192)
    found = plants.explain(stage, moving, effects=[])
    assert found.unit == "m"
    assert {c.name: c.unit for c in found.calibrations} == {
        "mass_kg": "kg",
        "viscous_friction_Ns_m": "N s/m",
        "force_offset_N": "N",
    }
    told = found.to_json()
    assert told["gap_before_m"] == found.before.gap
    assert told["exit_code"] == LIMITED
    assert "mass_kg moved to 3.5 times" in found.sentence
    shown = str((found.heading(), found.where, found.traces[0].unit, told))
    assert "rad" not in re.sub("angle_rad|velocity_rad|presliding_rad", "", shown)


def test_model_as_given_is_beside_the_refitted_one(sound):
    off = plants.explain(DRIVE, list(records(inertia=2.6e-3)), effects=[])
    assert off.given.ratio > 2.0 * off.before.ratio
    assert off.given.rms > 2.0 * off.before.rms
    assert sound.given.ratio == pytest.approx(sound.before.ratio, rel=0.2)


def test_errors_on_held_out_records_are_of_models_not_fitted_to_them():
    fast, slow = records(inertia=2.6e-3)
    held = plants.explain(DRIVE, [fast], effects=[], hold_out=[slow]).hold_out
    assert held.records == (slow.name,)
    assert held.base == held.with_effects
    assert held.given.ratio > 2.0 * held.base.ratio
    assert 0.5 < held.base.ratio < 1.3


def test_declared_effects_are_compared_with_the_model_without_them():
    model = DRIVE + CoulombFriction(0.002)
    rough = list(records(dry=0.004))
    (shown,) = plants.explain(model, rough, effects=[]).declared
    assert shown.supported
    assert shown.parameters["torque_Nm"].value == pytest.approx(0.004, rel=0.1)
    (idle,) = plants.explain(model, list(records()), effects=[]).declared
    assert not idle.supported
    assert "is not supported by these records" in idle.sentence


def test_base_parameter_that_moved_far_is_stated():
    assert "base_parameter_moved" in kinds(plants.explain(DRIVE, list(records(inertia=7e-3))))


def test_number_that_is_known_is_stated_first_where_it_moved_beyond_that():
    known = replace(DRIVE, uncertainty=(("drum_inertia_kg_m2", 0.05),))
    found = plants.explain(known, list(records(inertia=2.6e-3)), effects=[])
    assert kinds(found)[0] == "base_parameter_moved"
    assert found.sentence.startswith("drum_inertia_kg_m2 moved to 1.3 times")
    loosely = replace(DRIVE, uncertainty=(("drum_inertia_kg_m2", 0.3),))
    assert kinds(plants.explain(loosely, list(records(inertia=2.6e-3)), effects=[])) == []


def test_known_inertia_does_not_stand_in_for_friction():
    rough, effects = list(records(dry=0.02)), ["bent_viscous_friction"]
    loose, known = (
        plants.explain(
            replace(DRIVE, uncertainty=(("drum_inertia_kg_m2", sd),)), rough, effects=effects
        )
        for sd in (100.0, 0.1)
    )
    (far,), (near,) = (
        [c.base.value / c.given for c in d.calibrations if c.name == "drum_inertia_kg_m2"]
        for d in (loose, known)
    )
    assert abs(np.log(near)) < 0.5 * abs(np.log(far))


def test_nothing_missing_is_not_said_beside_a_free_run_that_is_far_off():
    found = plants.explain(DRIVE, [replace(m, angle_rad=_coarse(m)) for m in records(dry=0.01)])
    assert found.verdict != "none"


def _coarse(m):
    """The angle read in steps of half a degree, in which a short prediction shows nothing."""
    return np.round(m.angle_rad / 0.01) * 0.01


def test_records_of_the_wrong_sign_are_refused():
    flipped = [replace(m, angle_rad=-m.angle_rad) for m in records()]
    with pytest.raises(InvalidInput, match="its sign seems to be reversed"):
        plants.explain(DRIVE, flipped, effects=[])


def test_model_that_is_far_off_shows_as_a_parameter_at_its_bound():
    found = plants.explain(DRIVE, list(records(inertia=0.05)), effects=[])
    assert kinds(found)[0] == "base_parameter_at_bound"
    assert (found.verdict, found.exit_code) == ("unknown", FAULTY)


def test_nothing_missing_is_not_said_where_most_records_were_refused():
    good = list(records())
    strays = [
        replace(m, rig=f"other{n}", name=f"s{n}", source=f"s{n}") for n, m in enumerate(good * 4)
    ]
    few, most = (plants.explain(DRIVE, [*good, *some]) for some in (strays[:1], strays))
    assert (few.verdict, most.verdict) == ("none", "unknown")
    assert kinds(most)[0] == "records_refused"
