"""Trials of an improvement: run on the rig once, kept on disk, read back after an interruption."""

import json
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from estune import api
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.quantities import FloatArray
from estune.errors import Interrupted, InvalidInput, RigError
from estune.run.failed_trials import cut_off, needs_operator, run_trial
from estune.run.journal import RUNS
from estune.run.loop import CONSECUTIVE_VOID_MAX
from estune.run.planning import description_from_json, description_to_json
from estune.run.results.export import write_record
from estune.run.submitted_trial import SubmittedTrial
from estune.run.trial_file import TrialFile
from estune.support.file_limits import parse_json
from estune.support.whole_file import replace_file
from estune.trial import Outcome, Rig, RigDescription, TrialRecord, TrialRequest, record_frame
from estune.trial.profiles import AnyProfile
from estune.trial.scoring import cost_of
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.experiments.designs import Experiment, candidate_experiments

PLAN, RESULT = "improvement-plan.json", "improvement.json"
"""Files of an improvement that was begun, and of one that is finished."""

SUBMITTED = "submitted.json"
"""File of the trial last submitted to a rig that moves."""

Say = Callable[[str], None]


class ExperimentRunner:
    """Runs trials on the rig and keeps their records.

    A trial that is on disk already is not run again: the same calls in the same order continue an
    improvement that was interrupted.

    Attributes:
        about: Its description when the improvement began.
        stamp: Time of the beginning, a part of each trial's id: a rig's ledger holds the ids of
            other days.
    """

    def __init__(
        self, rig: Rig, about: RigDescription, folder: Path, stamp: str, say: Say
    ) -> None:
        self.rig, self.about, self.folder, self.stamp = rig, about, folder, stamp
        self.say = say
        self.records: list[MeasuredRecord] = []
        self.remarks: list[str] = []
        self.done: set[AnyProfile] = set()
        self._number = 0

    def run(self, experiments: Sequence[Experiment]) -> tuple[str, ...]:
        """Runs experiments one after the other; each record is on disk before the next begins."""
        names = []
        for experiment in experiments:
            self.done.add(experiment.profile)
            try:
                self.about.check_motion(experiment.profile)
            except InvalidInput as error:
                self.remarks.append(f"{experiment.name} was not run: {error}")
                continue
            names.append(experiment.name)
            self.say(f"running {experiment.title} ({experiment.profile.duration_s:.3g} s)")
            name, profile = f"{self._number:02d}-{experiment.name}", experiment.profile
            file = TrialFile(name, profile, why=experiment.title)
            file.write(self.folder / "trials")
            record = self.trial(experiment.name, self.about.gains, experiment.profile)
            write_record(record, self.folder / "data")
            if record.outcome is Outcome.DONE:
                self.records.append(MeasuredRecord.of(record))
            else:
                why = record.reason or record.outcome.sentence
                self.remarks.append(f"{experiment.name} was left out: {why}")
        return tuple(names)

    def new_experiments(self, count: int) -> list[Experiment]:
        """Candidate experiments that have not been run yet, spread over the list."""
        remaining = [e for e in candidate_experiments(self.about) if e.profile not in self.done]
        return remaining[:: max(1, len(remaining) // count)][:count] if remaining else []

    @property
    def submitted(self) -> SubmittedTrial | None:
        """The trial last submitted to a rig that moves and keeps a ledger; None without one."""
        file = self.folder / SUBMITTED
        return SubmittedTrial(*parse_json(file.read_bytes())) if file.exists() else None

    @submitted.setter
    def submitted(self, trial: SubmittedTrial | None) -> None:
        replace_file(self.folder / SUBMITTED, json.dumps(trial).encode())

    def trials(self, name: str, gains: Gains, repeats: int) -> list[TrialRecord]:
        """Trials of some gains on the rig's own step."""
        return [self.trial(name, gains, self.about.step) for _ in range(repeats)]

    def costs(self, records: Sequence[TrialRecord], cost: StepCost) -> FloatArray:
        """Costs of trials of the rig's own step; nan where a trial failed."""
        step, per_ampere = self.about.step, self.about.newtons_per_ampere
        return np.array([cost_of(record, step, cost, per_ampere) for record in records])

    def trial(self, name: str, gains: Gains, profile: AnyProfile) -> TrialRecord:
        """The record of a trial; one that carries no information is repeated.

        Raises:
            Interrupted: the trial was interrupted on a rig that moves, other than by a late
                sample; to continue is to confirm that an operator has checked the rig.
            RigError: the rig cannot be reached, or refuses; or too many trials were void.
        """
        number, attempt, fresh = self._number, 0, 0
        self._number += 1
        while True:
            request = TrialRequest(f"{name}-{self.stamp}", number, gains, profile, attempt)
            file = self.folder / "records" / f"{request.trial_id}.record"
            known = file.exists()
            if known:
                record = record_frame.decode(file.read_bytes())
            else:
                record = run_trial(self.rig, request, self.about, notes=self)
                file.parent.mkdir(exist_ok=True)
                replace_file(file, record_frame.encode(record))
            if not record.outcome.is_void:
                return record
            attempt, fresh = attempt + 1, fresh + (not known)
            self._check_void(record, fresh)

    def _check_void(self, record: TrialRecord, fresh: int) -> None:
        """Ends an improvement that must not repeat its void trial by itself."""
        if fresh and needs_operator(record, self.about):
            raise Interrupted(cut_off(record))
        if fresh >= CONSECUTIVE_VOID_MAX:
            raise RigError(
                f"trial {record.trial_id} on rig {record.rig}: {fresh} consecutive void trials "
                f"({record.reason}); fix the cause"
            )


def default_folder() -> Path:
    """A folder of runs named by the time of day."""
    return Path(RUNS) / f"improve-{datetime.now().astimezone():%Y%m%d-%H%M%S}"


def begin(rig: Rig, folder: Path, model: str, say: Say) -> ExperimentRunner:
    """Begins an improvement in a new folder, or continues the one that a folder holds.

    Args:
        folder: The folder; made if it is missing.
        model: The model to begin from, as text; one that is continued must be of the same.
        say: Callback for progress in words.

    Raises:
        InvalidInput: the rig has no limits, or the folder holds something else.
        RigError: the rig is not the one of the improvement that is continued.
    """
    about, file = rig.describe(), folder / PLAN
    about.check_limited()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if file.exists():
            plan = _continued(file, model)
            then = description_from_json(plan["rig"])
            api.check_same_rig(then, about)
            say(f"continuing the improvement of {folder}")
            return ExperimentRunner(rig, then, folder, plan["stamp"], say)
        if any(folder.iterdir()):
            raise InvalidInput(f"{folder} holds something already; give a new folder")
        stamp = f"{datetime.now().astimezone():%Y%m%d-%H%M%S-%f}"
        plan = {"stamp": stamp, "model": model, "rig": description_to_json(about)}
        replace_file(file, json.dumps(plan, indent=2).encode())
    except OSError as error:
        raise InvalidInput(f"{folder}: {error.strerror or error}; give another folder") from error
    return ExperimentRunner(rig, about, folder, stamp, say)


def _continued(file: Path, model: str) -> dict[str, Any]:
    if (file.parent / RESULT).exists():
        raise InvalidInput(f"{file.parent} holds a finished improvement; give a new folder")
    try:
        plan: dict[str, Any] = parse_json(file.read_bytes())
        same = plan["model"] == model
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidInput(f"{file} cannot be read: {error}; give a new folder") from error
    if not same:
        raise InvalidInput(
            f"{file.parent} holds an improvement of another model, or with other effects; give "
            "the same ones, or a new folder"
        )
    return plan
