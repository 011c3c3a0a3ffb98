"""Time that a driver's exchange takes, and its messages, measured without power at the motor."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import RigError
from estune.hardware.driver import CountsMessages, Driver, MessageCount
from estune.hardware.driver_link import read_safely

FAILED_MAX = 20
"""Number of failed readings after which the measurement ends: nothing answers in time."""


@dataclass(frozen=True, slots=True)
class ExchangeTiming:
    """Readings and commands at the sampling rate.

    Attributes:
        exchange_s: Time of a reading and a command together, shape (readings,).
        waited_s: Mean part of it spent waiting for answers; NaN where the driver does not count.
        wire_s: Mean part of it that the messages need on the bus; NaN likewise.
        messages: Messages during the measurement, by kind; empty where the driver does not count.
    """

    sampling_Hz: float
    seconds: float
    exchange_s: FloatArray
    waited_s: float
    wire_s: float
    time_s: FloatArray
    gauge_counts: FloatArray
    failed: int
    messages: tuple[MessageCount, ...]

    def quantile_s(self, share: float) -> float:
        """Quantile of the exchange's time, s."""
        return float(np.quantile(self.exchange_s, share))

    @property
    def parts_s(self) -> Mapping[str, float]:
        """Mean time of bus, adapter with device, and host, s; empty where they are not known.

        The bus's is computed from the messages' lengths. Where all waiting is shorter, the port
        has no line of that rate (USB of its own, an emulated device), and none of it is the bus's.
        """
        if not self.messages:
            return {}
        wire_s = self.wire_s if self.wire_s <= self.waited_s else 0.0
        host_s = float(np.mean(self.exchange_s)) - self.waited_s
        return {"bus": wire_s, "adapter": self.waited_s - wire_s, "host": host_s}


def measure_exchanges(driver: Driver, sampling_Hz: float, seconds: float) -> ExchangeTiming:
    """Reads, and commands zero counts, at the sampling rate; the amplifier is left without power.

    Raises:
        RigError: hardly a reading comes in time.
    """
    samples = max(round(seconds * sampling_Hz), 2)
    rows: list[tuple[float, float, float]] = []
    failed = 0
    before, waited_s = _messages(driver), _waited_s(driver)
    instant_s = first_s = time.monotonic()
    for _ in range(samples):
        instant_s = max(instant_s + 1.0 / sampling_Hz, time.monotonic())
        time.sleep(max(0.0, instant_s - time.monotonic()))
        began_s = time.monotonic()
        reading = read_safely(driver, None)
        if reading.fault:
            failed += 1
            if failed >= min(FAILED_MAX, samples):
                raise RigError(
                    f"{failed} of {failed + len(rows)} readings failed ({reading.fault}); check "
                    "the device's settings and the line"
                )
            continue
        driver.write(0)
        rows.append((time.monotonic() - began_s, reading.time_s, reading.gauge_counts))
    seconds = time.monotonic() - first_s
    exchange_s, time_s, counts = np.array(rows, np.float64).reshape(-1, 3).T
    messages = tuple(
        MessageCount(new.name, new.expected - old.expected, new.seen - old.seen, new.wire_s)
        for new, old in zip(_messages(driver), before, strict=True)
    )
    wire_s = sum(np.nanmax([m.expected, m.seen]) * m.wire_s for m in messages) / samples
    return ExchangeTiming(
        sampling_Hz,
        seconds,
        exchange_s,
        (_waited_s(driver) - waited_s) / samples if messages else math.nan,
        wire_s if messages else math.nan,
        time_s,
        counts,
        failed,
        messages,
    )


def _messages(driver: Driver) -> tuple[MessageCount, ...]:
    return driver.messages() if isinstance(driver, CountsMessages) else ()


def _waited_s(driver: Driver) -> float:
    return driver.waited_s if isinstance(driver, CountsMessages) else 0.0
