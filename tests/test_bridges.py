"""A rig in other programs: CDR against rosbags, a real Zenoh router, a real UDP socket."""

import json
import math
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import zenoh

from estune.bridges import cdr, ros2
from estune.bridges.viewer import TrialClock, ViewedRig, ViewedSample
from estune.errors import InvalidInput, RigError
from estune.remote.messages import Status
from estune.remote.state_machine.state import Mode
from estune.remote.zenoh import connect
from estune.remote.zenoh.put_session import PutSession
from estune.trial import Telemetry, TrialRequest
from tests.serve_rig import served
from tests.support_rigs import description

ROOT = Path(__file__).parents[1]
WITHIN_s = 30.0
NS = 1_700_000_000_123_456_789
CLOSED = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}


@pytest.fixture(scope="module")
def store():
    """ROS types of an independent library."""
    typesys = pytest.importorskip("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def header(store, frame):
    stamp = store.types["builtin_interfaces/msg/Time"](NS // 10**9, NS % 10**9)
    return store.types["std_msgs/msg/Header"](stamp, frame)


@pytest.mark.parametrize("name", ["r", "reel", "a_longer_name_of_19"])
@pytest.mark.parametrize("effort", [None, 0.25])
def test_joint_state_is_that_of_an_independent_serialiser(store, name, effort):
    kind = "sensor_msgs/msg/JointState"
    efforts = np.array([] if effort is None else [effort])
    theirs = store.types[kind](header(store, ""), [name], np.array([-1.5]), np.array([]), efforts)
    ours = cdr.joint_state(NS, name, -1.5, effort)
    assert ours == bytes(store.serialize_cdr(theirs, kind))


@pytest.mark.parametrize("frame", ["", "r", "reel", "Rolle_süd"])
def test_wrench_is_that_of_an_independent_serialiser(store, frame):
    kind, vector = "geometry_msgs/msg/WrenchStamped", store.types["geometry_msgs/msg/Vector3"]
    wrench = store.types["geometry_msgs/msg/Wrench"](vector(12.5, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    theirs = store.types[kind](header(store, frame), wrench)
    assert cdr.wrench_stamped(NS, frame, 12.5) == bytes(store.serialize_cdr(theirs, kind))


@pytest.mark.parametrize("values", [{}, {"P": "0.5"}, {"a": "", "holder": "me@here", "I": "1"}])
def test_diagnostics_are_those_of_an_independent_serialiser(store, values):
    status = store.types["diagnostic_msgs/msg/DiagnosticStatus"]
    pair = store.types["diagnostic_msgs/msg/KeyValue"]
    ours, theirs = [], []
    for level, name in ((0, "reel: rig"), (2, "x")):
        ours.append(cdr.Diagnostic(level, name, "all is well", "reel", values))
        pairs = [pair(key, value) for key, value in values.items()]
        theirs.append(status(level, name, "all is well", "reel", pairs))
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    array = store.types[kind](header(store, ""), theirs)
    assert cdr.diagnostic_array(NS, ours) == bytes(store.serialize_cdr(array, kind))


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (ros2.JOINT_STATE, "sensor_msgs/msg/JointState"),
        (ros2.WRENCH_STAMPED, "geometry_msgs/msg/WrenchStamped"),
        (ros2.DIAGNOSTIC_ARRAY, "diagnostic_msgs/msg/DiagnosticArray"),
    ],
)
def test_type_hashes_are_those_of_an_independent_library(store, kind, name):
    assert kind.type_hash == store.hash_rihs01(name)
    package, _, message = name.split("/")
    assert kind.name == f"{package}::msg::dds_::{message}_"


def test_name_that_ros_does_not_allow_is_changed():
    assert [ros2.ros_name(n) for n in ("reel-1", "7.left", "ok_2")] == [
        "reel_1",
        "rig_7_left",
        "ok_2",
    ]


def test_samples_are_stamped_from_the_first_telemetry_of_their_trial():
    def batch(trial, first, size):
        columns = [np.arange(size) + 0.5 * n for n in range(4)]
        return Telemetry(trial, first, 500.0, *columns)

    clock = TrialClock().after(one := batch("a", 10, 5), NS)
    stamps = [sample.time_ns for sample in clock.samples(one)]
    assert stamps[-1] == NS
    assert np.diff(stamps).tolist() == [2_000_000] * 4
    later = clock.after(two := batch("a", 15, 2), NS + 99)
    assert next(later.samples(two)) == ViewedSample(NS + 2_000_000, 0.0, 0.5, 1.0, 1.5)
    assert clock.after(batch("b", 0, 1), NS + 10**9).start_ns == NS + 10**9


def test_values_that_are_no_numbers_are_left_out():
    sample = ViewedSample(NS, 10.0, math.nan, math.inf, -0.2)
    assert sample.values() == {"setpoint_N": 10.0, "angle_rad": -0.2}


class Received:
    """Messages of all topics at a router, by key."""

    def __init__(self, session):
        self.samples = {}
        self._changed = threading.Condition()
        self._subscriber = session.declare_subscriber("**", self._take)

    def _take(self, sample):
        with self._changed:
            self.samples.setdefault(str(sample.key_expr), []).append(
                (sample.payload.to_bytes(), sample.attachment and sample.attachment.to_bytes())
            )
            self._changed.notify_all()

    def wait(self, condition):
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self.samples), WITHIN_s), self.samples


@pytest.fixture
def router():
    """A Zenoh router, as that of a ROS network: its session and its endpoint."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    settings = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": CLOSED}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as session:
        yield session, endpoint


def state(latched=""):
    status = Status("0f", Mode.SAFE if latched else Mode.IDLE, "", 3, "me", latched)
    return ViewedRig(NS, status, description())


def test_topics_carry_keys_attachments_and_tokens_of_rmw_zenoh(router, store):
    session, endpoint = router
    received = Received(session)
    sample = ViewedSample(NS, 10.0, 9.5, 0.5, -0.2)
    with PutSession(endpoint, "the router") as put:
        viewer = ros2.Ros2Viewer(put, description(), domain=5, drum_radius_m=0.025)
        viewer.show_samples([sample, sample])
        viewer.show_state(state())
        viewer.show_state(state("smoke"))
        viewer.show_state(ViewedRig(NS, None, None))
        kinds = ("JOINT_STATE", "WRENCH_STAMPED", "DIAGNOSTIC_ARRAY")
        topics = ("scripted/joint_states", "scripted/tension", "diagnostics")
        keys = [
            f"5/{topic}/{'/'.join(getattr(ros2, kind))}"
            for topic, kind in zip(topics, kinds, strict=True)
        ]
        received.wait(lambda s: sum(map(len, s.values())) == 7)
        assert set(received.samples) == set(keys)
        joints, forces, diagnostics = (received.samples[key] for key in keys)
        tokens = {
            str(reply.ok.key_expr)
            for reply in session.liveliness().get("@ros2_lv/**", timeout=5.0)
        }
        node = f"@ros2_lv/5/{put.session_id}/0"
        assert f"{node}/0/NN/%/%/scripted" in tokens
        for topic, key in zip(topics, keys, strict=True):
            name = "%" + topic.replace("/", "%")
            kind = key.removeprefix(f"5/{topic}/")
            assert any(
                token.startswith(node)
                and token.endswith(f"/MP/%/%/scripted/{name}/{kind}/::,10:,:,:,,")
                for token in tokens
            )
        assert len(tokens) == 4
    for messages in (joints, forces, diagnostics):
        assert [len(attachment) for _, attachment in messages] == [33] * len(messages)
        numbers = [struct.unpack("<q", attachment[:8])[0] for _, attachment in messages]
        assert numbers == list(range(1, len(messages) + 1))
        assert {attachment[16] for _, attachment in messages} == {16}
        assert len({attachment[17:] for _, attachment in messages}) == 1
    joint = store.deserialize_cdr(joints[0][0], "sensor_msgs/msg/JointState")
    assert (joint.name, *joint.position, *joint.effort) == (["scripted"], -0.2, 0.5 * 20.0 * 0.025)
    force = store.deserialize_cdr(forces[0][0], "geometry_msgs/msg/WrenchStamped")
    assert (force.header.frame_id, force.wrench.force.x) == ("scripted", 9.5)
    found = [
        store.deserialize_cdr(data, "diagnostic_msgs/msg/DiagnosticArray").status[0]
        for data, _ in diagnostics
    ]
    assert [status.level for status in found] == [0, 2, 3]
    assert found[1].message.endswith("smoke")
    assert {pair.key: pair.value for pair in found[0].values}["P"] == "0.5"


def test_bridge_to_dds_uses_the_names_of_topics_alone(router):
    session, endpoint = router
    received = Received(session)
    with PutSession(endpoint, "the router") as put:
        ros2.Ros2Viewer(put, description(), dds=True).show_state(state())
        received.wait(bool)
        assert not list(session.liveliness().get("@ros2_lv/**", timeout=1.0))
    ((_, attachment),) = received.samples["diagnostics"]
    assert not attachment


def test_rig_that_measures_no_force_has_no_force_topic(router):
    session, endpoint = router
    received = Received(session)
    with PutSession(endpoint, "the router") as put:
        rig = description(measurement="speed, rad/s")
        viewer = ros2.Ros2Viewer(put, rig)
        viewer.show_samples([ViewedSample(NS, 1.0, 1.0, 1.0, 1.0)])
        received.wait(bool)
    (key,) = received.samples
    assert "joint_states" in key


def test_missing_router_and_wrong_settings_are_refused(router):
    with pytest.raises(RigError, match="start the router of ROS"):
        PutSession("tcp/127.0.0.1:1", "the router of ROS")
    with (
        PutSession(router[1], "the router") as put,
        pytest.raises(InvalidInput, match="domain is"),
    ):
        ros2.Ros2Viewer(put, description(), domain=233)


@contextmanager
def bridge(*arguments):
    """The command, running; ended by Ctrl-C."""
    command = [sys.executable, "-m", "estune", "bridge", *arguments]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert "shown in" in process.stdout.readline()
            yield
            process.send_signal(signal.SIGINT)
            assert process.wait(WITHIN_s) == 130
        finally:
            process.kill()


def run_trial(endpoint, number):
    with connect(endpoint) as rig:
        about = rig.describe()
        return rig.run(TrialRequest(f"bridged{number}", 0, about.gains, about.step))


@contextmanager
def plotter():
    """A UDP server as that of PlotJuggler: its address, and its datagrams with samples."""
    shown, over = [], threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.1)

        def receive():
            while not over.is_set():
                with suppress(TimeoutError):
                    datagram = json.loads(receiver.recv(65536))
                    if "tension_N" in datagram["reel"]:
                        shown.append(datagram)

        thread = threading.Thread(target=receive)
        thread.start()
        try:
            yield f"127.0.0.1:{receiver.getsockname()[1]}", shown
        finally:
            over.set()
            thread.join()


def is_part(whole, part):
    """Whether the values are some of the others, in their order."""
    rest = iter(whole)
    return all(value in rest for value in part)


@pytest.mark.slow
def test_trials_are_shown_in_plotjuggler_and_ros_by_processes_of_their_own(router, store):
    session, ros = router
    received, records = Received(session), []
    with (
        served("paced simulated") as rig,
        plotter() as (to, shown),
        bridge("plotjuggler", rig.endpoint, "--to", to),
        bridge("ros2", rig.endpoint, "--to", ros),
    ):
        began_s = time.time()

        def arrived():
            forces = [v for key, v in list(received.samples.items()) if "/tension/" in key]
            return len(shown) > 300 and forces and len(forces[0]) > 300

        # The first trials may be over before the subscriptions have reached the rig.
        while not arrived():
            assert len(records) < 20
            records.append(run_trial(rig.endpoint, len(records)))
            time.sleep(0.2)
    # Telemetry is of single precision, and may lack samples.
    measured = np.concatenate([r.tension_N for r in records]).astype(np.float32).tolist()
    assert is_part(measured, [datagram["reel"]["tension_N"] for datagram in shown])
    stamps = np.array([d["timestamp"] for d in shown])
    assert np.median(np.diff(stamps)) == pytest.approx(1.0 / records[0].sampling_Hz, abs=1e-6)
    assert began_s - 1.0 < stamps[0] < stamps[-1] < time.time() + 1.0
    (forces,) = (v for key, v in received.samples.items() if "/tension/" in key)
    kind = "geometry_msgs/msg/WrenchStamped"
    seen = [store.deserialize_cdr(data, kind).wrench.force.x for data, _ in forces]
    assert is_part(measured, seen)
