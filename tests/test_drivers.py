"""A driver of a serial board, and the conformance of every driver, on emulated devices."""

import math
import select
import struct
import threading
import time
from collections import deque
from contextlib import ExitStack, closing

import pytest

import plants
from estune.cli.checks import State, run_file_checks
from estune.cli.checks.driver_checks import check_exchange
from estune.conformance.driver import DriverConformance, check_silence
from estune.errors import InvalidInput, RigError
from estune.hardware import HardwareRig
from estune.hardware.driver import load_driver
from estune.hardware.drivers.serial_board import SerialBoard
from estune.hardware.drivers.serial_port import SerialPort
from estune.hardware.exchange_timing import measure_exchanges
from estune.trial import Outcome, TrialRequest
from experiments.device_faults.devices import FAULTY
from plants.emulator import EmulatedDriver
from plants.emulator.board import Electronics, EmulatedBoard
from plants.emulator.devices import GAUGE, CanDevices, SerialDevice
from plants.emulator.driver import emulated_hardware
from tests.support_hardware import quick
from tests.support_lanes import first_by_day

PATIENT_s = 3.0
"""Time within which an answer must come: the test machine may be busy."""


FAULTY_WITHIN_s = 0.3
"""The same of a device with faults, each of which is waited for."""

MOVES = 1500


def hardware(device):
    settings = {"electronics": {"watchdog_s": 60.0}, "seed": 1}
    return emulated_hardware(settings if device is None else {**settings, "device": device})


def of_serial(address, within_s=PATIENT_s):
    return {"use": "serial-board", "settings": {"port": address, "answer_within_s": within_s}}


def of_can_gauge(address, within_s=PATIENT_s):
    settings = {"interface": address, "identifier": GAUGE, "answer_within_s": within_s}
    return {"use": "can-gauge", "settings": settings}


def of_can(address, within_s=PATIENT_s):
    drive = {
        "interface": address,
        "newton_metres_per_count": CanDevices.newton_metres_per_count,
        "counts_per_turn": CanDevices.counts_per_turn,
        "answer_within_s": within_s,
        "write_within_s": 60.0,
    }
    return {"use": "odrive", "settings": drive, "gauge": of_can_gauge(address, within_s)}


STILL = {"use": "tests.support_drivers:StillDrive"}


def of_can_gauge_alone(address, within_s=PATIENT_s):
    return STILL | {"gauge": of_can_gauge(address, within_s)}


def of_serial_gauge_alone(address, within_s=PATIENT_s):
    gauge = of_serial(address, within_s) | {"use": "serial-gauge"}
    return STILL | {"gauge": gauge}


DRIVER_TABLES = {"serial": of_serial, "can": of_can}


def open_driver(table):
    return load_driver(*quick(driver=table).driver.driver)


class Served:
    """An emulated device that a thread serves.

    Attributes:
        device: The device.
        table: Function from its address to the table of the driver.
    """

    def __init__(self, device, table=of_serial):
        self.device, self.table = device, table
        self._lock, self._over = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._serve)

    @property
    def faults(self):
        return self.device.faults

    def open(self):
        return open_driver(self.table(self.device.address, FAULTY_WITHIN_s))

    def begin(self, fault):
        with self._lock:
            self.device.begin(fault)

    def end(self):
        with self._lock:
            self.device.end()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._over.set()
        self._thread.join()

    def _serve(self):
        while not self._over.wait(1e-4):
            with self._lock:
                for file in select.select(self.device.readable, [], [], 2e-3)[0]:
                    self.device.take(file, time.monotonic())
                self.device.tick(time.monotonic())


def emulated_board():
    reel, electronics = plants.reference_reel(), Electronics(watchdog_s=60.0)
    return EmulatedBoard(reel, electronics, 1, time.monotonic())


class _OnAnEmulatedDevice(DriverConformance):
    """Each test has a device of its own.

    Attributes:
        kind: The device.
        table: Function from its address to the table of the driver.
    """

    kind = "serial"
    table = staticmethod(of_serial)

    @pytest.fixture
    def device(self, tmp_path):
        device = FAULTY[self.kind](emulated_board(), str(tmp_path / "bus"))
        with Served(device, self.table) as served:
            yield served
        device.end()
        device.begin("unplugged")

    @pytest.fixture
    def driver(self, device):
        with closing(open_driver(self.table(device.device.address))) as driver:
            yield driver


class TestEmulated(DriverConformance):
    @pytest.fixture(scope="class")
    @classmethod
    def address(cls):
        with hardware(None) as address:
            yield address

    @pytest.fixture
    def driver(self, address):
        with EmulatedDriver(address) as driver:
            yield driver

    @pytest.fixture
    def moves(self):
        return MOVES


class TestSerialBoard(_OnAnEmulatedDevice):
    @pytest.fixture
    def moves(self):
        return MOVES


class TestODriveWithCanGauge(_OnAnEmulatedDevice):
    kind, table = "can", staticmethod(of_can)

    @pytest.fixture
    def moves(self):
        return MOVES


@pytest.mark.slow  # its faults are waited for; the protocol is that of the board
class TestSerialGauge(_OnAnEmulatedDevice):
    table = staticmethod(of_serial_gauge_alone)


@pytest.mark.slow  # as above; by day it passes them beside an ODrive
class TestCanGauge(_OnAnEmulatedDevice):
    kind, table = "can", staticmethod(of_can_gauge_alone)


@pytest.mark.slow
def test_minute_of_silence_ends_no_driver(tmp_path):
    with ExitStack() as opened:
        devices = []
        for case in (TestSerialBoard, TestODriveWithCanGauge, TestSerialGauge, TestCanGauge):
            address = str(tmp_path / case.__name__)
            device = FAULTY[case.kind](emulated_board(), address)
            opened.callback(device.begin, "unplugged")
            devices.append(opened.enter_context(Served(device, case.table)))
        check_silence(devices, 60.0)


@pytest.mark.parametrize("device", first_by_day(*DRIVER_TABLES))
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


class LossyBoard(SerialDevice):
    """A board whose answers pass through a list of faults, one for each answer."""

    def __init__(self, board):
        super().__init__(board, "")
        self.faults = deque()
        self.deaf = False
        self.sent = []

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
    with Served(LossyBoard(emulated_board())) as served:
        yield served.device


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


def test_silent_board_and_commands_that_do_not_arrive_are_faults(board):
    with SerialBoard(board.address, answer_within_s=PATIENT_s) as driver:
        board.deaf = True
        for _ in range(2):
            driver.write(0)
            driver.read()
        driver.write(0)
        assert "3 commands in a row did not reach the board" in driver.read().fault
    with SerialBoard(board.address, answer_within_s=0.03) as driver:
        board.faults.extend(["lost"] * 3)
        assert "has not answered 3 requests" in driver.read().fault


def test_messages_that_are_lost_are_counted(board):
    with SerialBoard(board.address, answer_within_s=0.6) as driver:
        board.faults.extend(["lost", "none", "cut", "none"])
        timing = measure_exchanges(driver, 632.0, 0.02)
        reading, command = timing.messages
        assert reading.expected - reading.seen >= 2
        # The last command is confirmed by the next reading.
        assert command.expected - 1 <= command.seen <= command.expected
        board.deaf = True
        assert measure_exchanges(driver, 632.0, 0.02).failed
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


@pytest.mark.parametrize("device", first_by_day(*DRIVER_TABLES))
def test_doctor_of_a_rigs_file_measures_driver_and_loop(device):
    with hardware(device) as address:
        patient = {f"guard__{limit}": PATIENT_s for limit in ("gap_s", "heartbeat_s", "frozen_s")}
        config = quick(driver=DRIVER_TABLES[device](address), **patient)
        results = {r.check: r for r in run_file_checks(config, move=True, repeats=2, seconds=0.2)}
    budget = results["time budget"].figures
    assert budget["exchange_median_ms"] <= budget["exchange_p99_ms"]
    assert min(budget["host_ms"], budget["adapter_ms"]) > 0.0
    assert {"messages", "gauge rate", "trials", "loop"} <= results.keys()


def test_power_that_the_board_has_cut_is_a_fault(board):
    with SerialBoard(board.address, answer_within_s=PATIENT_s) as driver:
        driver.enable()
        board._board.power(time.monotonic(), on=False)
        assert "protection has cut the amplifier's power" in driver.read().fault


def test_port_that_is_in_use_absent_or_slow_is_refused(board, tmp_path):
    with (
        SerialBoard(board.address, answer_within_s=PATIENT_s),
        pytest.raises(RigError, match="close the other program"),
    ):
        SerialBoard(board.address)
    with pytest.raises(RigError, match="is it plugged in"):
        SerialBoard(str(tmp_path / "ttyACM0"))
    with pytest.raises(RigError, match="ioctl for device; name the serial port"):
        SerialBoard("/dev/null")
    with pytest.raises(RigError, match="directory; name the serial port"):
        SerialBoard(str(tmp_path))
    timer = tmp_path / "ttyUSB0" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    with pytest.raises(RigError, match=r"holds answers back for 16 ms; set it with: echo 1 > "):
        SerialPort("/dev/ttyUSB0", 921600, tmp_path)
    with pytest.raises(InvalidInput, match="baud is 1234"):
        SerialPort("/dev/ttyUSB0", 1234, tmp_path)
    for within_s in (math.nan, math.inf, 0.0, -1.0):
        with pytest.raises(InvalidInput, match="answer_within_s is"):
            SerialBoard(board.address, answer_within_s=within_s)
