"""Checks of a rig's driver: messages, time budget, and the timing of the loop around it."""

import math

import numpy as np

from estune.cli.checks.check_result import CheckResult, fine, fix, unknown
from estune.hardware.exchange_timing import ExchangeTiming
from estune.hardware.shared_memory import Timing, quantile_s

PERIOD_SHARE_MAX = 0.5
"""Greatest share of the sampling period that an exchange may take at the 99th percentile."""

MISSING_MAX = 0.05
"""Maximum share of missing messages."""

TO_THE_BOARD = "move the loop to the board: estune export-controller FILE --c --board"

_FASTER = {
    "bus": "raise the rate of the bus",
    "adapter": "use an interface that does not hold messages back",
    "host": "give the loop real-time priority and a core of its own",
}


def check_messages(timing: ExchangeTiming) -> CheckResult:
    """Whether the messages come that were asked for, or are due."""
    if not timing.messages:
        return unknown("messages", "not stated: the driver does not count its messages")
    figures: dict[str, float] = {}
    parts, missing = [], []
    for message in timing.messages:
        expected_Hz, seen_Hz = (n / timing.seconds for n in (message.expected, message.seen))
        figures |= {f"{message.name}_seen_Hz": seen_Hz, f"{message.name}_expected_Hz": expected_Hz}
        due = "no rate stated" if math.isnan(expected_Hz) else f"{expected_Hz:.4g} expected"
        seen = "not confirmed" if math.isnan(seen_Hz) else f"{seen_Hz:.4g} Hz"
        parts.append(f"{message.name} {seen} ({due})")
        # One more may be on its way at the end.
        if message.seen < (1.0 - MISSING_MAX) * message.expected - 1.0:
            missing.append(message.name)
    if missing:
        return fix(
            "messages",
            f"{', '.join(parts)}: {' and '.join(missing)} missing",
            "set its rate in the device and in the rig's file, and check load, rate and "
            "termination of the bus",
            **figures,
        )
    return fine("messages", ", ".join(parts), **figures)


def check_exchange(timing: ExchangeTiming) -> CheckResult:
    """Whether reading and commanding leave the loop half of its period."""
    period_ms = 1e3 / timing.sampling_Hz
    middle_ms, slow_ms = (1e3 * timing.quantile_s(share) for share in (0.5, 0.99))
    parts = {name: 1e3 * part_s for name, part_s in timing.parts_s.items()}
    figures = {"exchange_median_ms": middle_ms, "exchange_p99_ms": slow_ms}
    figures |= {f"{name}_ms": part for name, part in parts.items()}
    sentence = (
        f"a reading and a command take {middle_ms:.2g} ms, slowest hundredth {slow_ms:.2g} ms, of "
        f"a period of {period_ms:.3g} ms"
    )
    if parts:
        named = {"adapter": "adapter and device"}
        budget = ", ".join(f"{named.get(name, name)} {ms:.2g} ms" for name, ms in parts.items())
        sentence += f"; on average {budget}"
    if slow_ms <= PERIOD_SHARE_MAX * period_ms:
        return fine("time budget", sentence, **figures)
    faster = _FASTER[max(parts, key=lambda name: parts[name])] if parts else "use a faster bus"
    return fix(
        "time budget",
        f"{sentence}: more than {100 * PERIOD_SHARE_MAX:.0f} % is too much for a loop on the host",
        f"{faster}, or {TO_THE_BOARD}",
        **figures,
    )


def check_readings(timing: ExchangeTiming) -> CheckResult:
    """Whether every reading came, with a number of the gauge."""
    asked = timing.exchange_s.size + timing.failed
    invalid = int(np.isnan(timing.gauge_counts).sum())
    figures = {"asked": float(asked), "late": float(timing.failed), "invalid": float(invalid)}
    if timing.failed:
        return fix(
            "readings",
            f"{timing.failed} of {asked} readings did not come in time, repeats included",
            "check connectors, shield, termination and supply: the bus loses messages",
            **figures,
        )
    if invalid:
        return fix(
            "readings",
            f"{invalid} of {asked} readings have no number of the gauge: overload, or not ready",
            "unload the gauge and check its wiring and its converter's rate",
            **figures,
        )
    return fine("readings", f"all of {asked} came, each with a number of the gauge", **figures)


def check_loop(timing: Timing, sampling_Hz: float) -> CheckResult:
    """Whether the loop commands its current in the first half of the period."""
    shares = {"median": 0.5, "p99": 0.99, "p99_9": 0.999}
    figures = {
        f"{what}_{name}_us": 1e6 * quantile_s(getattr(timing, what), share)
        for what in ("lateness", "turnaround")
        for name, share in shares.items()
    }
    late_us, commanded_us = figures["lateness_p99_us"], figures["turnaround_p99_us"]
    sentence = (
        f"{timing.late} of {timing.samples} samples late, {timing.missed} left out; slowest "
        f"hundredth begun after {late_us:.0f} us and commanded after {commanded_us:.0f} us"
    )
    if commanded_us > 1e6 * PERIOD_SHARE_MAX / sampling_Hz:
        return fix("loop", sentence, f"{_FASTER['host']}, or {TO_THE_BOARD}", **figures)
    return fine("loop", sentence, **figures)
