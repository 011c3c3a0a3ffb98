"""A plant as a rig in this process."""

import threading
import time
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from estune.core.gains import Gains
from estune.core.quantities import check_not_negative
from estune.errors import RigError
from estune.hardware.compensation.plan import CompensationTerms
from estune.hardware.compensation.tables import table_of
from estune.trial import Outcome, RigDescription, Telemetry, TrialRecord, TrialRequest
from estune.trial.executed_trials import ExecutedTrials, stopped_trial
from estune.trial.records import record_of
from plants.simulation.batch import Response, divergence_limit_N, simulate_drive
from plants.simulation.compensation import TrialCompensation, trial_compensation
from plants.simulation.noise import NoiseSource
from plants.simulation.plant import Plant, drive_of

_COLUMNS = ("time_s", "setpoint_N", "tension_N", "angle_rad", "flags", "reference_N")


class SimulatedRig:
    """Runs the trials of one plant; a `Rig` with its errors.

    Thread-safe: one trial runs at a time, and any thread may call `abort`.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        name: str = "simulated-reel",
        seed: int = 0,
        gains: Gains | None = None,
        pace: float = 0.0,
    ) -> None:
        """See `plants.models.plant_model.PlantModel.rig`.

        Raises:
            InvalidInput: the seed or the pace is out of its range.
            UnsafeStart: no gains were given and no safe ones are known.
        """
        check_not_negative("pace", pace, "s/s")
        self._plant = plant
        about, settings = plant.describe(name, gains), plant.controller
        # A simulated load may be as large as the controller's range.
        limits = replace(about.limits, load_max_N=settings.output_max_N - settings.output_min_N)
        self._description = replace(about, limits=limits, simulated=True)
        self._noise = NoiseSource(seed)
        self._pace = pace
        # A repeated trial gives the same record: its noise depends on seed and number alone.
        self._records = ExecutedTrials(same_anew=True)
        self._trial = threading.Lock()  # held while a trial runs
        self._running = False
        self._stop = threading.Event()
        self._state = threading.Lock()  # guards the description and all below
        self._latched = ""
        self._shown: tuple[str, Response, float] | None = None
        self._closed = False

    def __repr__(self) -> str:
        return f"SimulatedRig({self._description.name!r}, {self._plant!r})"

    def describe(self) -> RigDescription:
        """Description of the rig, with its live gains."""
        with self._state:
            self._check_open()
            return self._description

    def run(self, request: TrialRequest) -> TrialRecord:
        """Runs one trial, or returns its record if the trial id has run before.

        Raises:
            PlantError: the plant cannot be simulated.
        """
        with self._trial:
            with self._state:
                self._check_free()
                description = self._description
                self._stop.clear()
                self._running = True
            try:
                known = self._records.find_record(request)
                if known is not None:
                    return known
                description.limits.check(request.profile)
                description.check_gains(request.gains, trial=True)
                record = self._perform(request)
                self._records.add(request, record)
                return record
            finally:
                with self._state:
                    self._running, self._shown = False, None

    def apply(self, gains: Gains) -> None:
        """Makes gains the live ones."""
        with self._state:
            self._check_free()
            self._description.check_gains(gains)
            self._description = replace(self._description, gains=gains)

    def abort(self) -> RigDescription:
        """Stops a running trial, and returns once the live gains are restored."""
        with stopped_trial(self._trial, self._stop_running):
            return self.describe()

    def estop(self, reason: str) -> None:
        """Emergency stop: ends a running trial, and rejects others until cleared."""
        with self._state:
            self._latched = self._latched or reason
            self._stop.set()

    def clear(self) -> None:
        """Resets the emergency stop."""
        with self._state:
            self._latched = ""

    def telemetry(self, after: int) -> Telemetry | None:
        """New samples of a paced trial; None while none is running."""
        with self._state:
            shown = self._shown
        if shown is None:
            return None
        trial_id, response, began = shown
        rate = self._plant.controller.sampling_Hz
        passed = slice(after, max(after, int((time.monotonic() - began) / self._pace * rate)))
        return Telemetry(
            trial_id=trial_id,
            first_sample=after,
            sampling_Hz=rate,
            setpoint_N=response.setpoint_N[passed],
            tension_N=response.tension_N[passed],
            current_A=response.effort_N[passed] / self._plant.newtons_per_ampere,
            angle_rad=response.angle_rad[passed],
        )

    def close(self) -> None:
        """Stops a running trial and rejects further calls; idempotent."""
        with self._state:
            self._closed = True
            self._stop.set()

    def _perform(self, request: TrialRequest) -> TrialRecord:
        """Simulates the trial, then waits for its duration at the rig's pace."""
        started_at, began = datetime.now(UTC).isoformat(), time.monotonic()
        rate = self._plant.controller.sampling_Hz
        size = drive_of(request.profile, rate).time_s.size
        rms = self._plant.noise_rms_N
        noise = self._noise.draw(request.number, size, rms) if rms else None
        compensation = self._compensation(request)
        drive = drive_of(request.profile, rate)._replace(compensation=compensation)
        bound = divergence_limit_N(request.profile)
        response = simulate_drive(self._plant, request.gains, drive, noise, bound)
        samples, outcome, reason = len(response.time_s), Outcome.DONE, ""
        if response.diverged_at is not None:
            outcome = Outcome.DIVERGED
            reason = f"{outcome.sentence} at sample {samples}, {samples / rate:.3f} s"
        if self._pace > 0.0:
            with self._state:
                self._shown = request.trial_id, response, began
            wait = began + self._pace * samples / rate - time.monotonic()
            if self._stop.wait(max(0.0, wait)):
                samples = min(samples, int((time.monotonic() - began) / self._pace * rate))
                outcome, reason = Outcome.CANCELLED, Outcome.CANCELLED.sentence
        columns = {name: getattr(response, name) for name in _COLUMNS}
        columns["current_A"] = response.effort_N / self._plant.newtons_per_ampere
        if compensation is not None:
            columns |= self._terms(response, compensation.plan.columns)
        return record_of(
            *(request, self._description, outcome, reason, started_at),
            **{name: _read_only(column, samples) for name, column in columns.items()},
        )

    def _compensation(self, request: TrialRequest) -> TrialCompensation | None:
        """Compensations of a trial; None without.

        Raises:
            InvalidInput: the table has mistakes, or a simulated rig has not what it switches on.
        """
        if not request.compensation:
            return None
        table = table_of(request.compensation, f"compensation of trial {request.trial_id}")
        if table is None:
            return None
        scale: Any = getattr(self._plant, "scale", None)
        name = f"rig {self._description.name}"
        return trial_compensation(table, scale, self._plant.controller, name)

    def _terms(self, response: Response, names: tuple[str, ...]) -> dict[str, Any]:
        """Columns of the compensations, and the tension that was controlled."""
        assert response.terms is not None  # noqa: S101  the drive has compensations
        terms = CompensationTerms(*response.terms.T)
        amperes = 1.0 / self._plant.newtons_per_ampere
        columns = terms.columns(amperes)
        found = {name: np.ascontiguousarray(columns[name]) for name in names}
        return found | {"tension_N": response.tension_N - terms.off_gauge_N}

    def _stop_running(self) -> None:
        with self._state:
            self._check_open()
            if self._running:
                self._stop.set()

    def _check_free(self) -> None:
        """Raises RigError if the rig cannot run; call with the state locked."""
        self._check_open()
        if self._latched:
            raise RigError(
                f"rig {self._description.name} is held in its safe state after an emergency stop "
                f"({self._latched}); remove the cause, then clear the stop"
            )

    def _check_open(self) -> None:
        if self._closed:
            raise RigError(f"rig {self._description.name} is closed; make a new one")


def _read_only(column: Any, samples: int) -> Any:
    """The first samples; read-only, because a record may be returned again."""
    if column is not None:
        column = column[:samples]
        column.flags.writeable = False
    return column
