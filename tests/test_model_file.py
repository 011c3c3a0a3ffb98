"""Models as TOML files: exact after saving and loading; all mistakes reported at once."""

import tomllib
from dataclasses import fields, replace
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import plants
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.support.toml_file import read_toml
from plants.effects import (
    EFFECTS,
    CoulombFriction,
    CurrentSaturation,
    EyeletFriction,
    RecordScale,
)
from plants.models import model_file
from plants.models.model_tables import KINDS
from plants.models.reel import Reel
from plants.models.unloaded_reel import unloaded_reel

GAINS = Gains(P=0.6, I=20.0, D=0.01, setpoint_filter_s=0.01)


def between(low, high):
    return st.floats(low, high, allow_nan=False)


@st.composite
def effects(draw):
    kind = EFFECTS[draw(st.sampled_from(sorted(EFFECTS)))]
    ranges = {name: kind.range(name, RecordScale()) for name in kind.parameters()}
    return kind(**{name: draw(between(r.low, r.high)) for name, r in ranges.items()})


REELS = st.builds(
    Reel,
    cable_length_m=between(0.3, 5.0),
    tension_N=between(5.0, 40.0),
    drum_inertia_kg_m2=between(1e-5, 1.0),
    cable_EA_N=between(1e2, 1e7),
    gauge_damping=between(0.0, 0.9),
    sampling_Hz=between(50.0, 1e4),
    effects=st.lists(effects(), max_size=3).map(tuple),
)


@given(REELS)
def test_reel_is_unchanged_by_saving_and_loading(reel):
    assert model_file.from_toml(model_file.to_toml(reel, "a note\nof two lines")) == reel


def test_unloaded_reel_is_unchanged_by_saving_and_loading():
    drum = unloaded_reel(drum_inertia_kg_m2=3e-3) + CoulombFriction(0.04)
    assert model_file.from_toml(model_file.to_toml(drum)) == drum
    with pytest.raises(InvalidInput, match=r"\[unloaded_reel\] cable_length_m: there is no such"):
        model_file.from_toml("[unloaded_reel]\ncable_length_m = 1.0\n")
    with pytest.raises(InvalidInput, match=r"\[\[effects\]\] 1 \(eyelet_friction\): .*cable"):
        model_file.from_toml("[unloaded_reel]\n[[effects]]\nname = 'eyelet_friction'\n")


STAGE = """
[stage]
mass_kg = 95.1
viscous_friction_Ns_m = 203.4
encoder_step_m = 5e-8

[[effects]]
name = "coulomb_friction"
torque_Nm = 20.4
"""
SERVO = "[servo]\ninertia_kg_m2 = 2e-4\nviscous_friction_Nms = 1e-3\ntorque_constant_Nm_A = 0.1\n"


def test_stage_and_servo_have_tables_of_their_own():
    for text in (STAGE, SERVO):
        made = model_file.from_toml(text)
        again = model_file.from_toml(model_file.to_toml(made))
        assert again.own_values == pytest.approx(made.own_values, rel=1e-15)
        assert (type(again), again.effects) == (type(made), made.effects)
    stage, servo = map(model_file.from_toml, (STAGE, SERVO))
    assert stage.linear_model().B == (0.0, 1.0 / 95.1)
    assert (
        stage.effects[0]
        .sentence({"torque_Nm": 20.4, "creep_rad_s": 0.0}, stage)
        .startswith("Your stage has dry friction: 20.4 N against the motion")
    )
    assert servo.newtons_per_ampere == 0.1
    assert "inertia_kg_m2=0.0002" in repr(servo)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[stage]\nmass_kg = 2.0\n", "it needs viscous_friction_Ns_m"),
        ("[stage]\nmass_kg = -2.0\nviscous_friction_Ns_m = 1.0\n", "stage: mass_kg"),
        ("[stage]\ndrum_radius_m = 2.0\n", "drum_radius_m: there is no such key"),
        (f"{SERVO}[[effects]]\nname = 'cable_creep'\n", "cannot be added to the servo"),
    ],
)
def test_stage_or_servo_table_that_is_wrong_is_refused(text, told):
    with pytest.raises(InvalidInput, match=told):
        model_file.from_toml(text)


@given(
    poles=st.lists(between(0.5, 200.0), min_size=1, max_size=3),
    gain=between(0.1, 10.0),
    dead_time_s=between(0.0, 0.05),
    noise=between(0.0, 1.0),
    gains=st.sampled_from([None, GAINS]),
)
def test_linear_plant_is_unchanged_by_saving_and_loading(poles, gain, dead_time_s, noise, gains):
    system = control.tf([gain], np.poly(-np.array(poles)))
    plant = plants.linear_plant(
        system, dead_time_s, 1000.0, noise_rms_N=noise, output_max_N=50.0, gains=gains
    )
    again = model_file.from_toml(model_file.to_toml(plant))
    assert again.mounting == plant.mounting
    assert again.model == plant.model
    assert np.array_equal(again.sampled.Phi, plant.sampled.Phi)


def test_linear_plant_file_includes_effects_and_units():
    plain = plants.linear_plant(control.tf([1.0], [0.01, 0.02, 1.0]), sampling_Hz=500.0)
    plant = replace(plain, torque_unit=3.0, angle_unit=0.5) + CoulombFriction(0.1)
    again = model_file.from_toml(model_file.to_toml(plant))
    assert (again.effects, again.torque_unit, again.angle_unit) == (plant.effects, 3.0, 0.5)
    assert np.array_equal(again.parameter_values, plant.parameter_values)


MOTOR = """
import plants

def step(speed, effort, dt_s):
    return speed + dt_s * (effort - speed), speed

def motor():
    return plants.python_plant(step, 0.0, sampling_Hz=100.0, settling_time_s=2.0)
"""


def test_python_plant_is_saved_by_its_reference(tmp_path, monkeypatch):
    (tmp_path / "own_motor.py").write_text(MOTOR)
    monkeypatch.syspath_prepend(tmp_path)
    plant = plants.load_model("own_motor:motor") + CurrentSaturation(0.5)
    with pytest.raises(InvalidInput, match="give the plant's reference"):
        model_file.to_toml(plant)
    again = model_file.from_toml(model_file.to_toml(plant, plant="own_motor:motor"))
    assert again == plant
    for text, words in (
        ("[python_plant]\n", r"\[python_plant\]: which one is missing"),
        ("[python_plant]\nplant = 3\n", "plant: this is 3; it must be module:attribute"),
        ("[python_plant]\nplant = 'plants:reference_reel'\n", "is a Reel, not a python_plant"),
        ("[python_plant]\nplant = 'own_motor:no'\n", "has no 'no'"),
    ):
        with pytest.raises(InvalidInput, match=words):
            model_file.from_toml(text)


def test_discrete_plant_and_transfer_function_can_be_files():
    system = control.tf([1.0], [0.2, 1.0])
    discrete = plants.linear_plant(control.c2d(system, 0.01), dead_time_s=0.03)
    again = model_file.from_toml(model_file.to_toml(discrete))
    assert again.mounting == discrete.mounting
    assert np.array_equal(again.parameter_values, discrete.parameter_values)
    written = "[linear_plant]\nnumerator = [1]\ndenominator = [0.2, 1]\nsampling_Hz = 100\n"
    expected = plants.linear_plant(system, sampling_Hz=100.0)
    assert model_file.from_toml(written).model == expected.model


def test_loaded_model_is_simulated_like_the_saved_one(tmp_path):
    reel = plants.reference_reel(cable_length_m=1.1) + CoulombFriction(0.03) + EyeletFriction(0.9)
    plants.save_model(reel, tmp_path / "reel.toml")
    again = plants.load_model(tmp_path / "reel.toml")
    first, second = (plants.simulate(r, GAINS) for r in (reel, again))
    assert np.array_equal(first.tension_N, second.tension_N)


OLD_FILES = sorted((Path(__file__).parent / "assets" / "model_files").glob("*.toml"))


@pytest.mark.parametrize("path", OLD_FILES, ids=lambda path: path.stem)
def test_model_file_of_an_earlier_version_opens_with_all_values(path):
    text = path.read_text(encoding="utf-8")
    tables, again = tomllib.loads(text), tomllib.loads(model_file.to_toml(plants.load_model(path)))
    effects, effects_again = (t.pop("effects", []) for t in (tables, again))
    assert again == {"format": 1, **tables}
    assert len(effects_again) == len(effects)
    for old, new in zip(effects, effects_again, strict=True):
        assert old.pop("name").rpartition(":")[2] == new.pop("name").rpartition(":")[2]
        assert new == old


def test_model_file_defaults_to_the_reference_reel():
    text = "[reel]\n[[effects]]\nname = 'coulomb_friction'\n"
    assert model_file.from_toml(text) == plants.reference_reel() + CoulombFriction()


def test_settings_override_the_model_file(tmp_path):
    (tmp_path / "reel.toml").write_text("[reel]\ncable_length_m = 0.5\n")
    reel = plants.load_model(str(tmp_path / "reel.toml"), cable_length_m=1.25)
    assert reel.cable_length_m == 1.25
    assert plants.load_model("plants:reference_reel", cable_length_m=1.25) == reel
    with pytest.raises(InvalidInput, match="cable_lenght: there is no such key"):
        plants.load_model(str(tmp_path / "reel.toml"), cable_lenght=1.25)


def test_model_file_reports_all_mistakes_with_their_places(tmp_path):
    path = tmp_path / "reel.toml"
    path.write_text(
        """
[reel]
cable_lenght_m = 0.8
tension_N = "15"
drum_radius_m = -0.02
gauge_Hz = nan

[[effects]]
name = "coulomb_frictoin"

[[effects]]
name = "eyelet_friction"
attenuation = 1.5
inner_shares = 0.2

[[effects]]
torque_Nm = 1.0

[spare]
"""
    )
    with pytest.raises(InvalidInput) as refused:
        plants.load_model(path)
    lines = str(refused.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines)
    for place, words in (
        ("[spare]: ", "no such table"),
        ("[reel] cable_lenght_m: ", "did you mean cable_length_m?"),
        ("[reel] tension_N: ", 'this is "15"; it must be a number'),
        ("[reel] drum_radius_m: ", "-0.02"),
        ("[reel] gauge_Hz: ", "nan"),
        ("[[effects]] 1 name: ", "coulomb_friction"),
        ("[[effects]] 2 (eyelet_friction) attenuation: ", "1.5; it must lie from 0.35 to 1"),
        ("[[effects]] 2 (eyelet_friction) inner_shares: ", "did you mean inner_share?"),
        ("[[effects]] 3: ", "name is missing"),
    ):
        assert sum(f"{path}: {place}" in line and words in line for line in lines) == 1, place
    assert len(lines) == 9


def test_file_with_the_byte_order_mark_of_windows_is_read(tmp_path):
    path = tmp_path / "reel.toml"
    path.write_text("[reel]\ncable_length_m = 1.2\n", encoding="utf-8-sig")
    assert plants.load_model(path).cable_length_m == 1.2
    assert read_toml(path)["reel"] == {"cable_length_m": 1.2}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[reel\n", "no TOML: .*line 1"),
        ("", r"one table of \[reel\].*it has none"),
        ("[reel]\n[linear_plant]\n", r"it has \[reel\] and \[linear_plant\]"),
        ("reel = 3\n", r"a value, not a table; write \[reel\]"),
        ("effects = 3\n[reel]\n", r"begin each with \[\[effects\]\]"),
        ("[reel]\ntension_N = 50\n", "tension is 50 N; it must lie from 5 to 40 N"),
        ("[reel]\ngauge_Hz = true\n", "gauge_Hz: this is true; it must be a number"),
        ("[linear_plant]\nnumerator = [1]\n", "either numerator and denominator, or A, B and C"),
        ("[linear_plant]\nA = [[1, 2]]\nB = [1]\nC = [1]\n", "1 rows must have 1 numbers each"),
        ("[linear_plant]\nnumerator = 1\ndenominator = [1]\n", "it must be a list of numbers"),
        ("[linear_plant]\nA = [[-1.0]]\nB = [1]\nC = [1]\ndiscrete = true\n", "its sampling_Hz"),
        (
            (
                "[linear_plant]\nnumerator = [1]\ndenominator = [1, 1]\nstep = {preload_N = 0, "
                "step_N = 1, step_at_s = 1, duration_s = 2, loop = 'shut'}\n"
            ),
            'step: this is "shut"; it must be closed or open',
        ),
        ("[linear_plant]\nA = [[-1.0]]\nB = [1]\nC = [1]\ngains = {P = 1}\n", "P, I, D, setpo"),
        ("[linear_plant]\nA = [[-1.0]]\nB = [1, 2]\nC = [1]\n", "the model cannot be made"),
    ],
)
def test_model_file_without_a_model_is_rejected_with_the_reason(text, words):
    with pytest.raises(InvalidInput, match=words):
        model_file.from_toml(text)


def test_unreadable_or_unwritable_model_file_is_reported(tmp_path):
    with pytest.raises(InvalidInput, match=r"nowhere\.toml: No such file"):
        plants.load_model(tmp_path / "nowhere.toml")
    (tmp_path / "latin.toml").write_bytes(b"[reel]\n# \xe9t\xe9\n")
    with pytest.raises(InvalidInput, match="UTF-8"):
        plants.load_model(tmp_path / "latin.toml")
    with pytest.raises(InvalidInput, match="another file"):
        plants.save_model(plants.reference_reel(), tmp_path / "no" / "reel.toml")
    with pytest.raises(InvalidInput, match="a dict cannot be written"):
        plants.save_model({}, tmp_path / "reel.toml")


def test_what_is_known_of_numbers_is_a_table_of_its_own():
    text = "[servo]\ninertia_kg_m2 = 1e-3\nviscous_friction_Nms = 1e-3\n\n"
    servo = model_file.from_toml(text + "[uncertainty]\ninertia_kg_m2 = 0.05\n")
    assert servo.uncertainty == (("drum_inertia_kg_m2", 0.05),)
    assert model_file.from_toml(model_file.to_toml(servo)) == servo
    for line, told in (
        ("sampling_Hz = 0.1", "there is no such key"),
        ("inertia_kg_m2 = 0", "above 0"),
        ('inertia_kg_m2 = "5 %"', "must be a number"),
    ):
        with pytest.raises(InvalidInput, match=told):
            model_file.from_toml(f"{text}[uncertainty]\n{line}\n")


def test_user_effect_is_saved_by_module_and_attribute(tmp_path, monkeypatch):
    (tmp_path / "hose.py").write_text(
        "from dataclasses import dataclass\n"
        "from typing import ClassVar\n"
        "from plants.effects import Effect, Port, parameter\n"
        "@dataclass(frozen=True)\n"
        "class Spring(Effect):\n"
        "    name: ClassVar[str] = 'rewind_spring'\n"
        "    title: ClassVar[str] = 'spring that rewinds the drum'\n"
        "    appearance: ClassVar[str] = 'less current than the tension takes'\n"
        "    port: ClassVar[Port] = Port.DRUM\n"
        "    torque_Nm: float = parameter(0.05, low=0.0, high=1.0, unit='N m', neutral=0.0)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    import hose  # noqa: PLC0415  written just now

    reel = plants.reference_reel() + hose.Spring(0.1)
    text = model_file.to_toml(reel)
    assert tomllib.loads(text)["effects"] == [{"name": "hose:Spring", "torque_Nm": 0.1}]
    assert model_file.from_toml(text) == reel

    class Local(hose.Spring):
        pass

    with pytest.raises(InvalidInput, match="define it in a module"):
        model_file.to_toml(plants.reference_reel() + Local())


def test_model_file_has_every_field_of_a_reel():
    table = tomllib.loads(model_file.to_toml(plants.reference_reel()))["reel"]
    assert set(table) == {f.name for f in fields(Reel)} - {"effects", "uncertainty"}
    assert {kind.table for kind in KINDS} >= {"reel", "linear_plant"}
