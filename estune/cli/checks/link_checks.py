"""Checks of the link: round-trip time and clocks."""

import statistics
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import NamedTuple

from estune.cli.checks.check_result import CheckResult, fine, fix
from estune.remote.state_machine.state import LEASE_S, RENEW_S

QUESTIONS = 200
OFFSET_MAX_S = 1.0
"""Maximum clock offset: beyond it, records cannot be assigned by their time."""

_REMEDY = "let NTP (chrony, systemd-timesyncd) set the clocks"


class Dated(NamedTuple):
    """Times of a trial, by this machine's clock and the rig's.

    Attributes:
        asked_s: Time of day of the request, s.
        answered_s: Time of day of the record's arrival, s.
        elapsed_s: Time from the first request to this record, on a monotonic clock, s.
        started_at: Start of the trial in the record.
    """

    asked_s: float
    answered_s: float
    elapsed_s: float
    started_at: str


def round_trips_s(ask: Callable[[], object], questions: int = QUESTIONS) -> list[float]:
    """Round-trip time of each of several queries, s."""
    taken = []
    for _ in range(questions):
        began_s = time.perf_counter()
        ask()
        taken.append(time.perf_counter() - began_s)
    return taken


def check_link(taken_s: Sequence[float]) -> CheckResult:
    """Whether renewals of the lease arrive in time."""
    median_ms = 1e3 * statistics.median(taken_s)
    slow_ms = 1e3 * statistics.quantiles(taken_s, n=100)[-1]
    figures = {"round_trip_median_ms": median_ms, "round_trip_p99_ms": slow_ms}
    sentence = f"round trip {median_ms:.2g} ms, slowest hundredth {slow_ms:.2g} ms"
    if slow_ms > 1e3 * RENEW_S:
        return fix(
            "link",
            f"{sentence}: the lease, {LEASE_S:g} s renewed every {RENEW_S:g} s, may be lost in "
            "the middle of a trial",
            "use a wired network, or run estune on the rig's own machine",
            **figures,
        )
    return fine("link", sentence, **figures)


def check_clock(dated: Sequence[Dated]) -> CheckResult:
    """Whether the rig's clock agrees with this machine's, and neither jumps."""
    low_s, high_s = float("-inf"), float("inf")
    for trial in dated:
        stepped_s = trial.answered_s - dated[0].asked_s - trial.elapsed_s
        if abs(stepped_s) > 0.1 * OFFSET_MAX_S:
            return fix(
                "clock",
                f"this machine's clock jumped by {stepped_s:+.2g} s in or between the trials",
                _REMEDY,
            )
        try:
            started = datetime.fromisoformat(trial.started_at)
        except ValueError:
            started = None
        if started is None or started.tzinfo is None:
            return fix(
                "clock",
                f"the rig dates a trial {trial.started_at!r}",
                "use ISO 8601 with offset, as 2009-05-04T12:00:00+02:00",
            )
        # The trial began between the request and the record.
        low_s = max(low_s, started.timestamp() - trial.answered_s)
        high_s = min(high_s, started.timestamp() - trial.asked_s)
    figures = {"clock_offset_low_s": low_s, "clock_offset_high_s": high_s}
    if low_s > high_s:
        return fix(
            "clock",
            f"the rig's clock jumped between trials, by {low_s - high_s:.2g} s or more",
            _REMEDY,
            **figures,
        )
    sentence = f"the rig's clock is {low_s:+.2g} to {high_s:+.2g} s from this machine's"
    if low_s > OFFSET_MAX_S or high_s < -OFFSET_MAX_S:
        return fix("clock", sentence, _REMEDY, **figures)
    return fine("clock", sentence, **figures)
