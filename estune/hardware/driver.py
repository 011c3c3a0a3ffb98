"""Interface of a reel's hardware in raw counts, and how a driver is found.

A driver is loaded in the process of the real-time loop, from the settings in the rig's file, and
is called by one thread. It knows no newtons, gains or limits: calibrations C1 and C2, the
controller and the guard stand between it and a trial. `driver_link` stands between it and the
loop: it opens the driver again where the device is gone.
"""

import inspect
import math
import time
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

from estune.errors import InvalidInput
from estune.run.targets import load
from estune.support.plugins import plugins

ENTRY_POINTS = "estune.drivers"
"""Entry point group by which an installed package offers drivers by name."""


class Reading(NamedTuple):
    """Sensor values at one instant.

    Attributes:
        time_s: Time on the system's monotonic clock (`time.monotonic`), s; best the moment the
            converter latched the gauge.
        gauge_counts: Counts of the gauge; NaN at an overload.
        encoder_counts: Counts of the drum's encoder, unwrapped: they go on past a turn.
        age_s: Age of the last good values, s; zero in a good reading.
        fault: Why there are no values of this instant; empty in a good reading.
    """

    time_s: float
    gauge_counts: float
    encoder_counts: int
    age_s: float = 0.0
    fault: str = ""


def bad_reading(fault: str, last: Reading | None) -> Reading:
    """A reading without values of this instant."""
    now_s = time.monotonic()
    if last is None:
        return Reading(now_s, math.nan, 0, math.inf, fault)
    return Reading(now_s, math.nan, last.encoder_counts, now_s - last.time_s, fault)


class GaugeReading(NamedTuple):
    """A gauge's counts, and their time and fault as of `Reading`."""

    time_s: float
    counts: float
    fault: str = ""


class Position(NamedTuple):
    """The encoder's counts, unwrapped, and their fault as of `Reading`."""

    counts: int
    fault: str = ""


class MessageCount(NamedTuple):
    """Messages of one kind on a bus since it was opened.

    Attributes:
        name: What they carry.
        expected: How many were asked for or are due; NaN where no rate is stated.
        seen: How many have come; NaN where nothing confirms them.
        wire_s: Longest time of one on the wire, its request included, s.
    """

    name: str
    expected: float
    seen: float
    wire_s: float


@runtime_checkable
class CountsMessages(Protocol):
    """A driver, drive or gauge that counts its messages, for `estune doctor`."""

    @property
    def waited_s(self) -> float:
        """Time since it was opened that was spent waiting for answers, s."""
        ...

    def messages(self) -> tuple[MessageCount, ...]:
        """The messages so far, by kind."""
        ...


class Gauge(Protocol):
    """A strain gauge beside a drive; a rig's file pairs the two."""

    def request(self) -> None:
        """Asks for a reading, where the gauge has to be asked; returns at once."""
        ...

    def read(self) -> GaugeReading:
        """The reading that was asked for, or the newest; with a fault where none came in time."""
        ...

    def close(self) -> None:
        """Closes the gauge. May be called again."""
        ...


class Amplifier(Protocol):
    """Power and current of a motor: what a drive and a driver of a whole reel have in common.

    No method raises for what a device sends, does not send or does not take: the next reading has
    the fault. An exception counts as a fault, too.
    """

    def enable(self) -> None:
        """Gives the amplifier power, at the current written last. May take its time."""
        ...

    def write(self, current_counts: int) -> None:
        """Commands a motor current, and feeds the hardware's watchdog."""
        ...

    def disable(self) -> None:
        """Removes the amplifier's power in order: the current is at its safe value."""
        ...

    def safe_state(self) -> None:
        """Brings the hardware to its own safest state, from any state, at once."""
        ...

    def close(self) -> None:
        """Closes the hardware, without power. May be called again."""
        ...


class Drive(Amplifier, Protocol):
    """Amplifier and encoder without a gauge."""

    def request(self) -> None:
        """Asks for the encoder; returns at once."""
        ...

    def position(self) -> Position:
        """The encoder's counts; with a fault where they did not come in time."""
        ...


class Driver(Amplifier, Protocol):
    """Hardware of one reel. A context manager: leaving it closes it.

    `read` and `write` return within a small part of the sampling period.
    """

    def read(self) -> Reading:
        """Reads gauge and encoder; see `bad_reading`."""
        ...

    def __enter__(self) -> Self:
        """The driver itself."""
        ...

    def __exit__(self, *_: object) -> None:
        """Closes it."""
        ...


def load_driver(use: str, settings: Mapping[str, Any]) -> Driver:
    """The driver that a rig's file names, called with its settings; see `load_part`."""
    driver: Driver = load_part(use, settings, Driver)
    return driver


def load_part(use: str, settings: Mapping[str, Any], kind: type[Any]) -> Any:
    """A driver, drive or gauge that a rig's file names, called with its settings.

    Args:
        use: Its name in the entry point group `estune.drivers`, or `module:attribute`.
        settings: Keyword arguments.
        kind: `Driver`, `Drive` or `Gauge`.

    Raises:
        InvalidInput: there is none, it does not take the settings, or it is of another kind.
        RigError: it cannot reach its hardware.
    """
    if ":" in use:
        reference = use
    else:
        offered = plugins(ENTRY_POINTS)
        if use not in offered:
            raise InvalidInput(
                f"no installed package offers a driver {use!r} "
                f"(there {'is: ' + ', '.join(sorted(offered)) if offered else 'is none'}); "
                "name an installed one, or give module:attribute"
            )
        reference = offered[use].value
    part = load(reference, settings)
    methods = inspect.getmembers(kind, inspect.isfunction)
    missing = [name for name, _ in methods if not hasattr(part, name)]
    if missing:
        getattr(part, "close", lambda: None)()
        what = kind.__name__.lower()
        raise InvalidInput(f"{reference} is no {what}: it has no {', '.join(missing)}")
    return part
