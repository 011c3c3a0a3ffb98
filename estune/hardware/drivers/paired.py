"""A drive and a gauge as one driver: no drive measures tension."""

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any, Self

from estune.hardware.driver import (
    CountsMessages,
    Drive,
    Gauge,
    MessageCount,
    Reading,
    bad_reading,
    load_part,
)


class PairedDriver:
    """A drive with a gauge beside it; implements `estune.hardware.Driver`.

    A reading has the gauge's time: the loop closes on the tension.

    Args:
        drive: Name of the drive, or module:attribute.
        gauge: Name of the gauge, or module:attribute.
        drive_settings: Keyword arguments of the drive.
        gauge_settings: Keyword arguments of the gauge.

    Raises:
        InvalidInput: there is no such part, or it does not take the settings.
        RigError: a part cannot be reached.
    """

    def __init__(
        self,
        drive: str,
        gauge: str,
        drive_settings: Mapping[str, Any],
        gauge_settings: Mapping[str, Any],
    ) -> None:
        self._last: Reading | None = None
        self._stack = ExitStack()
        try:
            self._drive: Drive = load_part(drive, drive_settings, Drive)
            self._stack.callback(self._drive.close)
            self._gauge: Gauge = load_part(gauge, gauge_settings, Gauge)
            self._stack.callback(self._gauge.close)
        except BaseException:
            self._stack.close()
            raise
        self.enable = self._drive.enable
        self.write = self._drive.write
        self.disable = self._drive.disable
        self.safe_state = self._drive.safe_state

    @property
    def waited_s(self) -> float:
        """Time spent waiting for both, s."""
        return sum(part.waited_s for part in self._counting)

    def messages(self) -> tuple[MessageCount, ...]:
        """Messages of the parts that count theirs."""
        return tuple(message for part in self._counting for message in part.messages())

    @property
    def _counting(self) -> list[CountsMessages]:
        return [part for part in (self._drive, self._gauge) if isinstance(part, CountsMessages)]

    def read(self) -> Reading:
        """Reads both, one request on the way while the other is answered."""
        self._gauge.request()
        self._drive.request()
        time_s, gauge_counts, gauge_fault = self._gauge.read()
        encoder_counts, drive_fault = self._drive.position()
        if fault := drive_fault or gauge_fault:
            return bad_reading(fault, self._last)
        self._last = Reading(time_s, gauge_counts, encoder_counts)
        return self._last

    def close(self) -> None:
        """Closes both. May be called again."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.disable()
        finally:
            self.close()
