"""Checks of a rig: faults, remedies, and no motion without permission."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from estune.cli.checks import REPEATS, State, gentle_trial, run_checks
from estune.cli.checks.current_loop_check import expected_gain
from estune.cli.checks.driver_checks import check_exchange, check_messages
from estune.cli.checks.trial_checks import check_gauge_rate
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import RigError
from estune.hardware.driver import MessageCount
from estune.hardware.exchange_timing import ExchangeTiming
from estune.remote.messages import Status
from estune.remote.state_machine.state import Mode
from estune.trial import LATE, SATURATED, LinearModel, Outcome, RigLimits
from tests.support_rigs import ScriptedRig, description, diverged, response

# A lag of 0.2 s, which the gains of the scripted rig hold with margins to spare.
MODEL = LinearModel(((-5.0,),), (5.0,), (1.0,), 0.0, 0.005)


class Patient(ScriptedRig):
    """A scripted rig that says what it does, too."""

    latched = ""

    def __init__(self, answer, **changes) -> None:
        super().__init__(answer, **({"linear_model": MODEL} | changes))

    def status(self) -> Status:
        return Status("0f", Mode.SAFE if self.latched else Mode.IDLE, "", 0, "", self.latched)


def dated(request):
    """A response of now, as a rig in good order gives it."""
    return replace(response(request), started_at=datetime.now(UTC).isoformat())


def found(rig: Patient, *, move: bool = True) -> dict[str, list[State]]:
    """What the checks came to."""
    findings = {f.check: f for f in run_checks(rig, "unixsock-stream/rig", move=move)}
    for finding in findings.values():
        assert finding.state is not State.FIX or finding.remedy
    return {check: finding.state for check, finding in findings.items()}


def to_fix(rig: Patient) -> set[str]:
    return {check for check, state in found(rig).items() if state is State.FIX}


def changed(**columns):
    """Responses with some columns changed by functions of the record."""

    def answer(request):
        record = dated(request)
        return replace(record, **{name: change(record) for name, change in columns.items()})

    return answer


def test_sound_rig_passes_all_checks():
    states = found(Patient(dated))
    assert set(states.values()) <= {State.FINE, State.UNKNOWN}
    for check in ("state", "link", "limits", "live gains", "trials", "clock", "sampling"):
        assert states[check] is State.FINE
    for check in ("gauge", "cost", "restored"):
        assert states[check] is State.FINE


def test_checks_move_nothing_unless_allowed():
    rig = Patient(dated)
    assert found(rig, move=False)["trials"] is State.UNKNOWN
    assert rig.requests == []


def test_check_trial_is_gentle_and_uses_live_gains():
    rig = Patient(dated)
    found(rig)
    about = description()
    assert {request.gains for request in rig.requests} == {about.gains}
    gentle = gentle_trial(about)
    assert [r.profile for r in rig.requests] == [gentle] * REPEATS + [replace(gentle, loop="open")]
    assert abs(gentle_trial(about).step_N) < abs(about.step.step_N)


def test_rig_in_emergency_stop_is_not_moved():
    rig = Patient(dated)
    rig.latched = "smoke"
    assert to_fix(rig) == {"state"}
    assert rig.requests == []


INFINITE = RigLimits(0.0, math.inf, 5.0)


TOO_WEAK = ControllerSettings(200.0, 0.002, -100.0, 12.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"limits": INFINITE, "simulated": False},
        {"limits": RigLimits(0.0, 12.0, 5.0)},
        {"limits": RigLimits(0.0, 50.0, 0.1)},
        {"controller": TOO_WEAK},
        {"settling_time_s": 0.45},
    ],
)
def test_unusable_limits_fail_and_nothing_moves(changes):
    rig = Patient(dated, **changes)
    assert "limits" in to_fix(rig)
    assert rig.requests == []


def test_gains_without_margins_fail():
    assert to_fix(Patient(dated, gains=Gains(50.0, 5000.0, 0.0, 0.02))) == {"live gains"}


def test_margins_without_a_model_are_unknown():
    assert found(Patient(dated, linear_model=None))["live gains"] is State.UNKNOWN


def late(record):
    return np.where(np.arange(record.flags.size) % 20 == 0, LATE, 0).astype(np.uint8)


def saturated(record):
    return np.where(np.arange(record.flags.size) % 2, SATURATED, 0).astype(np.uint8)


def skipped(record):
    period_s = 1.0 / record.sampling_Hz
    return record.time_s + np.where(np.arange(record.time_s.size) > 40, period_s, 0.0)


def noisy(record):
    seed = int(record.trial_id[-2:])
    return record.tension_N + np.random.default_rng(seed).normal(0.0, 0.5, record.time_s.size)


def drifting(record):
    return record.tension_N + 0.2 * int(record.trial_id[-2:])


def with_nan(record):
    return np.where(record.time_s > 0.3, math.nan, record.tension_N)


def sluggish(record):
    """Every other trial is slow: levels are the same, the way between them is not."""
    if int(record.trial_id[-2:]) % 2:
        return record.tension_N
    step_N = gentle_trial(description()).step_N
    return record.tension_N - 0.7 * step_N * (record.time_s >= 0.1) * np.exp(
        (0.1 - record.time_s) / 0.1
    )


@pytest.mark.parametrize(
    ("check", "answer"),
    [
        ("sampling", changed(flags=late)),
        ("sampling", changed(time_s=skipped)),
        ("gauge", changed(tension_N=drifting)),
        ("gauge", changed(tension_N=lambda record: record.tension_N + 1.0)),
        ("cost", changed(flags=saturated)),
        ("cost", changed(tension_N=sluggish)),
        ("trials", changed(tension_N=with_nan)),
        ("trials", changed(angle_rad=lambda record: record.angle_rad[:-1])),
        ("trials", diverged),
        ("clock", changed(started_at=lambda _: "yesterday")),
        ("clock", changed(started_at=lambda _: "2009-05-04T12:00:00")),
        ("clock", changed(started_at=lambda _: "2009-05-04T12:00:00+02:00")),
    ],
)
def test_record_faults_fail_their_check(check, answer):
    assert check in to_fix(Patient(answer))


def test_nothing_moves_after_a_trial_that_did_not_run_to_its_end():
    rig = Patient(diverged)
    assert "trials" in to_fix(rig)
    assert len(rig.requests) == 1


def test_noisy_gauge_fails():
    assert "gauge" in to_fix(Patient(changed(tension_N=noisy)))


def test_constant_gauge_fails_unless_simulated():
    flat = changed(tension_N=lambda record: record.setpoint_N)
    real = {"simulated": False, "controller": ControllerSettings(200.0, 0.002, -100.0, 100.0)}
    assert found(Patient(flat, **real))["gauge"] is State.FIX
    assert found(Patient(flat))["gauge"] is State.FINE


def test_rig_that_does_not_restore_its_gains_fails():
    class Forgetful(Patient):
        def run(self, request):
            record = super().run(request)
            self.apply(replace(request.gains, P=2.0))
            return record

    assert "restored" in to_fix(Forgetful(dated))


def in_open_loop(change):
    """Responses whose open-loop step is changed by a function of the record."""

    def answer(request):
        record = dated(request)
        return change(record) if request.profile.loop == "open" else record

    return answer


def turned(record, factor):
    level_N = record.preload_N
    return replace(record, tension_N=level_N + factor * (record.tension_N - level_N))


def refused(_record):
    raise RigError("no open loop here")


@pytest.mark.parametrize(
    ("change", "state"),
    [
        (lambda record: record, State.FINE),
        (lambda record: turned(record, -1.0), State.FIX),
        (lambda record: turned(record, 0.6), State.FIX),
        (lambda record: turned(record, 0.0), State.FIX),
        # 60 ms of dead time, where the rig is to settle within 200 ms.
        (lambda record: replace(record, tension_N=np.roll(record.tension_N, 12)), State.FIX),
        (lambda record: replace(record, outcome=Outcome.GUARD, reason="travel"), State.FIX),
        (refused, State.UNKNOWN),
        # Slow: at the end it is on its way.
        (lambda record: turned(record, np.linspace(0.0, 0.5, record.time_s.size)), State.FINE),
    ],
)
def test_current_loop_is_judged_by_sign_scale_and_delay_of_an_open_step(change, state):
    def commanded(record):
        return change(replace(record, current_A=record.setpoint_N / 20.0))

    assert found(Patient(in_open_loop(commanded)))["current loop"] is state


INTEGRATOR = LinearModel(((0.0,),), (1.0,), (1.0,))


HALF = LinearModel(((-5.0,),), (2.5,), (1.0,))


def test_open_step_is_of_a_plant_with_a_rest_and_judged_by_its_gain():
    rig = Patient(dated, linear_model=INTEGRATOR)
    assert found(rig)["current loop"] is State.UNKNOWN
    assert {request.profile.loop for request in rig.requests} == {"closed"}
    assert found(Patient(dated, linear_model=HALF))["current loop"] is State.FIX
    assert expected_gain(description(linear_model=HALF)) == pytest.approx(0.5)
    assert expected_gain(description(linear_model=None)) == 1.0
    other = description(linear_model=None, measurement="speed, rad/s")
    assert expected_gain(other) is None


def gauge(rate_Hz, resolution_N, noise_N=0.04, samples=2000):
    """Readings at 632 Hz of a gauge that converts at a rate of its own."""
    values = np.random.default_rng(5).normal(15.0, noise_N, samples)
    newest = np.floor(np.arange(samples) / 632.0 * rate_Hz + 1e-9).astype(int)
    return np.round(values[newest] / resolution_N) * resolution_N


@pytest.mark.parametrize(
    ("rate_Hz", "resolution_N", "state"),
    [
        (632.0, 1e-6, State.FINE),
        (632.0, 0.01, State.FINE),  # a tenth of the readings repeat by chance
        (320.0, 1e-6, State.FIX),
        (80.0, 1e-6, State.FIX),
        (80.0, 0.01, State.FIX),
        (632.0, 0.1, State.UNKNOWN),
    ],
)
def test_gauge_that_converts_slower_than_the_loop_fails(rate_Hz, resolution_N, state):
    result = check_gauge_rate([gauge(rate_Hz, resolution_N)], 632.0)
    assert result.state is state
    if state is State.FIX:
        assert result.figures["gauge_rate_Hz"] == pytest.approx(rate_Hz, rel=0.1)
        assert "ms old, which is dead time" in result.sentence


READINGS = (MessageCount("reading", 100, 100, 0.0),)


def exchanges(exchange_ms, waited_ms, wire_ms, messages=READINGS):
    times = np.full(100, 1e-3 * exchange_ms)
    parts = 1e-3 * waited_ms, 1e-3 * wire_ms
    return ExchangeTiming(632.0, 0.1, times, *parts, np.arange(100.0), times, 0, messages)


@pytest.mark.parametrize(
    ("timing", "state", "remedy"),
    [
        (exchanges(0.7, 0.6, 0.4), State.FINE, ""),
        (exchanges(0.9, 0.8, 0.7), State.FIX, "raise the rate of the bus, or move the loop"),
        (exchanges(0.9, 0.8, 0.1), State.FIX, "does not hold messages back, or move the loop"),
        (exchanges(0.9, 0.2, 0.1), State.FIX, "a core of its own, or move the loop"),
        (exchanges(0.9, 0.8, 8.0), State.FIX, "does not hold messages back"),  # USB of its own
        (exchanges(0.9, np.nan, np.nan, ()), State.FIX, "a faster bus, or move the loop"),
    ],
)
def test_loop_must_move_to_the_board_where_an_exchange_takes_half_a_period(timing, state, remedy):
    result = check_exchange(timing)
    assert result.state is state
    assert remedy in result.remedy
    if timing.messages:
        assert sum(timing.parts_s.values()) == pytest.approx(timing.exchange_s[0])


def test_messages_that_are_due_and_missing_fail():
    def judged(*messages):
        return check_messages(exchanges(0.1, 0.1, 0.0, messages))

    came = MessageCount("gauge", 8.0, 8, 0.0)
    assert judged(came, MessageCount("torque", 60, np.nan, 0.0)).state is State.FINE
    late = judged(came, MessageCount("encoder", 60, 30, 0.0))
    assert late.state is State.FIX
    assert "encoder 300 Hz (600 expected): encoder missing" in late.sentence
    assert judged(MessageCount("gauge", np.nan, 8, 0.0)).state is State.FINE
    assert judged().state is State.UNKNOWN
