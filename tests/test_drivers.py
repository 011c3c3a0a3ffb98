"""A driver of a serial board, and the conformance of every driver, on emulated devices."""

import select
import struct
import threading
import time
from collections import deque
from contextlib import closing

import pytest

import plants
from estune.cli.checks import State, run_file_checks
from estune.cli.checks.driver_checks import check_exchange
from estune.conformance.driver import DriverConformance
from estune.errors import InvalidInput, RigError
from estune.hardware import HardwareRig
from estune.hardware.driver import load_driver
from estune.hardware.drivers.serial_board import SerialBoard
from estune.hardware.drivers.serial_port import SerialPort
from estune.hardware.exchange_timing import measure_exchanges
from estune.trial import Outcome, TrialRequest
from plants.emulator import EmulatedDriver
from plants.emulator.board import Electronics, EmulatedBoard
from plants.emulator.devices import GAUGE, CanDevices, SerialDevice
from plants.emulator.driver import emulated_hardware
from tests.support_hardware import quick

PATIENT_s = 3.0
"""Time within which an answer must come: the test machine may be busy."""


MOVES = 1500


def hardware(device):
    settings = {"electronics": {"watchdog_s": 60.0}, "seed": 1}
    return emulated_hardware(settings if device is None else {**settings, "device": device})


def of_serial(address):
    return {"use": "serial-board", "settings": {"port": address, "answer_within_s": PATIENT_s}}


def of_can(address):
    drive = {
        "interface": address,
        "newton_metres_per_count": CanDevices.newton_metres_per_count,
        "counts_per_turn": CanDevices.counts_per_turn,
        "answer_within_s": PATIENT_s,
        "write_within_s": 60.0,
    }
    gauge = {"interface": address, "identifier": GAUGE, "answer_within_s": PATIENT_s}
    part = {"use": "can-gauge", "settings": gauge}
    return {"use": "odrive", "settings": drive, "gauge": part}


DRIVER_TABLES = {"serial": of_serial, "can": of_can}


class _OnTheEmulatedReel(DriverConformance):
    """Each test opens its own driver of one emulated reel, as programs do that follow each other.

    Attributes:
        device: The protocol between them.
    """

    device = None

    @pytest.fixture(scope="class")
    @classmethod
    def address(cls):
        with hardware(cls.device) as address:
            yield address

    @pytest.fixture
    def moves(self):
        return MOVES


class TestEmulated(_OnTheEmulatedReel):
    @pytest.fixture
    def driver(self, address):
        with EmulatedDriver(address) as driver:
            yield driver


class TestSerialBoard(_OnTheEmulatedReel):
    device = "serial"

    @pytest.fixture
    def driver(self, address):
        table = of_serial(address)
        with closing(load_driver(table["use"], table["settings"])) as driver:
            yield driver


class TestODriveWithCanGauge(_OnTheEmulatedReel):
    device = "can"

    @pytest.fixture
    def driver(self, address):
        with closing(load_driver(*quick(driver=of_can(address)).driver.driver)) as driver:
            yield driver


@pytest.mark.parametrize("device", DRIVER_TABLES)
def test_rig_runs_a_trial_behind_a_real_devices_protocol(device):
    with hardware(device) as address:
        patient = {f"guard__{limit}": PATIENT_s for limit in ("gap_s", "heartbeat_s", "frozen_s")}
        config = quick(driver=DRIVER_TABLES[device](address), **patient)
        with HardwareRig(config) as rig:
            about = rig.describe()
            record = rig.run(TrialRequest("r", 1, about.gains, about.step))
    assert record.outcome is Outcome.DONE
    assert record.tension_N[-1] > about.step.preload_N + 0.25 * about.step.step_N
    assert record.angle_rad.any()


class FaultyDevice(SerialDevice):
    """A board whose answers pass through a list of faults, one for each answer."""

    def __init__(self, board):
        super().__init__(board, "")
        self.faults = deque()
        self.deaf = False
        self.sent = []

    def take(self, file, now_s):
        super().take(file, now_s)

    def _execute(self, verb, sequence, number, now_s):
        if not (self.deaf and verb == b"w"):
            super()._execute(verb, sequence, number, now_s)

    def send(self, packet):
        fault = self.faults.popleft() if self.faults else "none"
        last, flipped = (self.sent or [packet])[-1], bytes([packet[9] ^ 4])
        self.sent.append(packet)
        for part in {
            "none": [packet],
            "lost": [],
            "cut": [packet[:11]],
            "doubled": [packet, packet],
            "stale before": [last, packet],
            "damaged": [packet[:9] + flipped + packet[10:]],
            "noise before": [b"\x5a\x01garbage", packet],
        }[fault]:
            super().send(part)


@pytest.fixture
def board():
    reel = plants.reference_reel()
    device = FaultyDevice(EmulatedBoard(reel, Electronics(watchdog_s=60.0), 1, time.monotonic()))
    over = threading.Event()

    def serve():
        (file,) = device.readable
        while not over.is_set():
            if select.select([file], [], [], 0.05)[0]:
                device.take(file, time.monotonic())

    thread = threading.Thread(target=serve)
    thread.start()
    yield device
    over.set()
    thread.join()


FAULTS = ("lost", "cut", "doubled", "stale before", "damaged", "noise before", "none")


@pytest.mark.parametrize("fault", FAULTS)
def test_reading_is_that_of_its_own_request_whatever_the_line_does(board, fault):
    with SerialBoard(board.address, answer_within_s=PATIENT_s) as driver:
        driver.read()
        board.faults.append(fault)
        for _ in range(3):
            reading = driver.read()
            gauge, encoder = struct.unpack_from("<ii", board.sent[-1], 10)
            assert (reading.gauge_counts, reading.encoder_counts) == (gauge, encoder)


def test_silent_board_raises_and_commands_that_do_not_arrive_end_motion(board):
    with SerialBoard(board.address, answer_within_s=PATIENT_s) as driver:
        board.deaf = True
        for _ in range(2):
            driver.write(0)
            driver.read()
        driver.write(0)
        with pytest.raises(RigError, match="3 commands in a row did not reach the board"):
            driver.read()
    with SerialBoard(board.address, answer_within_s=0.03) as driver:
        board.faults.extend(["lost"] * 3)
        with pytest.raises(TimeoutError, match="has not answered 3 requests"):
            driver.read()


def test_messages_that_are_lost_are_counted(board):
    with SerialBoard(board.address, answer_within_s=0.6) as driver:
        board.faults.extend(["lost", "none", "cut", "none"])
        timing = measure_exchanges(driver, 632.0, 0.02)
        reading, command = timing.messages
        assert reading.expected - reading.seen >= 2
        # The last command is confirmed by the next reading.
        assert command.expected - 1 <= command.seen <= command.expected
        board.deaf = True
        with pytest.raises(RigError, match="commands in a row"):
            measure_exchanges(driver, 632.0, 0.02)
        assert driver.messages()[1].seen <= command.seen + 1


def test_adapter_that_holds_answers_back_is_named_with_the_board(board, monkeypatch):
    send = board.send

    def held_back(packet):
        time.sleep(2e-3)
        send(packet)

    monkeypatch.setattr(board, "send", held_back)
    with SerialBoard(board.address, answer_within_s=PATIENT_s) as driver:
        timing = measure_exchanges(driver, 632.0, 0.05)
    result = check_exchange(timing)
    assert timing.quantile_s(0.0) > 2e-3
    assert result.state is State.FIX
    assert result.figures["adapter_ms"] > 1.0
    assert "move the loop to the board" in result.remedy


@pytest.mark.parametrize("device", DRIVER_TABLES)
def test_doctor_of_a_rigs_file_measures_driver_and_loop(device):
    with hardware(device) as address:
        patient = {f"guard__{limit}": PATIENT_s for limit in ("gap_s", "heartbeat_s", "frozen_s")}
        config = quick(driver=DRIVER_TABLES[device](address), **patient)
        results = {r.check: r for r in run_file_checks(config, move=True, repeats=2, seconds=0.2)}
    budget = results["time budget"].figures
    assert budget["exchange_median_ms"] <= budget["exchange_p99_ms"]
    assert min(budget["host_ms"], budget["adapter_ms"]) > 0.0
    assert {"messages", "gauge rate", "trials", "loop"} <= results.keys()


def test_watchdog_of_the_board_ends_motion(board):
    with SerialBoard(board.address, answer_within_s=PATIENT_s) as driver:
        driver.enable()
        board._board.power(time.monotonic(), on=False)
        with pytest.raises(RigError, match="protection has cut the amplifier's power"):
            driver.read()


def test_port_that_is_in_use_absent_or_slow_is_refused(board, tmp_path):
    with (
        SerialBoard(board.address, answer_within_s=PATIENT_s),
        pytest.raises(RigError, match="close the other program"),
    ):
        SerialBoard(board.address)
    with pytest.raises(RigError, match="is it plugged in"):
        SerialBoard(str(tmp_path / "ttyACM0"))
    timer = tmp_path / "ttyUSB0" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    with pytest.raises(RigError, match=r"holds answers back for 16 ms; set it with: echo 1 > "):
        SerialPort("/dev/ttyUSB0", 921600, tmp_path)
    with pytest.raises(InvalidInput, match="baud is 1234"):
        SerialPort("/dev/ttyUSB0", 1234, tmp_path)
