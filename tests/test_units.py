"""A plant's own units and names, wherever a result or a rig is shown."""

import control
import pytest

import plants
from estune import tune
from estune.core.gains import GAIN_UNITS, Gains, gain_units
from estune.recordings.units import find_unit
from estune.remote import messages
from estune.remote.messages import Description
from estune.remote.messages.replies import decode_description
from estune.run.results.report import page
from estune.studies.law.law import fit_law
from estune.studies.law.tuned import TunedGains
from estune.support.html_page import render
from estune.support.quantity_text import change_text, interval_text, time_text
from estune.trial.signals import Signals
from plants.diagnosis.interval import Interval
from plants.diagnosis.report.plant_units import in_own_units, own_names
from plants.effects import TorqueRipple
from plants.models.model_file import load_model, save_model

LABELS = {"measurement": "temperature, K", "command": "heating power, W"}


def oven():
    plant = control.tf([0.5], [600.0, 1.0])
    return plants.linear_plant(plant, dead_time_s=20.0, noise_rms_N=5e-4, **LABELS)


@pytest.mark.parametrize(
    ("measurement", "command", "P", "I", "D"),
    [
        ("N", "N", "N/N", "1/s", "s"),
        ("K", "W", "W/K", "W/(K s)", "W s/K"),
        ("rad/s", "V", "V/(rad/s)", "V/(rad/s)/s", "V s/(rad/s)"),
        ("", "", "", "1/s", "s"),
        ("K", "", "1/K", "1/(K s)", "1 s/K"),
    ],
)
def test_units_of_gains_follow_from_those_of_the_signals(measurement, command, P, I, D):
    assert gain_units(measurement, command) == {"P": P, "I": I, "D": D, "setpoint_filter_s": "s"}


def test_times_are_shown_in_the_unit_that_suits_them():
    times = (5e-5, 0.0276, 1.5, 599.0, 4390.0, 86_400.0)
    assert [*map(time_text, times)] == ["50 µs", "27.6 ms", "1.5 s", "599 s", "73.2 min", "24 h"]


def test_interval_has_the_digits_that_distinguish_its_ends():
    assert interval_text(49.357, (49.02, 49.7), "W/K", 3) == "49.4 W/K (49 to 49.7)"
    assert interval_text(39.01, (38.96, 39.04), "s", 2) == "39.01 s (38.96 to 39.04)"
    assert interval_text(39.0, (39.0, 39.0), "s", 2) == "39 s"


def test_change_has_its_unit_once_where_both_have_the_same():
    assert change_text("193 ms", "30.3 ms") == "193 → 30.3 ms"
    assert change_text("1.5 s", "30.3 ms") == "1.5 s → 30.3 ms"
    assert change_text("not reached", "30 ms") == "not reached → 30 ms"


@pytest.mark.usefixtures("undrawn")
def test_result_of_an_oven_is_in_its_own_units():
    options = {"tuner": "safe_bayesian", "tolerance": 0.0, "trials": 4, "repeats": 2}
    options["cost"] = "tracking_and_rejection"
    result = tune(oven(), journal=False, watch=None, **options)
    rows = {row.label: row.start for row in result.rows()}
    assert rows["P"].split("(")[0].endswith("W/K")
    assert rows["steady-state error"].endswith(" K")
    assert rows["rise time"].endswith(" min")
    assert rows["IAE"].endswith(" K s")
    assert rows["peak after the load"].endswith(" K")
    text = render(page(result))
    assert "Temperature and heating power" in text
    assert "Temperature less its setpoint after a load of" in text
    assert "ITAE" in text
    for shown in (repr(result), text.split("</style>")[1]):
        assert "tension" not in shown.lower()
        assert "N/N" not in shown


def test_gains_by_themselves_have_no_unit_but_the_filter():
    assert str(Gains(2.0, 1.0, 0.5, 0.1)) == "P 2, I 1, D 0.5, setpoint filter 0.1 s"
    assert oven().rig().describe().name == "simulated-plant"


def test_plant_shows_its_signals_and_only_limits_that_it_has():
    shown = oven()._repr_html_()
    assert "heating power</td>" in shown
    assert "temperature</td>" in shown
    assert "0 to 1 K at" in shown
    assert "e+09" not in shown + repr(plants.stage(2.0, 8.0))
    reel = plants.reference_reel() + plants.CoulombFriction(0.02)
    assert "control effort, -120 to 120 N" in reel._repr_html_()
    assert "with Coulomb friction" in reel._repr_html_()


def test_channels_of_records_have_the_names_and_units_of_the_plant():
    assert oven().scale.channel("tension_N") == ("temperature", "K")
    assert oven().scale.channel("current_A") == ("heating power", "W")
    assert plants.reference_reel().scale.channel("tension_N") == ("tension", "N")
    assert plants.stage(2.0, 8.0).scale.channel("angle_rad") == ("position", "m")


def test_law_of_gains_has_the_units_of_its_rigs():
    places = [(0.5, 1.0), (0.8, 1.6), (1.1, 2.2), (1.4, 2.8)]
    tunings = [
        TunedGains(
            "", at, 20.0, Gains(P, P / 9.0, P, 1.0), None, 0.5, 0.0, safe=True, converged=True
        )
        for at, P in places
    ]
    law = fit_law(tunings, signals=Signals(**LABELS))
    assert "W/(K s) per metre" in law.sentence
    assert law.sentence.endswith("temperature was not varied")


def test_labels_of_a_reel_are_not_sent_so_that_older_clients_understand():
    reel = Description(plants.reference_reel().rig().describe(), "0", "0")
    assert b"measurement" not in messages.encode(reel)
    assert decode_description(messages.encode(reel)) == reel
    hot = Description(oven().rig().describe(), "0", "0")
    assert decode_description(messages.encode(hot)) == hot
    assert decode_description(messages.encode(hot)).rig.measurement == LABELS["measurement"]
    assert reel.rig.gain_units == GAIN_UNITS


def test_model_file_keeps_the_labels(tmp_path):
    save_model(oven(), tmp_path / "oven.toml")
    loaded = load_model(tmp_path / "oven.toml").rig().describe()
    assert (loaded.measurement, loaded.command) == tuple(LABELS.values())
    assert loaded.measurement_unit == "K"


def test_waves_of_a_stage_come_back_every_so_many_metres():
    stage = plants.stage(2.0, 8.0)
    found = {
        name: in_own_units(
            TorqueRipple, name, Interval(value, 0.9 * value, 1.1 * value, unit), stage
        )
        for name, value, unit in (("per_turn", 157.08, ""), ("phase_rad", 0.5, "rad"))
    }
    assert found["per_turn"].value == pytest.approx(25.0, rel=1e-4)
    assert found["per_turn"].unit == "1/m"
    assert found["phase_rad"].unit == "rad"
    assert own_names(TorqueRipple, found, stage.scale)["per_turn"] == "per_m"
    said = TorqueRipple.sentence({"amplitude_Nm": 5.0, "per_turn": found["per_turn"].value}, stage)
    assert "every 40 mm" in said


@pytest.mark.parametrize("written", ["mNm", "mN m", "mN.m", "mN*m", "[mN\N{MIDDLE DOT}m]"])
def test_torques_are_written_in_several_ways(written):
    assert find_unit(written) == "mNm"
