"""A simulated platform in real time, and each of its reels as a rig that follows setpoints."""

import logging
import math
import threading
import time
from collections.abc import Sequence
from typing import Self

import numpy as np

from estune.core.gains import Gains
from estune.errors import RigError
from estune.reel import guard
from estune.reel.guard import GuardState, Limits
from estune.trial import (
    SETPOINT_S,
    Feedback,
    RigDescription,
    Setpoint,
    Telemetry,
    TrialRecord,
    TrialRequest,
)
from plants.bench.cable_platform.mechanism import Mechanism
from plants.bench.cable_platform.simulation import Simulation
from plants.simulation.simulated_rig import SimulatedRig

GUARD = Limits(tension_max_N=60.0, rate_max_N_s=8000.0)
"""Limits of each reel; those of the emulated reel in `plants/emulator/rig.toml`."""

RETURN_N_S = 50.0
"""Rate at which the setpoint returns to the hold tension, N/s."""

_log = logging.getLogger(__name__)

_WAKE_S = 1e-3
_BEHIND_S = 0.05
"""Time that is made up for after a pause of the thread, s; beyond, the simulation is late."""


class RealTimePlatform:
    """Runs a simulation in wall-clock time. A context manager.

    A reel whose setpoint has expired returns to its hold tension, that of its preload. A reel that
    violates a limit of the guard, or whose emergency stop is called, holds its angle until it is
    cleared.

    Attributes:
        lost_s: Time by which the simulation is behind the clock, s.
    """

    def __init__(self, mechanism: Mechanism, gains: Sequence[Gains] = (), seed: int = 0) -> None:
        self.lock = threading.Lock()
        self.simulation = Simulation(mechanism, gains, seed)
        self.lost_s = 0.0
        self._hold_N = self.simulation.setpoints.tension_N.copy()
        self._radius_m = np.array([reel.drum_radius_m for reel in mechanism.reels])
        self._amperes = np.array([1.0 / reel.newtons_per_ampere for reel in mechanism.reels])
        self._expires_s = np.zeros(self._hold_N.size)
        self._guards: list[GuardState | None] = [None] * self._hold_N.size
        self._latched = [""] * self._hold_N.size
        self._time_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._guarded_run, name="platform", daemon=True)

    def __enter__(self) -> Self:
        self.simulation.sample()  # builds the equations
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def reel(self, number: int, name: str, pace: float = 0.0) -> "PlatformReel":
        """A reel as a rig; a second of its trials takes `pace` seconds."""
        return PlatformReel(self, number, name, pace)

    def follow(self, number: int, setpoint: Setpoint) -> Feedback:
        """Has a reel follow a setpoint; see `SetpointFollower`."""
        with self.lock:
            if self._latched[number]:
                raise RigError(
                    f"the reel is held in its safe state ({self._latched[number]}); remove the "
                    "cause, then clear the stop"
                )
            simulation, wanted = self.simulation, self.simulation.setpoints
            wanted.tension_N[number] = setpoint.tension_N
            wanted.in_tension[number] = setpoint.angle_rad is None
            if setpoint.angle_rad is not None:
                wanted.wound_m[number] = self._radius_m[number] * setpoint.angle_rad
            self._expires_s[number] = self._time_s + SETPOINT_S
            return Feedback(
                time_s=self._time_s,
                tension_N=float(simulation.tension_N[number]),
                angle_rad=float(simulation.angle_rad[number]),
                current_A=float(simulation.effort_N[number] * self._amperes[number]),
                reference_N=float(simulation.outside_N[number]),
            )

    def stop(self, number: int, reason: str) -> None:
        """Holds a reel where it is, until cleared."""
        with self.lock:
            self._stop(number, reason)

    def clear(self, number: int) -> None:
        """Lets a stopped reel follow setpoints again."""
        with self.lock:
            self._latched[number], self._guards[number] = "", None
            self.simulation.setpoints.tension_N[number] = self._hold_N[number]
            self.simulation.setpoints.in_tension[number] = True

    def _guarded_run(self) -> None:
        """Runs to the end; a simulation that fails holds every reel in its safe state."""
        try:
            self._run()
        except Exception as error:  # noqa: BLE001  whatever fails must be noticed by the reels
            _log.exception("the simulation has failed")
            with self.lock:
                self._latched = [f"the simulation has failed: {error}"] * len(self._latched)

    def _run(self) -> None:
        period_s, began_s = 1.0 / self.simulation.mechanism.sampling_Hz, time.monotonic()
        while not self._ended.wait(_WAKE_S):
            behind_s = time.monotonic() - began_s - self.lost_s - self._time_s
            self.lost_s += max(0.0, behind_s - _BEHIND_S)
            for _ in range(math.floor(min(behind_s, _BEHIND_S) / period_s)):
                with self.lock:
                    self._sample(period_s)

    def _sample(self, period_s: float) -> None:
        simulation, wanted = self.simulation, self.simulation.setpoints
        self._time_s += period_s
        for n in np.flatnonzero(self._time_s > self._expires_s):
            if not self._latched[n]:
                wanted.in_tension[n] = True
                step = RETURN_N_S * period_s
                wanted.tension_N[n] += np.clip(self._hold_N[n] - wanted.tension_N[n], -step, step)
        simulation.sample()
        self._check_guard()

    def _check_guard(self) -> None:
        simulation = self.simulation
        currents = simulation.effort_N * self._amperes
        for n, (tension, current, angle) in enumerate(
            zip(
                *(a.tolist() for a in (simulation.tension_N, currents, simulation.angle_rad)),
                strict=True,
            )
        ):
            sample = guard.Sample(self._time_s, tension, tension, current, angle)
            before = self._guards[n] or guard.begin(sample)
            self._guards[n], trip = guard.check_sample(GUARD, before, sample)
            if trip is not None:
                self._stop(n, trip.sentence)

    def _stop(self, number: int, reason: str) -> None:
        if not self._latched[number]:
            self._latched[number] = reason
            self.simulation.setpoints.in_tension[number] = False
            angle = self.simulation.angle_rad[number]
            self.simulation.setpoints.wound_m[number] = self._radius_m[number] * angle


class PlatformReel:
    """One reel of a platform as a rig; implements `estune.trial.Rig` and `SetpointFollower`.

    Its trials are those of the reel by itself, with the platform clamped.
    """

    def __init__(self, platform: RealTimePlatform, number: int, name: str, pace: float) -> None:
        """See `RealTimePlatform.reel`."""
        self._platform, self._number = platform, number
        gains = platform.simulation.gains[number]
        reel = platform.simulation.mechanism.reels[number]
        self._clamped = SimulatedRig(reel, name=name, seed=number, gains=gains, pace=pace)

    def describe(self) -> RigDescription:
        """Description, with the live gains."""
        return self._clamped.describe()

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial with the platform clamped."""
        return self._clamped.run(request)

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones, of trials and on the platform."""
        self._clamped.apply(gains)
        with self._platform.lock:
            self._platform.simulation.use(self._number, gains)

    def follow(self, setpoint: Setpoint) -> Feedback:
        """Follows a setpoint."""
        return self._platform.follow(self._number, setpoint)

    def abort(self) -> RigDescription:
        """Stops a running trial."""
        return self._clamped.abort()

    def estop(self, reason: str) -> None:
        """Holds the reel where it is."""
        self._platform.stop(self._number, f"emergency stop: {reason}")
        self._clamped.estop(reason)

    def clear(self) -> None:
        """Resets the emergency stop."""
        self._clamped.clear()
        self._platform.clear(self._number)

    def telemetry(self, after: int) -> Telemetry | None:
        """New samples of a running trial."""
        return self._clamped.telemetry(after)

    def close(self) -> None:
        """Stops a running trial and rejects further ones."""
        self._clamped.close()
