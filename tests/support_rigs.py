"""A rig whose records come from a function, for tests of the code around it."""

import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import accumulate

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import RigError
from estune.trial import (
    OPTIONAL_COLUMNS,
    LinearModel,
    Outcome,
    RigDescription,
    RigLimits,
    TrialRecord,
    TrialRequest,
)
from estune.trial.profiles import StepProfile

RATE_HZ = 200.0
COLUMNS = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags")
COLUMNS += OPTIONAL_COLUMNS


def description(**changes) -> RigDescription:
    plain = RigDescription(
        name="scripted",
        gains=Gains(0.5, 10.0, 0.005, 0.02),
        controller=ControllerSettings(RATE_HZ, 0.002, -100.0, float("inf")),
        newtons_per_ampere=20.0,
        limits=RigLimits(0.0, 50.0, 5.0),
        step=StepProfile(10.0, 5.0, 0.1, 0.5),
        settling_time_s=0.2,
        cable_length_m=0.8,
        linear_model=LinearModel(((0.0, 1.0), (-4.0, -0.1)), (0.0, 1.0), (4.0, 0.0), 0.0, 0.005),
        software="test 1",
        simulated=True,
    )
    return replace(plain, **changes)


def response(request: TrialRequest) -> TrialRecord:
    """First-order response, faster at higher P; the trial's number seeds its noise."""
    profile = request.profile
    setpoint = profile.setpoint(RATE_HZ)
    time = np.arange(setpoint.size) / RATE_HZ
    pole = np.exp(-request.gains.P / 0.05 / RATE_HZ)
    steps = ((1.0 - pole) * (setpoint - profile.preload_N)).tolist()[:-1]
    change = np.array([*accumulate(steps, lambda y, x: x + pole * y, initial=0.0)])
    noise = np.random.default_rng(request.number).normal(0.0, 0.04, time.size)
    tension = profile.preload_N + change + noise
    return TrialRecord(
        trial_id=request.trial_id,
        rig="scripted",
        sampling_Hz=RATE_HZ,
        cable_length_m=0.8,
        preload_N=profile.preload_N,
        gains=request.gains,
        outcome=Outcome.DONE,
        reason="",
        started_at="2009-05-04T12:00:00+02:00",
        software="test 1",
        time_s=time,
        setpoint_N=setpoint,
        tension_N=tension,
        current_A=tension / 20.0,
        angle_rad=np.zeros_like(time),
        flags=np.zeros(time.size, np.uint8),
        reference_N=tension - 0.1,
        loop=profile.loop,
        profile=profile.kind,
    )


def diverged(request: TrialRequest) -> TrialRecord:
    """Response of a loop that diverges to infinity halfway."""
    record = response(request)
    tension = np.array(record.tension_N)
    tension[tension.size // 2 :] = np.nan
    tension[-1] = np.inf
    reason = "the tension is not finite from sample 50 on"
    return replace(record, tension_N=tension, outcome=Outcome.DIVERGED, reason=reason)


def broken(request: TrialRequest) -> TrialRecord:
    """Raises an error like a rig whose program fails."""
    raise ZeroDivisionError(f"no answer to {request.number}")


class ScriptedRig:
    """Rig whose records a function computes; implements `estune.trial.Rig`.

    Attributes:
        requests: The requested trials, in order, repeats included.
    """

    def __init__(
        self,
        answer: Callable[[TrialRequest], TrialRecord] = response,
        *,
        duration_s: float = 0.0,
        **changes,
    ) -> None:
        """`duration_s` is the duration of each trial; `changes` apply to the description."""
        self.requests: list[TrialRequest] = []
        self._answer = answer
        self._duration_s = duration_s
        self._description = description(**changes)
        self._records: dict[str, tuple[TrialRequest, TrialRecord]] = {}
        self._idle = threading.Lock()
        self._running = threading.Event()
        self._stop = threading.Event()
        self._latched = ""
        self._closed = False

    def describe(self) -> RigDescription:
        self._check_open()
        return self._description

    def run(self, request: TrialRequest) -> TrialRecord:
        self._check_free()
        self.requests.append(request)
        with self._idle:
            if request.trial_id in self._records:
                asked, record = self._records[request.trial_id]
                if asked != request:
                    raise RigError(f"another trial has the id {request.trial_id}")
                return record
            self._description.limits.check(request.profile)
            self._stop.clear()
            self._running.set()
            try:
                self._check_free()
                record = self._perform(request)
            finally:
                self._running.clear()
            self._records[request.trial_id] = request, record
            return record

    def _perform(self, request: TrialRequest) -> TrialRecord:
        live = self._description
        self._description = replace(live, gains=request.gains)
        try:
            record = replace(self._answer(request), rig=live.name)
            if self._stop.wait(self._duration_s):
                record = replace(record, outcome=Outcome.CANCELLED, reason="stopped")
            return record
        finally:
            self._description = live

    def apply(self, gains: Gains) -> None:
        self._check_free()
        with self._idle:
            self._description = replace(self._description, gains=gains)

    def abort(self) -> RigDescription:
        self._check_open()
        while not self._idle.acquire(timeout=0.01):
            if self._running.is_set():
                self._stop.set()
        self._idle.release()
        return self._description

    def estop(self, reason: str) -> None:
        self._latched = self._latched or reason
        self._stop.set()

    def clear(self) -> None:
        self._latched = ""

    def close(self) -> None:
        self._closed = True

    def _check_free(self) -> None:
        self._check_open()
        if self._latched:
            raise RigError(f"the rig is held in its safe state ({self._latched})")

    def _check_open(self) -> None:
        if self._closed:
            raise RigError("the rig is closed")


def same(one: TrialRecord, other: TrialRecord) -> bool:
    """Whether two records are equal bit for bit."""
    columns = ((getattr(one, name), getattr(other, name)) for name in COLUMNS)
    alike = all(
        a is b is None or (a.dtype == b.dtype and a.tobytes() == b.tobytes()) for a, b in columns
    )
    nothing = dict.fromkeys(COLUMNS)
    return alike and repr(replace(one, **nothing)) == repr(replace(other, **nothing))
