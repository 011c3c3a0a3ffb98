"""Setpoints from above: their age, the dead-man, and a stream to several reels over Zenoh."""

import math
import time
from contextlib import ExitStack, contextmanager

import pytest

from estune.conformance.rig import RigConformance
from estune.errors import InvalidInput, RigError
from estune.remote.state_machine.setpoint_age import SetpointAge
from estune.remote.zenoh import SetpointStream, connect, serve
from estune.trial import SETPOINT_S, Setpoint
from plants.bench.cable_platform import RealTimePlatform
from plants.bench.cable_platform.examples import bench
from tests.support_rigs import ScriptedRig

HOLD_N = 15.0
PATIENT_S = 60.0


@pytest.fixture
def patient(monkeypatch):
    """Replies, setpoints and leases may be late: client, rigs and bench share a busy computer."""
    monkeypatch.setattr("estune.remote.zenoh.setpoint_stream.SILENT_S", PATIENT_S)
    monkeypatch.setattr("estune.remote.state_machine.setpoint_age.SETPOINT_S", PATIENT_S)
    monkeypatch.setattr("estune.remote.state_machine.rig.LEASE_S", PATIENT_S)


@contextmanager
def served_bench():
    """The two reels of the bench in this process, served; and the bench."""
    mechanism, names = bench()
    with ExitStack() as stack:
        platform = stack.enter_context(RealTimePlatform(mechanism))
        reels = [platform.reel(n, name, pace=1.0) for n, name in enumerate(names)]
        servers = [stack.enter_context(serve(reel)) for reel in reels]
        yield platform, servers


@contextmanager
def connected(servers):
    with ExitStack() as stack:
        yield [stack.enter_context(connect(server.endpoint)) for server in servers]


class TestReelOfAPlatform(RigConformance):
    @pytest.fixture(scope="class")
    @classmethod
    def endpoint(cls):
        with served_bench() as (_, servers):
            yield servers[0].endpoint


# --- age ---


def test_setpoints_older_than_the_last_are_dropped_whatever_the_clocks():
    first = SetpointAge().next("a", 1e6, 10.0)
    assert first.next("a", 1e6, 10.1) is None
    assert first.next("a", 1e6 - 1.0, 10.1) is None
    assert first.next("a", 1e6 + 0.1, 10.1) is not None
    assert first.next("b", 3.0, 10.1) is not None  # another lease, another clock


def test_setpoint_longer_under_way_than_the_quickest_is_dropped():
    slow = SetpointAge().next("a", 0.0, 10.15)
    quick = slow.next("a", 0.2, 10.2)
    assert quick.difference_s == pytest.approx(10.0)
    assert quick.next("a", 0.3, 10.3 + 0.99 * SETPOINT_S) is not None
    assert quick.next("a", 0.3, 10.3 + 1.01 * SETPOINT_S) is None


def test_clock_that_drifts_ages_no_setpoint():
    age = SetpointAge().next("a", 0.0, 0.0)
    for second in range(1, 10_000):
        age = age.next("a", second * (1.0 - 5e-4), float(second))
        assert age is not None


# --- dead-man ---


def test_setpoint_is_in_force_for_its_time_and_then_the_reel_returns_to_its_hold_tension():
    platform = RealTimePlatform(bench()[0])
    period_s = 1.0 / platform.simulation.mechanism.sampling_Hz
    platform.follow(0, Setpoint(25.0))
    in_force = math.floor(SETPOINT_S / period_s)
    for _ in range(in_force):
        platform._sample(period_s)
    assert platform.simulation.setpoints.tension_N[0] == 25.0
    for _ in range(round(1.0 / period_s)):
        platform._sample(period_s)
    assert platform.simulation.setpoints.tension_N[0] == HOLD_N
    assert platform.simulation.tension_N[0] == pytest.approx(HOLD_N, abs=1.0)


def test_reel_over_its_guard_holds_its_angle_and_follows_nothing_until_cleared():
    platform = RealTimePlatform(bench()[0])
    period_s = 1.0 / platform.simulation.mechanism.sampling_Hz
    platform.simulation.force[:] = 100.0  # a user jerks
    while platform.simulation.setpoints.in_tension[0]:
        platform._sample(period_s)
    with pytest.raises(RigError, match=r"safe state .*tension"):
        platform.follow(0, Setpoint(20.0))
    platform.simulation.force[:] = 0.0
    for _ in range(1000):
        platform._sample(period_s)
    platform.clear(0)
    assert platform.follow(0, Setpoint(20.0)).tension_N < 60.0


# --- stream ---


def is_near(value, wanted, within):
    return abs(value - wanted) < within


def send_until(stream, setpoints, holds):
    """Sends setpoints until the feedback is as it should be, however slow the bench is."""
    end_s = time.monotonic() + PATIENT_S
    while not holds(*(feedback := stream.exchange(setpoints).feedback)):
        assert time.monotonic() < end_s, feedback


@pytest.mark.usefixtures("patient")
def test_stream_drives_both_reels_in_tension_and_in_position():
    with served_bench() as (platform, servers), connected(servers) as rigs:
        stream = SetpointStream(rigs, 100.0)
        first = stream.exchange([Setpoint(20.0), Setpoint(20.0)])
        angle = first.feedback[1].angle_rad
        send_until(
            stream,
            [Setpoint(20.0), Setpoint(HOLD_N, angle)],
            # Position control takes what X pulls, less twice the friction of the eyelets.
            lambda x, y: (
                is_near(x.tension_N, 20.0, 1.0)
                and is_near(y.angle_rad, angle, 0.05)
                and HOLD_N + 1.0 < y.tension_N <= 21.0
            ),
        )
        end_s = time.monotonic() + PATIENT_S
        while not is_near(platform.simulation.tension_N[0], HOLD_N, 1.0):  # the source pauses
            assert time.monotonic() < end_s
            time.sleep(0.01)


@pytest.mark.usefixtures("patient")
def test_second_source_is_refused_with_the_holder():
    with served_bench() as (_, servers), connected(servers) as rigs:
        SetpointStream(rigs, 100.0).exchange([Setpoint(20.0)] * 2)
        with connect(servers[0].endpoint, holder="second") as other:
            second = SetpointStream([other], 100.0)
            with pytest.raises(RigError, match="the rig is held by"):
                second.exchange([Setpoint(20.0)])


@pytest.mark.usefixtures("patient")
def test_setpoints_outside_the_limits_and_to_rigs_without_them_are_refused():
    with served_bench() as (_, servers), connected(servers) as rigs:
        stream = SetpointStream(rigs, 100.0)
        with pytest.raises(InvalidInput, match="outside the rig's range"):
            stream.exchange([Setpoint(15.0), Setpoint(41.0)])
    with pytest.raises(InvalidInput, match="finite"):
        Setpoint(math.nan)
    with pytest.raises(InvalidInput, match="too few"):
        SetpointStream([], 5.0)
    with serve(ScriptedRig()) as server, connect(server.endpoint) as rig:
        stream = SetpointStream([rig], 100.0)
        with pytest.raises(RigError, match="trials only"):
            stream.exchange([Setpoint(15.0)])


def test_rig_older_than_the_verb_is_named():
    with serve(ScriptedRig()) as server, connect(server.endpoint) as rig:
        rig.acquire()
        rig._connection.instance = "00000000"  # no rig answers commands to it
        stream = SetpointStream([rig], 100.0)
        with pytest.raises(RigError, match="followed no setpoint"):
            stream.exchange([Setpoint(15.0)])
