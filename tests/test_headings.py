"""Headings of tables as programs and manuals write them: understood, or asked for by name."""

import numpy as np
import pytest

from estune.cli import run
from estune.errors import InvalidInput
from estune.recordings.issue import Unusable
from estune.recordings.loop_log import read_loop_log
from estune.recordings.recording import read_recording
from estune.recordings.units import Drum
from estune.studies.law.start import start_from

RATE_Hz = 100.0
COUNT = 60
T = np.arange(COUNT) / RATE_Hz
SIGNALS = {
    "time": T,
    "setpoint": 50.0 + 5.0 * (np.arange(COUNT) % 20 > 9),
    "measurement": 50.0 + np.sin(9.0 * T),
    "effort": 30.0 + np.cos(9.0 * T),
}
"""What each log shows, in s and in the unit of its measurement."""

S, ms, us = 1.0, 1e3, 1e6

UNDERSTOOD = {
    # program or manual: (lines above the data, columns of the data, separator)
    "Arduino plotter": ("millis,Setpoint,Input,Output", "time*1000 setpoint x effort", ","),
    "Arduino PID example": ("Time (ms),Setpoint,Temp (C),PWM", "time*1000 setpoint y effort", ","),
    "Marlin by OctoPrint": ("time_s,target,actual,output", "time setpoint y effort", ","),
    "Klipper graph": ("time,target,temperature,pwm", "time setpoint y effort", ","),
    "Siemens trace": (
        "Zeit [ms];Sollwert [1/min];Istwert [1/min];Stellgröße [%]",
        "time*1000 setpoint y effort",
        ";,",
    ),
    "CODESYS trace": ("TimeStamp (us);SP;PV;OP", "time*1000000 setpoint y effort", ";"),
    "Rockwell trend": ("Time [s],Loop.SP,Loop.PV,Loop.CV", "time setpoint y effort", ","),
    "Rigol oscilloscope": ("t,sp,pv,out\n(ms),(V),(V),(V)", "time*1000 setpoint y effort", ","),
    "PicoScope": ("Time,SP,PV,OP\n(ms),(mV),(mV),(V)\n", "time*1000 setpoint y effort", ","),
    "Tektronix": (
        "Record Length,60\nSample Interval,0.01\n\nTIME (s),Setpoint (V),Actual (V),Output (V)",
        "time setpoint y effort",
        ",",
    ),
    "LabVIEW text": (
        "Time (s)\tSetpoint\tProcess Variable\tOutput",
        "time setpoint y effort",
        "\t",
    ),
    "dSPACE ControlDesk": (
        'descriptor,"trace"\ncapture,1\n\nTime [s],Setpoint [rad/s],Speed [rad/s],Duty [%]',
        "time setpoint y effort",
        ",",
    ),
    "ODrive liveplotter": (
        "t (s),axis0.controller.vel_setpoint,axis0.encoder.vel_estimate,duty",
        "time setpoint y effort",
        ",",
    ),
    "Betaflight decoded": (
        "time (us),setpoint,measured,output",
        "time*1000000 setpoint y effort",
        ",",
    ),
    "Beckhoff Scope": (
        "Name;Scope\nStart;5\n\nTime [ms];Target [mm];Position [mm];Output [%]",
        "time*1000 setpoint y effort",
        ";,",
    ),
    "numpy savetxt": ("# time_s setpoint measured effort", "time setpoint y effort", " "),
    "speed drive, DIN": (
        "t / ms;n_soll;ist / 1/min;Output / %",
        "time*1000 setpoint y effort",
        ";",
    ),
    "units after commas": (
        '"Time, ms","Setpoint, °C","Temperature, °C","Output, %"',
        "time*1000 setpoint y effort",
        ",",
    ),
    "camel letters": ("timeMs,targetSpeed,rpm,pwm", "time*1000 setpoint y effort", ","),
    "blanks": ("Time ms\tSP rpm\tSpeed rpm\tOP %", "time*1000 setpoint y effort", "\t"),
    "braces": ("Time {s}|SP {K}|PV {K}|CO {%}", "time setpoint y effort", "|"),
    "minutes": ("Elapsed time (min),SP,PV,CO", "time/60 setpoint y effort", ","),
    "byte order mark": ("\ufeffTime [s],SP,PV,OP", "time setpoint y effort", ","),
    "Grafana": ("Time,Setpoint,Temperature,Output", "epoch setpoint y effort", ","),
}
ASKED = {
    "two speeds": (
        "Time [ms],PWM (%),Speed (rpm)",
        "time*1000 effort y",
        "no channel is the setpoint",
    ),
    "Arduino brackets": (
        "Time [ms],Drehzahl links,Drehzahl rechts,SP",
        "time*1000 y effort setpoint",
        "no channel is the measurement; .* Drehzahl",
    ),
    "Home Assistant": (
        "taken at,climate.setpoint,climate.current_temperature,boiler_flow",
        "time setpoint y effort",
        "no channel is the time; .* taken at",
    ),
    "two setpoints": (
        "Time [s],left/setpoint,right/setpoint,speed",
        "time setpoint effort y",
        "left/setpoint, right/setpoint could each be the setpoint",
    ),
    "same name twice": (
        "Time [s],SP,Speed,Speed",
        "time setpoint y effort",
        "Speed, Speed#2 could each be the measurement",
    ),
    "hour meter": ("hour meter,SP,PV,OP", "time setpoint y effort", "no channel is the time"),
}
TAKEN = {"x": "measurement", "y": "measurement"}


def column(text):
    if text == "epoch":
        return 1_700_000_000.0 + SIGNALS["time"]
    name, _, factor = text.replace("/", "*1/").partition("*")
    scale = eval(factor or "1")  # noqa: S307  a factor of the table above
    return SIGNALS[TAKEN.get(name, name)] * scale


def written(folder, head, columns, separator):
    decimal, separator = ("," if separator == ";," else "."), separator[0]
    rows = zip(*(column(text) for text in columns.split()), strict=True)
    lines = [
        separator.join(f"{x:.9g}".replace(".", decimal) if x < 1e8 else f"{x:.3f}" for x in row)
        for row in rows
    ]
    path = folder / "log.csv"
    path.write_bytes("\r\n".join([*head.split("\n"), *lines, ""]).encode())
    return path


@pytest.mark.parametrize("case", UNDERSTOOD)
def test_heading_is_understood_with_its_units(tmp_path, case):
    head, columns, separator = UNDERSTOOD[case]
    path = written(tmp_path, head, columns, separator)
    given = {"measurement": "Input"} if "Input" in head else {}
    log = read_loop_log(path, given)
    (part,) = log.parts
    assert log.sampling_Hz == pytest.approx(RATE_Hz, rel=1e-4)
    for name in ("setpoint", "measurement", "effort"):
        np.testing.assert_allclose(part[name], SIGNALS[name], rtol=1e-6)
    assert not [issue for issue in log.issues if issue.level == "doubt"]
    again = read_loop_log(path, log.sources)  # whatever name is printed is accepted back
    assert again.sources == log.sources


@pytest.mark.parametrize("case", ASKED)
def test_heading_that_is_not_understood_is_asked_for_by_name(tmp_path, case):
    head, columns, message = ASKED[case]
    with pytest.raises(Unusable, match=message) as refusal:
        read_loop_log(written(tmp_path, head, columns, ","))
    assert "--map" in str(refusal.value)


def table(path, head, *columns, encoding="utf-8"):
    rows = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    path.write_bytes("\n".join([head, *rows]).encode(encoding))
    return path


@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252", "utf-16"])
def test_units_of_headings_become_those_of_a_record(tmp_path, encoding):
    x = np.sin(9.0 * T)
    head = "Time (µs),Tension [kgf],Current / mA,Angle {°},Torque"
    path = table(tmp_path / "log.csv", head, us * T, x, ms * x, x, x, encoding=encoding)
    recording = read_recording(path)
    (part,) = recording.parts
    np.testing.assert_allclose(part["time_s"], T, atol=1e-9)
    np.testing.assert_allclose(part["tension_N"], 9.80665 * x)
    np.testing.assert_allclose(part["current_A"], x, atol=1e-12)
    np.testing.assert_allclose(part["angle_rad"], np.radians(x))
    (ignored,) = (issue for issue in recording.issues if issue.column == "Torque")
    assert "ignored" in ignored.sentence


def test_units_of_another_quantity_are_those_of_the_plant_but_not_of_a_reel(tmp_path):
    path = table(tmp_path / "log.csv", "Time [s],Tension [°C],Current [%]", T, 20.0 + T, T)
    recording = read_recording(path)
    np.testing.assert_allclose(recording.parts[0]["tension_N"], 20.0 + T)
    assert sum("units of the plant's own" in issue.sentence for issue in recording.issues) == 2
    with pytest.raises(Unusable, match="none of the columns"):
        read_recording(path, drum=Drum(0.025, 20.0))


def test_setpoint_is_brought_to_the_unit_of_the_measurement(tmp_path):
    path = table(tmp_path / "log.csv", "t [s],SP [°F],PV [°C]", T, 212.0 + 0.0 * T, 99.0 + T)
    (part,) = read_loop_log(path).parts
    np.testing.assert_allclose(part["setpoint"], 100.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "step", "measurement", "doubted"),
    [
        *(("t", step, "speed", True) for step in (1, 2, 5, 10, 20, 100, 1000)),
        ("t", 10.02, "speed", True),
        ("time", 10, "temperature", True),
        ("time", 1, "temperature", False),  # usual
        *(("time", step, "speed", False) for step in (0.01, 0.5, 60, 300)),
        ("time_s", 10, "speed", False),
        ("t[s]", 10, "speed", False),
        ("t [ms]", 10, "speed", False),
        ("millis", 10, "speed", False),
    ],
)
def test_time_without_a_unit_is_doubted_where_milliseconds_are_more_usual(
    tmp_path, name, step, measurement, doubted
):
    stamps = 123 * step + step * np.arange(COUNT)
    path = table(tmp_path / "log.csv", f"{name},sp,{measurement}", stamps, T, T)
    issues = read_loop_log(path).issues
    assert [issue.level for issue in issues].count("doubt") == doubted
    if doubted:
        assert f"--map 'time={name}[ms]' if it is in ms" in issues[0].sentence
        for unit, rate in (("s", 1.0 / step), ("ms", 1e3 / step)):
            mapped = read_loop_log(path, {"time": f"{name}[{unit}]"})
            assert mapped.sampling_Hz == pytest.approx(rate, rel=1e-6)
            assert not [issue for issue in mapped.issues if issue.level == "doubt"]


def test_doubt_is_the_first_line_and_starts_no_tuning(tmp_path, capsys):
    path = table(tmp_path / "log.csv", "t,sp,pv", 10 * np.arange(COUNT), T, T)
    assert run(["records", str(path)]) == 0
    assert capsys.readouterr().out.startswith("doubt  t has no unit and is read as seconds")
    with pytest.raises(InvalidInput, match="write the unit into the heading"):
        start_from(f"records:{path}")(None, None, None)


def test_name_with_a_comma_is_accepted_in_a_map(tmp_path, capsys):
    path = table(tmp_path / "log.csv", '"t, ms","fan, %","room, °C","wish, °C"', ms * T, T, T, T)
    given = "effort=fan, %,measurement=room, °C,setpoint=wish, °C"
    assert run(["records", str(path), "--map", given]) == 0
    assert "usable" in capsys.readouterr().out


@pytest.mark.parametrize("map_", ["setpoint=nope", "current=nope"])
def test_map_of_a_column_that_is_not_there_is_refused_also_by_a_log_that_needs_none(
    map_, tmp_path, capsys
):
    path = table(tmp_path / "log.csv", "t,sp,pv,effort", T, T, T, T)
    assert run(["records", str(path)]) == 0
    assert run(["records", str(path), "--map", map_]) == 2
    assert "there is no nope; the file has t, sp, pv, effort" in capsys.readouterr().err
