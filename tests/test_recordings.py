"""Readers of recorded data, each against the library of its format."""

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
from estune.recordings.black_box_file import ROW, head
from estune.recordings.column_map import AS_NAMED
from estune.recordings.raw_file import is_readable
from estune.recordings.recording import read_recording
from tests.support_recordings import names, write_csv


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
