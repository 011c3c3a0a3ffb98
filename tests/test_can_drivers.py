"""An ODrive with a gauge on CAN, the clock of a board, and faults of either."""

import math
import socket
import struct
import threading
import time
from contextlib import suppress

import numpy as np
import pytest

from estune.cli.checks import State
from estune.cli.checks.driver_checks import check_exchange, check_readings
from estune.errors import InvalidInput, RigError
from estune.hardware.driver import Drive, Driver, load_part
from estune.hardware.drivers.board_clock import BoardClock, unwrapped
from estune.hardware.drivers.can_bus import CanSocket, Frame
from estune.hardware.drivers.can_gauge import CanGauge
from estune.hardware.drivers.odrive import ODrive
from estune.hardware.exchange_timing import ExchangeTiming

PATIENT_s = 3.0
"""Time within which an answer must come: the test machine may be busy."""


def test_board_clock_follows_the_fastest_answers_through_wraps_and_drift():
    clock, delays = BoardClock(), [0.4e-3, 0.1e-3, 0.9e-3, 0.1e-3] * 500
    begin_us = 2**32 - 1_000_000  # wraps after a second
    for k, delay_s in enumerate(delays):
        board_us = begin_us + round(k * 1582 * (1.0 - 1e-4))  # 100 ppm slow
        clock = clock.stamped(board_us % 2**32, 50.0 + k * 1582e-6 + delay_s)
        if k > 1:
            assert abs(clock.time_s - (50.0 + k * 1582e-6)) < 0.2e-3
    assert unwrapped(-(2**31), 2**31 - 1) == 2**31
    assert unwrapped(2**31 - 1, -(2**31)) == -(2**31) - 1


@pytest.fixture
def bus(tmp_path):
    """The far end of a bus with one port, and its address."""
    address = str(tmp_path / "bus")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(address)
        listener.listen()
        yield address, listener


def test_frames_have_the_layout_of_linux(bus):
    address, listener = bus
    odrive = ODrive(address, 3, newton_metres_per_count=0.5, counts_per_turn=100)
    port, _ = listener.accept()
    with port:
        odrive.write(3)
        odrive.request()
        assert port.recv(16) == bytes.fromhex("6e000000 04000000 0000c03f 00000000")
        assert port.recv(16) == bytes.fromhex("69000040 00000000 00000000 00000000")
        port.send(Frame(0x68, struct.pack("<ff", 9.0, 0.0)).pack())  # of another command
        port.send(Frame(0x49, struct.pack("<ff", 9.0, 0.0)).pack())  # of another node
        port.send(Frame(0x69, struct.pack("<ff", -2.5, 0.0)).pack())
        assert odrive.position() == (-250, "")
        odrive.safe_state()
        assert port.recv(16)[:5] == bytes.fromhex("62000000 00")
    odrive.close()


def test_axis_that_leaves_closed_loop_is_a_fault_with_its_errors(bus):
    address, listener = bus
    settings = {"newton_metres_per_count": 1.0, "counts_per_turn": 1, "write_within_s": 60.0}
    odrive = ODrive(address, 0, answer_within_s=PATIENT_s, **settings)
    port, _ = listener.accept()
    with port:
        port.send(Frame(0x01, struct.pack("<IBBBB", 0, 8, 0, 0, 0)).pack())
        odrive.enable()
        port.send(Frame(0x01, struct.pack("<IBBBB", 0x40, 1, 0, 0, 0)).pack())
        odrive.request()
        port.send(Frame(0x09, struct.pack("<ff", 0.0, 0.0)).pack())
        assert "state 1, errors 0x40" in odrive.position().fault
    odrive.close()


def test_gauge_that_sends_by_itself_gives_its_newest_reading_or_a_fault(bus):
    address, listener = bus
    gauge = CanGauge(
        *(address, 0x20),
        layout=">h",
        requested=False,
        answer_within_s=PATIENT_s,
        overload=-1,
    )
    port, _ = listener.accept()
    with port:
        for counts in (7, 8):
            port.send(Frame(0x20, struct.pack(">h", counts)).pack())
        gauge.request()
        assert gauge.read().counts == 8.0
        assert gauge.read().counts == 8.0  # the loop is faster than the gauge
        port.send(Frame(0x20, struct.pack(">h", -1)).pack())
        assert gauge.read().counts != gauge.read().counts  # NaN: an overload
    gauge.close()
    silent = CanGauge(address, 0x20, answer_within_s=0.01)
    port, _ = listener.accept()
    with port:
        silent.request()
        assert "no frame of the gauge" in silent.read().fault
    silent.close()


def test_frames_on_the_bus_are_counted_against_those_that_are_due(bus):
    address, listener = bus
    gauge = CanGauge(address, 0x20, requested=False, answer_within_s=PATIENT_s, rate_Hz=1e6)
    port, _ = listener.accept()
    with port:
        port.send(Frame(0x20, struct.pack("<i", 7)).pack())
        gauge.read()
        (due,) = gauge.messages()
        assert due.seen == 1
        assert due.expected > 1
        assert due.wire_s == pytest.approx(95e-6)
    gauge.close()
    odrive = ODrive(
        *(address, 0),
        newton_metres_per_count=1.0,
        counts_per_turn=1,
        bits_per_s=250_000,
        answer_within_s=0.01,
    )
    port, _ = listener.accept()
    with port:
        odrive.request()
        assert odrive.position().fault
        encoder, torque, heartbeat = odrive.messages()
        assert (encoder.expected, encoder.seen) == (3, 0)
        # 55 + 135 bits asked for, 95 a torque: with a gauge of 95, 380 bits a sample.
        assert encoder.wire_s + torque.wire_s + 95 / 250e3 == pytest.approx(1.52e-3)
        assert heartbeat.seen == 0 < heartbeat.expected
        assert odrive.waited_s > 0.009
    odrive.close()


@pytest.mark.parametrize(("lost", "within_s"), [(1, PATIENT_s), (3, 0.3)])
def test_lost_frame_is_asked_for_again(bus, lost, within_s):
    address, listener = bus
    odrive = ODrive(
        *(address, 0), newton_metres_per_count=1.0, counts_per_turn=1, answer_within_s=within_s
    )
    drive_port, _ = listener.accept()
    gauge = CanGauge(address, 0x20, answer_within_s=0.3)
    gauge_port, _ = listener.accept()

    def answer(port, data):
        for number in range(3):
            request = Frame.unpack(port.recv(16))
            if number >= lost:
                with suppress(OSError):  # the part has its answer, and is closed
                    port.send(Frame(request.identifier, data).pack())

    with drive_port, gauge_port:
        ends = [(drive_port, struct.pack("<ff", 5.0, 0.0)), (gauge_port, struct.pack("<i", 7))]
        threads = [threading.Thread(target=answer, args=end, daemon=True) for end in ends]
        for thread in threads:
            thread.start()
        odrive.request()
        gauge.request()
        if lost < 3:
            assert (gauge.read().counts, odrive.position()) == (7, (5, ""))
        else:
            assert "after 3 requests" in gauge.read().fault
            assert "has not answered 3 requests" in odrive.position().fault
        for part in (odrive, gauge):
            part.request()  # for a thread that still waits for one
            part.request()
            part.close()
        for thread in threads:
            thread.join()


def test_torques_that_the_interface_does_not_take_are_a_fault(bus):
    """The axis keeps the last torque, though all other frames pass."""
    address, listener = bus
    settings = {"newton_metres_per_count": 1.0, "counts_per_turn": 1, "write_within_s": 0.1}
    odrive = ODrive(address, 0, heartbeat_s=60.0, answer_within_s=PATIENT_s, **settings)
    send = odrive._bus.send

    def refuse_torques(frame):
        send(frame)
        if frame.identifier == 0x0E:
            odrive._bus.fault = "the CAN interface takes no frame"

    port, _ = listener.accept()
    with port:
        port.send(Frame(0x01, struct.pack("<IBBBB", 0, 8, 0, 0, 0)).pack())
        odrive.enable()
        odrive._bus.send = refuse_torques
        time.sleep(0.15)
        odrive.write(1)
        odrive.request()
        port.send(Frame(0x09, struct.pack("<ff", 5.0, 0.0)).pack())
        assert "no torque was commanded" in odrive.position().fault
        odrive._bus.send = send
        odrive.write(1)
        odrive.request()
        port.send(Frame(0x09, struct.pack("<ff", 5.0, 0.0)).pack())
        assert odrive.position() == (5, "")
    odrive.close()


def test_axis_without_heartbeats_is_a_fault(bus):
    address, listener = bus
    settings = {"newton_metres_per_count": 1.0, "counts_per_turn": 1, "write_within_s": 60.0}
    odrive = ODrive(address, 0, heartbeat_s=0.02, answer_within_s=PATIENT_s, **settings)
    port, _ = listener.accept()
    with port:
        port.send(Frame(0x01, struct.pack("<IBBBB", 0, 8, 0, 0, 0)).pack())
        odrive.enable()
        time.sleep(0.25)
        odrive.request()
        port.send(Frame(0x09, struct.pack("<ff", 0.0, 0.0)).pack())
        assert "no heartbeat of the ODrive" in odrive.position().fault
    odrive.close()


def test_doctor_names_missing_and_invalid_readings_as_what_they_are():
    def timing(failed, counts):
        times_s = np.full(len(counts), 1e-4)
        return ExchangeTiming(632.0, 1.0, times_s, 0.0, 0.0, times_s, np.array(counts), failed, ())

    for found, words in (
        (timing(1, [1.0] * 99), "1 of 100 readings did not come in time"),
        (timing(0, [1.0] * 98 + [math.nan] * 2), "2 of 100 readings have no number of the gauge"),
    ):
        result = check_readings(found)
        assert result.state is State.FIX
        assert words in result.sentence
        assert "board" not in result.remedy
        assert check_exchange(found).state is State.FINE


@pytest.mark.parametrize("name", ["answer_within_s", "write_within_s", "counts_per_turn"])
@pytest.mark.parametrize("value", [math.nan, 0.0])
def test_times_that_would_end_no_wait_and_a_turn_without_counts_are_refused(bus, name, value):
    settings = {"newton_metres_per_count": 1.0, "counts_per_turn": 1, name: value}
    with pytest.raises(InvalidInput, match=rf"{name} is .*above zero"):
        ODrive(bus[0], **settings)
    if name == "answer_within_s":
        with pytest.raises(InvalidInput, match=rf"{name} is .*above zero"):
            CanGauge(bus[0], 1, answer_within_s=value)


def test_missing_interface_and_part_of_the_wrong_kind_are_refused(bus):
    with pytest.raises(RigError, match=r"no CAN interface nocan0.*ip link set nocan0 up"):
        CanSocket("nocan0", 0, 1)
    settings = {"interface": bus[0], "identifier": 1}
    with pytest.raises(InvalidInput, match="is no drive: it has no disable, enable, position"):
        load_part("can-gauge", settings, Drive)
    with pytest.raises(InvalidInput, match="no installed package offers a driver 'odriv'"):
        load_part("odriv", {}, Driver)
