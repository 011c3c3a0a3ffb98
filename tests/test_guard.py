"""The guard: which limit acts at which sample; a good reel triggers none."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune.errors import InvalidInput
from estune.hardware.guard_watch import GuardWatch
from estune.hardware.loop_messages import BeginTrial
from estune.hardware.shared_memory import MotionPhase
from estune.reel import guard
from estune.reel.guard import GuardWords, Limits, Reason, Sample

MS = 1e-3


def good(k: int) -> Sample:
    """Sample k, at 1 kHz, of a reel under good control."""
    tension = 15.0 + 0.01 * (k % 3)
    return Sample(k * MS, tension, 1000.0 + k % 3, 1.0, 0.1)


def stopped_at(limits: Limits, samples) -> tuple[int, guard.GuardTrip] | None:
    """First sample at which the guard acts, and its message."""
    watch = None
    for k, sample in enumerate(samples):
        watch, stop = guard.check_sample(limits, watch or guard.begin(sample), sample)
        if stop:
            return k, stop
    return None


def faulty(first: int, **changes):
    """Good samples with changes from one sample on; functions take the sample's number."""
    for k in range(first + 400):
        sample = good(k)
        if k >= first:
            columns = {n: v(k) if callable(v) else v for n, v in changes.items()}
            sample = sample._replace(**columns)
        yield sample


CASES = {
    "tension": (Limits(tension_max_N=20.0), {"tension_N": 20.001}, 50, Reason.TENSION),
    "slack": (Limits(slack_N=1.0, slack_s=0.0205), {"tension_N": 0.99}, 70, Reason.SLACK),
    "rate up": (Limits(rate_max_N_s=900.0), {"tension_N": 16.5}, 50, Reason.RATE),
    "rate down": (Limits(rate_max_N_s=900.0), {"tension_N": 13.5}, 50, Reason.RATE),
    "current": (
        Limits(current_max_A=2.0, current_s=0.0305),
        {"current_A": -2.01},
        80,
        Reason.CURRENT,
    ),
    "angle below": (Limits(angle_min_rad=-1.0), {"angle_rad": -1.01}, 50, Reason.ANGLE),
    "angle above": (Limits(angle_max_rad=1.0), {"angle_rad": 1.01}, 50, Reason.ANGLE),
    "travel out": (Limits(travel_max_rad=1.0), {"angle_rad": 1.11}, 50, Reason.TRAVEL),
    "travel in": (Limits(travel_max_rad=1.0), {"angle_rad": -0.91}, 50, Reason.TRAVEL),
    "cost": (Limits(cost_max=3.0), {"cost": lambda k: 0.01 * k}, 301, Reason.COST),
    "cost not a number": (Limits(cost_max=3.0), {"cost": math.nan}, 50, Reason.COST),
    "no reading": (Limits(), {"tension_N": math.nan}, 50, Reason.READING),
    "infinite reading": (Limits(), {"tension_N": math.inf}, 50, Reason.READING),
    "no angle": (Limits(), {"angle_rad": math.nan}, 50, Reason.READING),
    "frozen": (
        Limits(frozen_s=0.0205),
        {"gauge_counts": 5.0},
        71,
        Reason.FROZEN,
    ),
    "frozen, but for the time of bad readings": (
        Limits(frozen_s=0.0205),
        {"gauge_counts": 5.0, "held": lambda k: 60 <= k < 65},
        76,
        Reason.FROZEN,
    ),
    "counts not a number": (Limits(), {"tension_N": math.nan, "gauge_counts": math.nan}, 50, None),
    "clock stands still": (Limits(), {"time_s": 49 * MS}, 50, Reason.CLOCK),
    "clock goes back": (Limits(), {"time_s": 10 * MS}, 50, Reason.CLOCK),
    "clock not a number": (Limits(), {"time_s": math.nan}, 50, Reason.CLOCK),
    "gap": (Limits(gap_s=0.0305), {"time_s": lambda k: (k + 30) * MS}, 50, Reason.LATE),
    "late in a row": (Limits(late_in_a_row=10), {"late": True}, 60, Reason.LATE),
    "heartbeat": (
        Limits(heartbeat_s=0.1005),
        {"silence_s": lambda k: (k - 50) * MS},
        151,
        Reason.HEARTBEAT,
    ),
    "no heartbeat to be read": (Limits(), {"silence_s": math.nan}, 50, Reason.HEARTBEAT),
    "deadline": (Limits(duration_s=0.1005), {}, 101, Reason.DEADLINE),
}


@pytest.mark.parametrize("case", CASES)
def test_limits_trip_at_the_first_sample_above_them(case):
    limits, changes, expected, reason = CASES[case]
    at, stop = stopped_at(limits, faulty(50, **changes))
    assert at == expected
    assert stop.reason is (reason or Reason.READING)


@pytest.mark.parametrize(
    ("limits", "changes"),
    [
        (Limits(tension_max_N=20.0), {"tension_N": 20.0}),
        (Limits(slack_N=1.0, slack_s=0.02), {"tension_N": lambda k: 15.0 if k % 20 == 0 else 0.5}),
        (Limits(current_max_A=2.0, current_s=0.03), {"current_A": lambda k: 3.0 * (k % 30 > 0)}),
        (Limits(frozen_s=0.02), {"gauge_counts": lambda k: float(k // 20)}),
        (Limits(frozen_s=0.02), {"gauge_counts": 5.0, "held": True}),
        (Limits(late_in_a_row=10), {"late": lambda k: k % 11 > 0}),
        (Limits(slack_N=20.0, slack_s=0.0), {}),
    ],
    ids=["tension", "slack", "current", "frozen", "held", "late", "never taut"],
)
def test_samples_within_the_limits_do_not_trip(limits, changes):
    assert stopped_at(limits, faulty(50, **changes)) is None


def test_gauge_that_hangs_from_a_bridged_first_sample_on_is_frozen():
    samples = (good(k)._replace(gauge_counts=5.0, held=k == 0) for k in range(100))
    at, stop = stopped_at(Limits(frozen_s=0.0205), samples)
    assert (at, stop.reason) == (21, Reason.FROZEN)


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"guard": Limits(travel_max_rad=1.0)}, Reason.TRAVEL),
        ({"duration_s": 10.0}, Reason.DEADLINE),
        ({"cost_max": 10.0}, Reason.COST),
    ],
    ids=["travel", "time", "cost"],
)
def test_limits_of_a_trial_count_from_its_start(limits, reason):
    """The drum has turned, and time has passed, while it was held; so has a trial before."""
    usual = limits.pop("guard", Limits())
    plan = SimpleNamespace(guard=usual, motion=SimpleNamespace(take_up_s=1.0, taut_N=1.0))
    memory = SimpleNamespace(setpoint_N=np.full(30, 15.0), weights=np.ones(30))
    watch = GuardWatch(plan, memory)
    trial = {"open_loop": False, "cost_max": 1e9, "duration_s": 1e9} | limits
    for start in (0.0, 40.0):
        sample = Sample(start, 15.0, 0.0, 1.0, 0.0)
        assert watch.check(MotionPhase.HOLD, sample, 0) is None
        watch.begin_trial(BeginTrial(1, None, 30, **trial))
        for k in range(30):  # an error of 1 N, and a tenth of a radian and a second each
            sample = Sample(start + 20.0 + k, 16.0, float(k), 1.0, 0.1 * (9 + k))
            if stop := watch.check(MotionPhase.TRIAL, sample, k):
                break
        assert stop.reason is reason
        assert k == (10 if reason is Reason.COST else 11)
        watch.end_trial()


def test_trip_sentence_has_value_and_limit():
    _, stop = stopped_at(Limits(tension_max_N=20.0), faulty(5, tension_N=23.456))
    assert stop.sentence == "tension 23.46 N; limit 20 N"
    _, stop = stopped_at(Limits(slack_N=1.0, slack_s=0.02), faulty(5, tension_N=0.25))
    assert "0.25 N" in stop.sentence
    assert "limit 20 ms" in stop.sentence


def test_most_severe_reason_is_named_first():
    everything = Limits(tension_max_N=20.0, angle_max_rad=1.0, heartbeat_s=0.1)
    sample = {"tension_N": 99.0, "angle_rad": 9.0, "silence_s": 9.0}
    assert stopped_at(everything, faulty(5, **sample))[1].reason is Reason.TENSION
    only = {"silence_s": 9.0}
    assert stopped_at(everything, faulty(5, **only))[1].reason is Reason.HEARTBEAT
    assert stopped_at(everything, faulty(5, **sample, time_s=0.0))[1].reason is Reason.CLOCK


def test_gains_can_violate_only_limits_of_the_reel():
    blamed = {reason for reason in Reason if reason.is_caused_by_gains}
    assert blamed == {
        *(Reason.TENSION, Reason.SLACK, Reason.RATE, Reason.CURRENT),
        *(Reason.ANGLE, Reason.TRAVEL, Reason.COST),
    }
    senses = {Reason.READING, Reason.FROZEN, Reason.CLOCK, Reason.LATE}
    assert not any(reason.leaves_control for reason in senses)


anything = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.lists(
        st.builds(Sample, anything, anything, anything, anything, anything, st.booleans()),
        max_size=20,
    )
)
def test_guard_trips_on_any_reading_that_is_not_a_number(samples):
    limits = Limits(tension_max_N=60.0, slack_N=1.0, rate_max_N_s=1e4, current_max_A=3.0)
    watch = None
    for sample in samples:
        watch, stop = guard.check_sample(limits, watch or guard.begin(sample), sample)
        sound = all(map(math.isfinite, (sample.time_s, sample.tension_N, sample.angle_rad)))
        assert sound or stop is not None


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"tension_max_N": math.nan}, "tension_max_N is not a number"),
        ({"slack_s": -0.1}, "slack_s is -0.1"),
        ({"slack_N": 5.0, "tension_max_N": 5.0}, "not in order"),
        ({"angle_min_rad": 1.0, "angle_max_rad": -1.0}, "not in order"),
        ({"late_in_a_row": -1}, "late_in_a_row"),
    ],
)
def test_invalid_limits_are_refused(limits, message):
    with pytest.raises(InvalidInput, match=message):
        Limits(**limits)


@pytest.mark.parametrize("case", ["tension", "rate up", "current", "no reading"])
def test_sentences_of_another_machine_name_its_signals(case):
    limits, changes, _, _ = CASES[case]
    words = GuardWords("temperature", "degC", "duty", "%")
    _, stop = stopped_at(replace(limits, words=words), faulty(50, **changes))
    assert re.search(r"temperature|duty .* % for", stop.sentence)
    assert not re.search(r"tension|current|\bN\b|\bA\b", stop.sentence)
