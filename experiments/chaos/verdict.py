"""Violations of a campaign, counted from logs, ledger and journals."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.remote.ledger import LEDGER
from estune.remote.state_machine.trials import TrialState
from estune.run import loop
from estune.run.journal import Journal
from estune.support.sqlite import SqliteFile
from estune.trial import Outcome, TrialRecord, record_frame
from experiments.chaos.campaign import Absence, Diary
from experiments.chaos.client import Errand
from experiments.chaos.faults import LEASE_S
from experiments.chaos.motions import LoggedMotion
from experiments.chaos.rig import reference_rig
from experiments.chaos.stand import Stand

WITHIN_S = LEASE_S + 0.1
_COLUMNS = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags")

WORDS = {
    "trials": "trials reported to the tuner",
    "motions": "trials started on a rig",
    "run_twice": "trials started more than once",
    "most_often": "  most starts of one trial",
    "overlapping": "trials started before the end of the one before",
    "unattended": "trials started without a client (lease + 100 ms)",
    "wrong_rig": "trials started on another rig of the same name",
    "wrong_records": "records that differ from the undisturbed measurement",
    "lost_records": "trials on which ledger and client disagree",
    "gains_left": "times foreign gains stayed live on the rig",
    "interrupted": "trials interrupted, and reported as such",
    "other_proposals": "proposals that differ from the undisturbed run",
    "unfinished": "tunings with another result",
}
"""The counts, by name, in words."""


class Result(NamedTuple):
    """One trial as its client has it."""

    gains: tuple[float, ...]
    cost: float
    record: TrialRecord


def count_violations(stand: Stand, diary: Diary) -> dict[str, int]:
    """The counts of `WORDS`, once no process of the stand runs any more."""
    motions = stand.log.motions()
    begun = Counter(motion.trial_id for motion in motions if motion.what == "begin")
    counts = Counter[str]()
    for errand in diary.errands:
        expected = undisturbed(errand)
        actual = dict(results(errand))
        both = actual.keys() & expected.keys()
        counts["trials"] += len(actual)
        counts["wrong_records"] += sum(
            not _same(actual[n].record, expected[n].record) for n in both
        )
        counts["other_proposals"] += sum(actual[n].gains != expected[n].gains for n in both)
        counts["other_proposals"] += len(actual.keys() - both)
        counts["unfinished"] += [r[:2] for r in actual.values()] != [
            r[:2] for r in expected.values()
        ]
        counts["lost_records"] += _count_lost(errand, stand.ledger)
        counts["interrupted"] += _count_void(errand)
    own = next(motion.live for motion in motions)
    foreign = sum(motion.live != own for motion in motions)
    counts |= {
        "motions": sum(begun.values()),
        "run_twice": sum(times > 1 for times in begun.values()),
        "most_often": max(begun.values(), default=0),
        "overlapping": _count_overlapping(motions),
        "unattended": _count_unattended(motions, diary.absences),
        "wrong_rig": sum(m.what == "begin" and m.rig in stand.namesakes for m in motions),
        "gains_left": foreign + _count_never_restored(motions),
    }
    return {name: counts[name] for name in WORDS}


def undisturbed(errand: Errand) -> dict[int, Result]:
    """The same tuning in one process, without faults."""
    results: dict[int, Result] = {}

    def watch(progress: loop.Progress) -> None:
        entry = progress.entry
        results[entry.number] = Result(entry.gains.as_tuple(), entry.cost, progress.record)

    description, plan = errand.plan()
    loop.run(loop.start(plan, description, None), reference_rig(errand.rig), [watch])
    return results


def results(errand: Errand) -> Iterator[tuple[int, Result]]:
    """The results of an errand's clients, void trials excepted."""
    with Journal.open(errand.journal) as journal:
        for entry in journal.entries():
            if entry.outcome is not None and not entry.outcome.is_void:
                record = journal.record(entry.trial_id)
                yield entry.number, Result(entry.gains.as_tuple(), entry.cost, record)


def _count_void(errand: Errand) -> int:
    with Journal.open(errand.journal) as journal:
        outcomes = [entry.outcome for entry in journal.entries()]
    return sum(outcome is not None and outcome.is_void for outcome in outcomes)


def _count_lost(errand: Errand, ledger: Path) -> int:
    """Number of trials on which the ledger and the journal disagree."""
    with Journal.open(errand.journal) as journal:
        outcomes = {entry.trial_id: entry.outcome for entry in journal.entries()}
    with SqliteFile.open_reader(ledger, LEDGER) as file:
        rows = file.rows(
            "SELECT trial_id, state, data FROM trial LEFT JOIN frame USING (sequence)"
            " WHERE trial_id LIKE ?",
            f"{errand.run}-%",
        )
    lost = 0
    for trial_id, state, data in rows:
        outcome = outcomes.pop(trial_id, None)
        if state == TrialState.ENDED and data is None:  # the oldest frames are deleted in time
            lost += outcome is None
        elif state == TrialState.ENDED:
            lost += record_frame.decode(data).outcome is not outcome
        elif state == TrialState.INTERRUPTED:
            lost += outcome is not Outcome.INTERRUPTED
        else:
            lost += outcome is not Outcome.CANCELLED
    return lost + len(outcomes)  # the rest has no entry in the ledger


def _same(one: TrialRecord, other: TrialRecord) -> bool:
    """Whether two records hold the same measurement of the same gains."""
    return one.gains == other.gains and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in _COLUMNS
    )


def _count_overlapping(motions: tuple[LoggedMotion, ...]) -> int:
    active = Counter[int]()
    overlapping = 0
    for motion in motions:
        if motion.what == "begin":
            overlapping += active[motion.rig] > 0
            active[motion.rig] += 1
        elif motion.what == "end":
            active[motion.rig] -= 1
    return overlapping


def _count_unattended(motions: tuple[LoggedMotion, ...], absences: list[Absence]) -> int:
    return sum(
        motion.what == "begin"
        and not motion.trial_id.startswith("rival")
        and any(a.since_s + WITHIN_S < motion.at_s < a.until_s for a in absences)
        for motion in motions
    )


def _count_never_restored(motions: tuple[LoggedMotion, ...]) -> int:
    """Trials after which the process that ran them continued without restoring the gains."""
    last = {motion.rig: motion for motion in motions}
    unfinished = Counter[int]()
    for motion in motions:
        if motion.what in ("begin", "end"):
            unfinished[motion.rig] += 1 if motion.what == "begin" else -1
    # The last line of a process that was killed in a trial is the start of that trial.
    return sum(count - (last[rig].what == "begin") for rig, count in unfinished.items())
