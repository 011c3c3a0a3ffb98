"""What hardware has to offer, in its own raw counts, and how it is found.

A driver is loaded in the process of the real-time loop, from the settings in the rig's file, and
is called by one thread. It knows nothing of newtons, gains or limits: calibrations C1 and C2, the
controller and the guard stand between it and a trial.
"""

from importlib.metadata import entry_points
from typing import Any, NamedTuple, Protocol, Self

from estune.errors import InvalidInput
from estune.run.targets import load

ENTRY_POINTS = "estune.drivers"
"""The entry point group by which an installed package offers drivers by name."""


class Reading(NamedTuple):
    """What was read of the sensors at one instant.

    Attributes:
        time_s: When, on the system's monotonic clock (`time.monotonic`), s. Best the moment the
            converter latched the gauge.
        gauge_counts: The strain gauge's converter, counts. NaN where the converter itself tells
            that it is overloaded or not ready.
        encoder_counts: The drum's encoder, counts, unwrapped: it goes on past a turn.
    """

    time_s: float
    gauge_counts: float
    encoder_counts: int


class Driver(Protocol):
    """The hardware of one reel. A context manager: leaving it closes it.

    `read` and `write` return within a small part of the sampling period, or raise. Whatever any
    of them raises ends motion: the loop calls `safe_state` and gives the hardware up.
    """

    def enable(self) -> None:
        """Gives the amplifier power, at the current written last. May take its time."""
        ...

    def read(self) -> Reading:
        """Reads gauge and encoder."""
        ...

    def write(self, current_counts: int) -> None:
        """Commands a motor current, and tells the hardware's watchdog that the loop lives."""
        ...

    def disable(self) -> None:
        """Takes the amplifier's power away, in order: the current is at its safe value."""
        ...

    def safe_state(self) -> None:
        """Brings the hardware to the safest state it has by itself, from any state, at once."""
        ...

    def close(self) -> None:
        """Lets go of the hardware, without power. May be called again."""
        ...

    def __enter__(self) -> Self:
        """The driver itself."""
        ...

    def __exit__(self, *_: object) -> None:
        """Closes it."""
        ...


def load_driver(use: str, settings: dict[str, Any]) -> Driver:
    """Makes the driver that a rig's file names.

    Args:
        use: Its name in the entry point group `estune.drivers`, or `module:attribute`.
        settings: What it is called with.

    Raises:
        InvalidInput: there is no such driver, or it does not take the settings.
        RigError: it cannot reach its hardware.
    """
    if ":" in use:
        reference = use
    else:
        offered = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
        if use not in offered:
            raise InvalidInput(
                f"no installed package offers a driver {use!r} "
                f"(there {'is: ' + ', '.join(sorted(offered)) if offered else 'is none'}); "
                "name an installed one, or give module:attribute"
            )
        reference = offered[use]
    driver: Driver = load(reference, settings)
    missing = [name for name in vars(Driver) if _is_verb(name) and not hasattr(driver, name)]
    if missing:
        raise InvalidInput(f"{reference} is no driver: it has no {', '.join(missing)}")
    return driver


def _is_verb(name: str) -> bool:
    return not name.startswith("_") or name in ("__enter__", "__exit__")
