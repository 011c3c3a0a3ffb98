"""Readers of recorded data, each against the library of its format; units, gaps, resampling."""

import json
import warnings

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from mcap import writer as mcap_writer

from estune.conformance.recordings import RATE_Hz, ReaderConformance, columns
from estune.errors import InvalidInput
from estune.recordings.black_box_file import ROW, head
from estune.recordings.column_map import AS_NAMED, read_column_map
from estune.recordings.issue import Unusable
from estune.recordings.raw_file import is_readable
from estune.recordings.recording import read_recording
from estune.recordings.units import Drum


def names(**sources):
    return AS_NAMED.with_options(sources, {}, {})


def write_csv(path, written, separator=",", decimal="."):
    pd.DataFrame(written).to_csv(path, sep=separator, decimal=decimal, index=False)


class TestCommaSeparated(ReaderConformance):
    ending = ".csv"

    def write(self, path, written):
        write_csv(path, written)


class TestSemicolonAndDecimalComma(ReaderConformance):
    ending = ".csv"

    def write(self, path, written):
        write_csv(path, written, ";", ",")


class TestTabSeparated(ReaderConformance):
    ending = ".tsv"

    def write(self, path, written):
        write_csv(path, written, "\t")


class TestParquet(ReaderConformance):
    ending = ".parquet"

    def write(self, path, written):
        pq.write_table(pa.table(dict(written)), path)


class TestMatlab5(ReaderConformance):
    ending = ".mat"

    def write(self, path, written):
        scipy.io.savemat(path, {"log": dict(written), "author": "somebody", "fs": 632.0})


class TestMatlab73(ReaderConformance):
    ending = ".mat"

    def write(self, path, written):
        matio = pytest.importorskip("matio")
        matio.save_to_mat(path, dict(written), version="v7.3")


class TestTimetable(ReaderConformance):
    ending = ".mat"
    column_map = names(time="Time")
    stamp_s = 2e-9

    def write(self, path, written):
        matio = pytest.importorskip("matio")
        left = {name: values for name, values in written.items() if name != "time_s"}
        index = pd.to_timedelta(written["time_s"], unit="s").rename("Time")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", matio.utils.matclass.MatConvertWarning)
            matio.save_to_mat(path, {"log": pd.DataFrame(left, index=index)}, version="v7")


class TestTdms(ReaderConformance):
    ending = ".tdms"

    def write(self, path, written):
        nptdms = pytest.importorskip("nptdms")
        with nptdms.TdmsWriter(path) as writer:
            writer.write_segment(
                [nptdms.ChannelObject("reel", name, values) for name, values in written.items()]
            )


class TestBlackBox(ReaderConformance):
    ending = ".blackbox"

    def write(self, path, written):
        rows = np.zeros(len(written["time_s"]), ROW)
        rows["sample"] = 1 + np.arange(rows.size)
        for name, values in written.items():
            rows[name] = values
        path.write_bytes(head({"sampling_Hz": RATE_Hz, "loop": "closed"}) + rows.tobytes())


JOINT = {"current_A": "effort[0]", "setpoint_N": "position[1]", "angle_rad": "position[0]"}


class _Bag(ReaderConformance):
    """Current, setpoint and angle as a JointState, tension as a WrenchStamped."""

    column_map = AS_NAMED.with_options(
        {
            **{n: f"/joint_states.{f}" for n, f in JOINT.items()},
            "tension": "/gauge.wrench.force.x",
        },
        {},
        {},
    )
    stamp_s = 1e-9

    def write(self, path, written):
        store = pytest.importorskip("rosbags.typesys").get_typestore(self.store())
        kinds = {"/joint_states": "JointState", "/gauge": "WrenchStamped"}
        packages = {"JointState": "sensor_msgs/msg/", "WrenchStamped": "geometry_msgs/msg/"}
        with self.writer(path) as bag:
            connections = {}
            for topic, kind in kinds.items():
                if topic == "/gauge" and "tension_N" not in written:
                    continue
                if topic != "/gauge" and "current_A" not in written:
                    continue
                name = packages[kind] + kind
                connections[topic] = bag.add_connection(topic, name, typestore=store), name
            for k, time_s in enumerate(written["time_s"]):
                ns = round(time_s * 1e9)
                for topic, (connection, name) in connections.items():
                    make = self.gauge if topic == "/gauge" else self.joint
                    data = make(store.types, written, k, ns + 1_000_000_000)
                    # Logged late and unevenly: it is the header's stamp that counts.
                    bag.write(connection, ns + 7_000_000 * (k % 3), self.pack(store, data, name))

    def header(self, types, ns):
        stamp = types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
        counted = (0,) if "ROS1" in str(self.store()) else ()
        return types["std_msgs/msg/Header"](*counted, stamp, "reel")

    def joint(self, types, written, k, ns):
        nan = np.full_like(written["time_s"], np.nan)
        value = {name: written.get(name, nan)[k] for name in JOINT}
        return types["sensor_msgs/msg/JointState"](
            self.header(types, ns),
            ["drum", "setpoint"],
            np.array([value["angle_rad"], value["setpoint_N"]]),
            np.array([]),
            np.array([value["current_A"]]),
        )

    def gauge(self, types, written, k, ns):
        vector = types["geometry_msgs/msg/Vector3"]
        wrench = types["geometry_msgs/msg/Wrench"](
            vector(written["tension_N"][k], 0.0, 0.0), vector(0.0, 0.0, 0.0)
        )
        return types["geometry_msgs/msg/WrenchStamped"](self.header(types, ns), wrench)

    def pack(self, store, data, name):
        return store.serialize_cdr(data, name)


class TestRos1Bag(_Bag):
    ending = ".bag"

    def store(self):
        return pytest.importorskip("rosbags.typesys").Stores.ROS1_NOETIC

    def writer(self, path):
        return pytest.importorskip("rosbags.rosbag1").Writer(path)

    def pack(self, store, data, name):
        return store.serialize_ros1(data, name)


class TestRos2Bag(_Bag):
    ending = ""

    def store(self):
        return pytest.importorskip("rosbags.typesys").Stores.ROS2_JAZZY

    def writer(self, path):
        return pytest.importorskip("rosbags.rosbag2").Writer(path, version=9)

    def bytes_of(self, path):
        return next(path.glob("*.db3"))

    def read(self, path):
        return read_recording(path / "metadata.yaml", self.column_map)


class TestRosMcap(TestRos2Bag):
    ending = ""

    def writer(self, path):
        rosbag2 = pytest.importorskip("rosbags.rosbag2")
        return rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)

    def bytes_of(self, path):
        return next(path.glob("*.mcap"))

    def read(self, path):
        alone = path.with_suffix(".mcap")  # without its metadata.yaml
        alone.write_bytes(self.bytes_of(path).read_bytes())
        return read_recording(alone, self.column_map)


class TestJsonMcap(ReaderConformance):
    ending = ".mcap"

    def write(self, path, written):
        with path.open("wb") as file:
            writer = mcap_writer.Writer(file)
            writer.start()
            schema = writer.register_schema("sample", "jsonschema", b"{}")
            channel = writer.register_channel("/reel", "json", schema)
            for k, time_s in enumerate(written["time_s"]):
                data = json.dumps({"log": {name: v[k] for name, v in written.items()}}).encode()
                ns = 1_700_000_000_000_000_000 + round(time_s * 1e9)
                writer.add_message(channel, ns, data, ns)
            writer.finish()


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
    assert any("as its name ends" in issue.sentence for issue in read.issues) == (taken != "rad")


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


def test_bag_is_one_recording_of_its_folder_and_other_files_are_read_beside_it(tmp_path):
    bag = tmp_path / "bag"
    TestRos2Bag().write(bag, columns())
    write_csv(tmp_path / "LOG.CSV", columns())
    (tmp_path / "metadata.yaml").write_text("author: somebody\n")
    readable = {
        path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if is_readable(path)
    }
    assert readable == {"LOG.CSV", "bag/metadata.yaml"}
    assert read_recording(tmp_path / "LOG.CSV").parts


def test_object_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "log.mcap.zstd").write_bytes(b"")
    with pytest.raises(Unusable, match=r"zstd -d log\.mcap\.zstd"):
        read_recording(tmp_path / "log.mcap.zstd")
