"""A driver as the real-time loop calls it: it never raises, and is opened again when lost."""

import math
import time
from collections.abc import Callable
from numbers import Integral, Real

from estune.hardware.driver import Driver, Reading, bad_reading

FIRST_WAIT_s, LONGEST_WAIT_s = 0.5, 8.0
"""Time from the last good reading to the first attempt to open the driver again, which doubles
from attempt to attempt: a board starts within seconds, and a line that is pulled stays so."""

AHEAD_MAX_s = 1e-3
"""Time by which a stamp may be ahead of the clock: that of a reading is taken before it."""


def read_safely(driver: Driver, last: Reading | None) -> Reading:
    """A reading of a driver, bad where it raises or has values that are none."""
    try:
        reading = driver.read()
        if reading.fault:
            return bad_reading(reading.fault, last)
        fault = _unusable(reading)
    except TimeoutError as error:
        fault = str(error) or "the device has not answered in time"
    except Exception as error:  # noqa: BLE001  a driver is user code
        fault = f"{type(error).__name__}: {error}"
    return bad_reading(fault, last) if fault else reading


def _unusable(reading: Reading) -> str:
    """Why the values of a reading cannot be used; empty where they can."""
    encoder: object = reading.encoder_counts
    gauge: object = reading.gauge_counts
    if not isinstance(encoder, Integral) or abs(int(encoder)) >= 2**63:
        return f"the encoder's counts {encoder!r} are no whole number of 64 bits"
    if not isinstance(gauge, Real):
        return f"the gauge's counts {gauge!r} are no number"
    if not -math.inf < reading.time_s <= time.monotonic() + AHEAD_MAX_s:
        return f"the driver's time stamp {reading.time_s} s is not of this computer's clock"
    return ""


class DriverLink:
    """One device of a reel, through the driver that `make_driver` opens.

    What the driver raises becomes the fault of the next reading. A device whose state is unknown,
    as after bad readings or when its driver was opened again, is brought to its safe state before
    anything else, unless it has power in order.
    """

    def __init__(self, make_driver: Callable[[], Driver]) -> None:
        """Opens the driver; what it raises is raised: there may be no such hardware."""
        self._make = make_driver
        self._driver: Driver | None = make_driver()
        self._opening = ""  # why it could not be opened again
        self._refused = ""  # what a command raised since the last reading
        self._unpowered = ""  # what the last attempt to give it power raised
        self._powered = False
        self._unknown = False
        self._wait_s = FIRST_WAIT_s
        self._next_s = time.monotonic() + FIRST_WAIT_s
        self.last: Reading | None = None

    def read(self) -> Reading:
        """The reading of this instant, good or bad."""
        if self._driver is None:
            return bad_reading(self._opening, self.last)
        reading = read_safely(self._driver, self.last)
        refused, self._refused = self._refused, ""
        if fault := reading.fault or self._unpowered or refused:
            self._unknown = True
            return reading if reading.fault else bad_reading(fault, self.last)
        if self._unknown and not self._powered:
            self.make_safe()
        self._unknown = False
        self.last = reading
        self._wait_s, self._next_s = FIRST_WAIT_s, time.monotonic() + FIRST_WAIT_s
        return reading

    def write(self, current_counts: int) -> None:
        """Commands a motor current."""
        if self._driver is not None:
            driver = self._driver
            self._try(lambda: driver.write(current_counts))

    def switch(self, *, on: bool) -> None:
        """Gives the amplifier power, or removes it; readings are bad where it cannot be given."""
        self._powered, self._unpowered = on, ""
        if self._driver is None:
            return
        self._try(self._driver.enable if on else self._driver.disable)
        if on:
            self._unpowered = self._refused

    def make_safe(self) -> None:
        """Brings the device to its own safest state, as far as it can be reached."""
        self._powered = False
        for command in (self._driver.safe_state, self._driver.disable) if self._driver else ():
            self._try(command)

    @property
    def is_due(self) -> bool:
        """Whether no reading has been good for so long that the driver is to be opened again."""
        return time.monotonic() >= self._next_s

    def reopen(self) -> None:
        """Opens the driver again, of a reel at rest; its device is then in its safe state."""
        self.make_safe()
        self.close()
        self._wait_s = min(2.0 * self._wait_s, LONGEST_WAIT_s)
        try:
            self._driver = self._make()
        except Exception as error:  # noqa: BLE001  a driver is user code
            self._opening = f"its driver cannot be opened again: {error}"
        self.make_safe()
        self._next_s = time.monotonic() + self._wait_s

    def close(self) -> None:
        """Closes the driver, without power. May be called again."""
        if self._driver is not None:
            self._try(self._driver.disable)
            self._try(self._driver.close)
        self._driver = None

    def _try(self, command: Callable[[], None]) -> None:
        try:
            command()
        except Exception as error:  # noqa: BLE001  a driver is user code
            self._refused = f"{type(error).__name__}: {error}"
