"""Conformance suite of a driver; see docs/how-to/extend.md."""

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Protocol, TypeVar

import pytest

from estune.hardware.driver import Driver, Reading
from estune.hardware.driver_link import DriverLink

T = TypeVar("T")
READINGS = 20
SILENCES_s = (0.01, 0.1, 1.0)
BACK_WITHIN_s = 10.0
"""Time within which readings must be good again after a fault: a board starts again."""

FAULTS = (
    "not a number",
    "infinity",
    "largest value",
    "smallest value",
    "short message",
    "long message",
    "wrong checksum",
    "wrong identifier",
    "duplicate",
    "stale",
    "out of order",
    "flood",
    "silence",
    "reset",
    "unplugged",
)
"""What a device, or the line to it, may do. Values are those of every field, in turn."""


class FaultyDevice(Protocol):
    """An emulated device that misbehaves when told to.

    Attributes:
        faults: Those of `FAULTS` that its protocol can have.
    """

    faults: Sequence[str]

    def open(self) -> Driver:
        """Opens a driver of the device."""
        ...

    def begin(self, fault: str) -> None:
        """Begins a fault, which lasts until it is ended."""
        ...

    def end(self) -> None:
        """Ends it."""
        ...


class DriverConformance:
    """Tests of a driver: the fixture `driver`, which a subclass must define.

    Without `moves` the amplifier gets power at a current of zero counts only; without `device`
    faults are not tested.
    """

    @pytest.fixture
    def driver(self) -> Iterator[Driver]:
        """The driver under test, open, its amplifier without power."""
        raise NotImplementedError("define the fixture `driver`: your driver, opened")

    @pytest.fixture
    def moves(self) -> int | None:
        """Counts that turn the drum without harm, or None."""
        return None

    @pytest.fixture
    def device(self) -> FaultyDevice | None:
        """The device with faults, or None."""
        return None

    def test_reading_is_stamped_on_the_monotonic_clock(self, driver: Driver) -> None:
        before = time.monotonic()
        readings = [driver.read() for _ in range(READINGS)]
        after = time.monotonic()
        stamps = [reading.time_s for reading in readings]
        assert all(b > a for a, b in itertools.pairwise(stamps))
        # A stamp may be older than its request, by a period of a gauge that runs by itself.
        assert before - 1.0 < stamps[0]
        assert stamps[-1] <= after

    def test_reading_has_a_number_of_the_gauge_and_whole_counts(self, driver: Driver) -> None:
        reading = driver.read()
        assert not reading.fault
        check_reading(reading)

    def test_power_goes_on_and_off_again_and_again(self, driver: Driver) -> None:
        for _ in range(3):
            driver.write(0)
            driver.enable()
            driver.write(0)
            assert not driver.read().fault
            driver.disable()
            assert not driver.read().fault

    def test_current_turns_the_drum(self, driver: Driver, moves: int | None) -> None:
        if moves is None:
            pytest.skip("the fixture `moves` names no current")
        first = driver.read()
        driver.write(0)
        driver.enable()
        deadline = time.monotonic() + 10.0
        while driver.read().encoder_counts == first.encoder_counts:
            driver.write(moves)
            assert time.monotonic() < deadline, "the drum has not turned within 10 s"
        driver.write(0)
        driver.disable()
        assert not math.isnan(driver.read().gauge_counts)

    def test_safe_state_is_reached_from_any_state_and_left_by_enable(self, driver: Driver) -> None:
        driver.safe_state()
        driver.write(0)
        driver.enable()
        driver.safe_state()
        driver.safe_state()
        driver.write(0)
        driver.enable()
        driver.write(0)
        assert not driver.read().fault
        driver.disable()

    def test_closed_driver_may_be_closed_again_and_gives_no_reading(self, driver: Driver) -> None:
        driver.close()
        driver.close()
        try:
            reading = driver.read()
        except Exception:  # noqa: BLE001  each library has its own
            return
        assert reading.fault

    @pytest.mark.parametrize("fault", FAULTS)
    def test_fault_of_the_device_raises_nothing_and_passes(
        self, device: FaultyDevice | None, fault: str
    ) -> None:
        device = having(device, fault)
        driver = in_time(device.open)
        try:
            driver.write(0)
            driver.enable()
            driver.write(0)
            gives_a_good_reading(driver)
            device.begin(fault)
            readings = []
            for _ in range(READINGS):
                driver.write(0)
                readings.append(driver.read())
                check_reading(readings[-1])
                if all(reading.fault for reading in readings[-3:]) and len(readings) > 2:
                    break
            if fault in ("silence", "unplugged"):
                assert any(reading.fault for reading in readings)
            driver.disable()
            driver.safe_state()
        finally:
            driver.close()
            device.end()
        link = DriverLink(lambda: in_time(device.open))
        is_good_again(link)
        link.switch(on=True)
        link.write(0)
        is_good_again(link)
        link.close()

    def test_silence_gives_readings_of_growing_age(self, device: FaultyDevice | None) -> None:
        device = having(device, "silence")
        for seconds in SILENCES_s:
            check_silence([device], seconds)

    def test_device_that_is_plugged_in_again_is_read_again(
        self, device: FaultyDevice | None
    ) -> None:
        device = having(device, "unplugged")
        link = in_time(partial(DriverLink, device.open))
        is_good_again(link)
        device.begin("unplugged")
        link.write(0)
        assert link.read().fault
        link.reopen()
        assert link.read().fault
        device.end()
        is_good_again(link)
        link.close()


def having(device: FaultyDevice | None, fault: str) -> FaultyDevice:
    """The device, if it can have the fault; else the test is skipped."""
    if device is None:
        pytest.skip("the fixture `device` names no device with faults")
    if fault not in device.faults:
        pytest.skip(f"this protocol knows no {fault}")
    return device


def in_time(make: Callable[[], T]) -> T:
    """What is made, tried again: the device may have to start again, or its answer came late."""
    deadline_s = time.monotonic() + BACK_WITHIN_s
    while True:
        try:
            return make()
        except Exception:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.05)


def gives_a_good_reading(driver: Driver) -> None:
    """Waits for a good reading: on a busy computer an answer may come late."""
    deadline_s = time.monotonic() + BACK_WITHIN_s
    while driver.read().fault:
        assert time.monotonic() < deadline_s, "readings stay bad"


def check_reading(reading: Reading) -> None:
    """Checks that a reading is a good one, or says why it is not."""
    assert isinstance(reading, Reading)
    assert isinstance(reading.encoder_counts, int)
    assert isinstance(reading.gauge_counts, float | int)
    assert math.isfinite(reading.time_s)
    assert not math.isinf(reading.gauge_counts)
    assert bool(reading.fault) is (reading.age_s > 0.0)
    assert math.isnan(reading.gauge_counts) or not reading.fault


def check_silence(devices: Sequence[FaultyDevice], seconds: float) -> None:
    """Checks devices that are silent for so long: the ages of their readings, and their return."""
    links = [in_time(partial(DriverLink, device.open)) for device in devices]
    ages_s = [[0.0] for _ in links]
    for link, device in zip(links, devices, strict=True):
        is_good_again(link)
        device.begin("silence")
    ends_s = time.monotonic() + seconds
    ended = False
    while not ended or any(len(ages) == 1 for ages in ages_s):
        ended = time.monotonic() >= ends_s  # so that readings after a pause of the computer count
        for link, ages in zip(links, ages_s, strict=True):
            link.write(0)
            reading = link.read()
            if reading.fault:  # what was on its way may still come
                ages.append(reading.age_s)
    for link, device, ages in zip(links, devices, ages_s, strict=True):
        device.end()
        assert all(b > a for a, b in itertools.pairwise(ages))
        assert ages[-1] >= 0.9 * seconds
        is_good_again(link)
        link.close()


def is_good_again(link: DriverLink) -> None:
    """Waits for a good reading, opening the driver again as the loop does."""
    deadline_s = time.monotonic() + BACK_WITHIN_s
    while link.read().fault:
        assert time.monotonic() < deadline_s, "readings stay bad"
        if link.is_due:
            link.reopen()
        time.sleep(1e-3)
