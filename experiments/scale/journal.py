"""A run's journal at some length: its size, and the time of the commands that read it.

The run is real: a tuner on recorded trials of the reference reel, 632 samples each, with other
noise in every trial.
"""

import contextlib
import functools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import estune
import plants
from estune.core.gains import Gains
from estune.run.journal import FILE_NAME, Journal
from estune.run.loop import Stopped
from estune.trial import RigDescription, TrialRecord, TrialRequest
from experiments.scale.command_costs import command_costs

TUNER = "killingsworth"
_RECORDED = 64
"""Recorded trials, each with noise of its own."""


class RecordedRig:
    """A rig that answers with recorded trials in turn, whatever the gains.

    Attributes:
        stops_at: Number of the trial that is interrupted instead; None for none.
    """

    stops_at: int | None = None

    def __init__(self) -> None:
        self._rig = plants.reference_reel().rig()
        description = self._rig.describe()
        requests = (
            TrialRequest("recorded", n, description.gains, description.step)
            for n in range(_RECORDED)
        )
        self._records = tuple(map(self._rig.run, requests))

    def describe(self) -> RigDescription:
        """The reel's description."""
        return self._rig.describe()

    def run(self, request: TrialRequest) -> TrialRecord:
        """A recorded trial under the id and with the gains of the request."""
        if request.number == self.stops_at:
            raise KeyboardInterrupt
        recorded = self._records[request.number % _RECORDED]
        return replace(recorded, trial_id=request.trial_id, gains=request.gains)

    def apply(self, gains: Gains) -> None:
        """Makes gains live."""
        self._rig.apply(gains)

    def abort(self) -> RigDescription:
        """Nothing runs."""
        return self.describe()

    def close(self) -> None:
        """Nothing is open."""


@functools.cache
def recorded_rig() -> RecordedRig:
    """The rig, as a target of the command line."""
    return RecordedRig()


class JournalCosts(NamedTuple):
    """Costs of a run's journal at one length."""

    trials: int
    bytes_per_trial: float
    show_s: float
    resume_s: float
    parquet_s: float
    parquet_MB: float


def measure_journal(trials: int, folder: Path) -> JournalCosts:
    """Makes a run of so many trials, and times the commands that read it.

    The run is interrupted before its last trial of the search, so that `resume` reads what there
    is, and runs and confirms the rest.
    """
    run = folder / f"scale-{trials}"
    rig = recorded_rig()
    rig.stops_at = trials
    options: dict[str, Any] = {"tuner": TUNER, "tolerance": 0.0, "trials": trials}
    with contextlib.suppress(Stopped):
        estune.tune(rig, folder=folder, run=run.name, watch=None, **options)
    with Journal.open(run, write=True) as journal:
        journal.note(target="experiments.scale.journal:recorded_rig")
    resume_s = command_costs("resume", run, "--quiet").cpu_s
    exported = run / "parquet"
    costs = JournalCosts(
        trials=trials,
        bytes_per_trial=(run / FILE_NAME).stat().st_size / len(estune.load(run).entries),
        show_s=command_costs("show", run).cpu_s,
        resume_s=resume_s,
        parquet_s=command_costs("export", run, "--quiet", "--out", exported).cpu_s,
        parquet_MB=sum(file.stat().st_size for file in exported.iterdir()) / 1e6,
    )
    shutil.rmtree(run)
    return costs
