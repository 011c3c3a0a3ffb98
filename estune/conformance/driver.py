"""Conformance suite of a driver; see docs/how-to/extend.md."""

import itertools
import math
import time
from collections.abc import Iterator

import pytest

from estune.hardware.driver import Driver, Reading

READINGS = 20


class DriverConformance:
    """Tests of a driver: the fixture `driver`, which a subclass must define.

    Without `moves` the amplifier gets power at a current of zero counts only.
    """

    @pytest.fixture
    def driver(self) -> Iterator[Driver]:
        """The driver under test, open, its amplifier without power."""
        raise NotImplementedError("define the fixture `driver`: your driver, opened")

    @pytest.fixture
    def moves(self) -> int | None:
        """Counts that turn the drum without harm, or None."""
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
        assert isinstance(reading, Reading)
        assert isinstance(reading.encoder_counts, int)
        assert isinstance(reading.gauge_counts, float | int)

    def test_power_goes_on_and_off_again_and_again(self, driver: Driver) -> None:
        for _ in range(3):
            driver.write(0)
            driver.enable()
            driver.write(0)
            driver.read()
            driver.disable()
            driver.read()

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
        driver.read()
        driver.disable()

    def test_closed_driver_raises_and_may_be_closed_again(self, driver: Driver) -> None:
        driver.close()
        driver.close()
        with pytest.raises(Exception):  # noqa: B017, PT011  each library has its own
            driver.read()
