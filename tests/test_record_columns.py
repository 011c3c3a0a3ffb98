"""Columns of a record: their names, units and clocks in a file."""

import numpy as np
import pytest

from estune.conformance.recordings import columns
from estune.errors import InvalidInput
from estune.recordings.column_map import AS_NAMED, read_column_map
from estune.recordings.issue import DataIssue, Unusable, refusals
from estune.recordings.recording import read_recording
from estune.recordings.units import Drum
from tests.support_recordings import names, write_csv

MAP = """
[column.time_s]
from = "t"
unit = "ms"

[column.tension_N]
from = "F"
unit = "lbf"
scale = -1.0
offset = 2.0

[column.current_A]
from = "M"
unit = "mNm"

[column.angle_rad]
from = "x"
unit = "mm"

[record]
cable_length_m = 1.1
loop = "open"
"""


def test_map_turns_foreign_columns_into_those_of_a_record(tmp_path):
    c, drum = columns(), Drum(radius_m=0.025, newtons_per_ampere=20.0)
    foreign = {
        "t": 1e3 * c["time_s"],
        "F": 2.0 - c["tension_N"] / 4.4482216152605,
        "M": 1e3 * 0.5 * c["current_A"],
        "x": 1e3 * 0.025 * c["angle_rad"],
    }
    write_csv(tmp_path / "log.csv", foreign, " ")
    (tmp_path / "map.toml").write_text(MAP)
    read = read_column_map(tmp_path / "map.toml")
    read.save(tmp_path / "saved.toml")
    assert read_column_map(tmp_path / "saved.toml") == read
    recording = read_recording(tmp_path / "log.csv", read, drum)
    for name, values in recording.parts[0].items():
        np.testing.assert_allclose(values, c[name], rtol=1e-12, atol=1e-12)
    assert recording.metadata.values == {"cable_length_m": 1.1, "loop": "open"}
    with pytest.raises(Unusable, match="torque becomes current by a reel's radius"):
        read_recording(tmp_path / "log.csv", read)


def test_units_of_the_heading_are_used_and_contradictions_refused(tmp_path):
    c = columns()
    path = tmp_path / "log.csv"
    heading = "time [ms];force (kN);current\n"
    rows = zip(1e3 * c["time_s"], 1e-3 * c["tension_N"], c["current_A"], strict=True)
    table = "\n".join(";".join(map(str, row)) for row in rows)
    path.write_text(f"# made by hand\n{heading}{table}\n")
    sources = {"time": "time", "tension": "force", "current": "current"}
    (part,) = read_recording(path, names(**sources)).parts
    np.testing.assert_allclose(part["tension_N"], c["tension_N"], rtol=1e-14)
    with pytest.raises(Unusable, match="in kN by the file and in N by the map"):
        read_recording(path, AS_NAMED.with_options(sources, {"tension": "N"}, {}))


def test_duty_of_a_drive_without_a_torque_constant_is_taken_as_it_is_and_told(tmp_path):
    c = columns()
    foreign = {"time_s": c["time_s"], "PWM (%)": c["current_A"], "angle_rad": c["angle_rad"]}
    write_csv(tmp_path / "log.csv", foreign)
    read = read_recording(tmp_path / "log.csv", names(current="PWM"), Drum(1.0, 1.0))
    np.testing.assert_allclose(read.parts[0]["current_A"], c["current_A"])
    assert any("is in % and taken as it is" in issue.sentence for issue in read.issues)
    with pytest.raises(Unusable, match="share is not current"):
        read_recording(tmp_path / "log.csv", names(current="PWM"), Drum(0.02, 40.0))


def test_speed_in_place_of_the_angle_is_integrated_and_told(tmp_path):
    c = columns()
    turned = 1.0 - np.cos(40.0 * c["time_s"])
    rpm = 40.0 * np.sin(40.0 * c["time_s"]) * 30.0 / np.pi
    write_csv(
        tmp_path / "log.csv", {n: c[n] for n in ("time_s", "current_A")} | {"speed_rpm": rpm}
    )
    taken = read_recording(tmp_path / "log.csv", drum=Drum(0.02, 40.0))
    assert any("is taken as the position" in issue.sentence for issue in taken.issues)
    read = read_recording(tmp_path / "log.csv", names(angle="speed_rpm"))
    np.testing.assert_array_equal(taken.parts[0]["angle_rad"], read.parts[0]["angle_rad"])
    assert read.parts[0]["angle_rad"] == pytest.approx(turned, abs=1e-3)
    assert any("a speed, and integrated" in issue.sentence for issue in read.issues)


@pytest.mark.parametrize(
    ("name", "dividing"), [("torque", 0.5), ("force", 20.0), ("current", 1.0)]
)
def test_column_named_after_a_quantity_is_read_in_its_unit(tmp_path, name, dividing):
    c, drum = columns(), Drum(radius_m=0.025, newtons_per_ampere=20.0)
    foreign = {"time_s": c["time_s"], name: c["current_A"], "angle_rad": c["angle_rad"]}
    write_csv(tmp_path / "log.csv", foreign)
    read = read_recording(tmp_path / "log.csv", names(current=name), drum)
    np.testing.assert_allclose(read.parts[0]["current_A"], c["current_A"] / dividing, rtol=1e-3)


@pytest.mark.parametrize(
    ("ending", "factor", "unit", "taken"),
    [
        ("deg", 57.3, "", "deg"),
        ("rad", 1.0, "", "rad"),
        ("in", 1.0, "", "rad"),  # a word
        ("s", 1.0, "", "rad"),  # of another dimension
        ("deg", 1.0, "rad", "rad"),  # the map says otherwise
    ],
)
def test_unit_that_a_channels_name_ends_in_is_used_and_told(tmp_path, ending, factor, unit, taken):
    c, name = columns(), f"turned_{ending}"
    foreign = {"time_s": c["time_s"], "current_A": c["current_A"], name: c["angle_rad"]}
    write_csv(tmp_path / "log.csv", foreign)
    units = {"angle": unit} if unit else {}
    read = read_recording(tmp_path / "log.csv", AS_NAMED.with_options({"angle": name}, units, {}))
    np.testing.assert_allclose(factor * read.parts[0]["angle_rad"], c["angle_rad"], rtol=1e-3)
    assert read.mapped["angle_rad"].unit == taken
    assert any("by its name" in issue.sentence for issue in read.issues) == (taken != "rad")


@pytest.mark.parametrize(
    ("heading", "words", "found"),
    [
        ("t [ms],PWM (%),Speed (rpm)", "", {"current_A": "PWM (%)", "tension_N": "Speed (rpm)"}),
        (
            "Zeit,Sollwert,Stellgrad,Istwert",
            "",
            {"setpoint_N": "Sollwert", "current_A": "Stellgrad", "tension_N": "Istwert"},
        ),
        ("time,torque,position", "", {"current_A": "torque", "angle_rad": "position"}),
        ("t,a,b", "input=a,output=b", {"current_A": "a", "tension_N": "b"}),
    ],
)
def test_columns_of_a_plant_are_found_by_its_own_words_and_told(tmp_path, heading, words, found):
    width = heading.count(",")
    rows = "\n".join(f"{10 * k}{f',{k % 7}.5' * width}" for k in range(20))
    (tmp_path / "log.csv").write_text(f"{heading}\n{rows}\n")
    sources = dict(word.split("=") for word in words.split(",") if word)
    read = read_recording(tmp_path / "log.csv", names(**sources))
    assert {n: m.source for n, m in read.mapped.items() if n != "time_s"} == found
    said = " ".join(issue.sentence for issue in read.issues)
    assert words or all(source in said for source in found.values())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (({"tensoin": "F"}, {}, {}), "did you mean tension"),
        (({}, {"tension": "pounds"}, {}), "unit 'pounds' is not known"),
    ],
)
def test_mistake_in_a_map_is_refused(options, message):
    with pytest.raises(InvalidInput, match=message):
        AS_NAMED.with_options(*options)


def test_missing_channel_lists_what_the_file_has(tmp_path):
    write_csv(tmp_path / "log.csv", columns())
    with pytest.raises(Unusable, match="there is no qm; the file has time_s, setpoint_N"):
        read_recording(tmp_path / "log.csv", names(angle="qm"))


def test_channels_of_different_rates_are_resampled_to_the_tension(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    rates = {"tension_N": 1000.0, "angle_rad": 250.0, "current_A": 100.0}
    clocks = {name: np.arange(int(2.0 * rate)) / rate for name, rate in rates.items()}
    values = {name: 1.0 + np.sin(3.0 * clock) for name, clock in clocks.items()}
    with nptdms.TdmsWriter(tmp_path / "log.tdms") as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("daq", n, v, {"wf_increment": 1.0 / rates[n]})
                for n, v in values.items()
            ]
        )
    recording = read_recording(tmp_path / "log.tdms")
    (part,) = recording.parts
    time_s = part["time_s"]
    assert recording.sampling_Hz == pytest.approx(1000.0)
    np.testing.assert_allclose(part["tension_N"], values["tension_N"][: time_s.size], atol=1e-12)
    assert np.abs(part["angle_rad"] - 1.0 - np.sin(3.0 * time_s)).max() < 9.0 * 0.004**2 / 8.0
    held = np.floor(time_s * 100.0 + 1e-6) / 100.0
    np.testing.assert_allclose(part["current_A"], 1.0 + np.sin(3.0 * held), atol=1e-12)
    assert time_s[-1] <= min(clock[-1] for name, clock in clocks.items() if name != "current_A")


def test_gap_of_any_measurement_splits_the_resampled_record(tmp_path):
    c = columns()
    time_s = c["time_s"] + 0.002 * np.sin(20.0 * c["time_s"])
    kept = (np.arange(time_s.size) < 150) | (np.arange(time_s.size) >= 250)
    table = {n: v[kept] for n, v in {**c, "time_s": time_s}.items()}
    write_csv(tmp_path / "log.csv", table)
    recording = read_recording(tmp_path / "log.csv")
    before, after = (part["time_s"] for part in recording.parts)
    assert before[-1] <= table["time_s"][149] < table["time_s"][150] <= after[0]
    for stamps in (before, after):
        assert np.allclose(np.diff(stamps), 1.0 / recording.sampling_Hz)
    assert any("resampled" in issue.sentence for issue in recording.issues)


def test_rows_missing_from_an_even_clock_in_whole_seconds_leave_the_others_as_they_are(tmp_path):
    time_s = 2.0 * np.delete(np.arange(400), [50, *range(200, 240)])
    value = np.sin(0.1 * time_s)
    write_csv(tmp_path / "log.csv", {"time_s": time_s, "tension_N": value, "current_A": value})
    read = read_recording(tmp_path / "log.csv")
    assert read.sampling_Hz == pytest.approx(0.5, rel=1e-12)
    assert [part["time_s"].size for part in read.parts] == [200, 160]
    for part in read.parts:
        at = np.searchsorted(time_s, part["time_s"][:40])
        np.testing.assert_allclose(part["tension_N"][:40], value[at], atol=1e-9)


def test_stamps_in_bursts_are_refused(tmp_path):
    c = columns()
    bursts = np.repeat(np.arange(200) / 316.0, 2) + np.tile([0.0, 1e-5], 200)
    write_csv(tmp_path / "log.csv", {**c, "time_s": bursts})
    with pytest.raises(Unusable, match="record the stamps of the device"):
        read_recording(tmp_path / "log.csv")


def test_object_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "log.mcap.zstd").write_bytes(b"")
    with pytest.raises(Unusable, match=r"zstd -d log\.mcap\.zstd"):
        read_recording(tmp_path / "log.mcap.zstd")


def test_a_column_without_a_value_is_listed_as_empty(tmp_path):
    table = tmp_path / "empty.csv"
    table.write_text("time,torque,position\n" + "".join(f"{k / 100},0.1,\n" for k in range(50)))

    with pytest.raises(Unusable, match=r"time, torque, position \(no value but zero\)"):
        read_recording(table)


def test_joint_angle_and_torque_are_found_by_the_names_of_robots_in_a_drive_alone(tmp_path):
    c = columns()
    write_csv(tmp_path / "log.csv", {"t": c["time_s"], "q": c["angle_rad"], "tau": c["current_A"]})
    joint = read_recording(tmp_path / "log.csv", drum=Drum(1.0, 1.0))
    np.testing.assert_allclose(joint.parts[0]["angle_rad"], c["angle_rad"])
    np.testing.assert_allclose(joint.parts[0]["current_A"], c["current_A"])
    with pytest.raises(Unusable, match="the file has t, q, tau"):
        read_recording(tmp_path / "log.csv")


def test_a_fault_of_many_files_is_said_once():
    faults = [DataIssue("refused", "there is no time", "time", source=f"{k}.csv") for k in "abc"]
    other = DataIssue("refused", "the file is empty", source="d.csv")
    said = "a.csv, b.csv, c.csv, column time: there is no time; d.csv: the file is empty"
    assert refusals([*faults, other]) == said
