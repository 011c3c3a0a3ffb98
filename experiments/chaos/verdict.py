"""What became of the promises, counted from logs, ledger and journals."""

import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.errors import ProtocolError
from estune.remote.state_machine.trials import TrialState
from estune.run import loop
from estune.run.journal import Journal
from estune.trial import Outcome, TrialRecord, record_frame
from experiments.chaos.campaign import Absence, Diary
from experiments.chaos.client import Errand
from experiments.chaos.faults import LEASE_S
from experiments.chaos.motions import Motion
from experiments.chaos.plain import plan_of, read
from experiments.chaos.rig import as_served, truth
from experiments.chaos.stand import Stand

WITHIN_S = LEASE_S + 0.1
_COLUMNS = ("time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags")


class Result(NamedTuple):
    """One trial as a client has it: its gains, its cost and its record."""

    gains: tuple[float, ...]
    cost: float
    record: TrialRecord


@dataclass(frozen=True)
class Verdict:
    """How often each promise was broken, and of how many.

    Attributes:
        trials: Trials that were told to a tuner.
        motions: Trials begun on a rig.
        run_twice: Trials begun more than once.
        most_often: How often the worst of them was begun.
        overlapping: Trials begun on a rig before the one under way had ended.
        unattended: Trials begun with no client alive for longer than a lease and 100 ms.
        wrong_rig: Trials begun on a rig that only bears the name.
        wrong_records: Records that are not what the rig measures with those gains.
        lost_records: Trials whose record the ledger holds and the client was told otherwise.
        gains_left: Times the rig at rest ran gains that were not its own.
        interrupted: Trials that were cut short, and told to be.
        other_proposals: Trials whose gains are not those of the same tuning undisturbed.
        unfinished: Tunings that did not come to the same end.
    """

    trials: int
    motions: int
    run_twice: int
    most_often: int
    overlapping: int
    unattended: int
    wrong_rig: int
    wrong_records: int
    lost_records: int
    gains_left: int
    interrupted: int
    other_proposals: int
    unfinished: int


def judge(stand: Stand, diary: Diary) -> Verdict:
    """Counts, once no process of the stand runs any more."""
    motions = stand.log.motions()
    begun = Counter(motion.trial_id for motion in motions if motion.what == "begin")
    wrong = lost = other = unfinished = told = 0
    for errand in diary.errands:
        expected = undisturbed(errand)
        found = dict(results(errand))
        told += len(found)
        both = found.keys() & expected.keys()
        wrong += sum(not _same(found[n].record, expected[n].record) for n in both)
        other += sum(found[n].gains != expected[n].gains for n in both)
        other += len(found.keys() - both)
        unfinished += [(r.gains, r.cost) for r in found.values()] != [
            (r.gains, r.cost) for r in expected.values()
        ]
        lost += 0 if errand.plain else _lost(errand, stand.ledger)
    own = next(motion.live for motion in motions)
    return Verdict(
        trials=told,
        motions=sum(begun.values()),
        run_twice=sum(times > 1 for times in begun.values()),
        most_often=max(begun.values(), default=0),
        overlapping=_overlapping(motions),
        unattended=_unattended(motions, diary.absences),
        wrong_rig=sum(m.what == "begin" and m.rig in stand.namesakes for m in motions),
        wrong_records=wrong,
        lost_records=lost,
        gains_left=sum(m.live != own for m in motions) + _never_restored(motions),
        interrupted=sum(_interrupted(errand) for errand in diary.errands if not errand.plain),
        other_proposals=other,
        unfinished=unfinished,
    )


def undisturbed(errand: Errand) -> dict[int, Result]:
    """The same tuning in one process, on a rig that nothing happens to."""
    rig = truth(errand.rig)
    found: dict[int, Result] = {}

    def watch(progress: loop.Progress) -> None:
        entry = progress.entry
        found[entry.number] = Result(entry.gains.as_tuple(), entry.cost, progress.record)

    description = as_served(rig).describe()
    loop.run(loop.start(plan_of(errand, description), description, None), rig, [watch])
    return found


def results(errand: Errand) -> Iterator[tuple[int, Result]]:
    """What the clients of an errand were told, void trials left out."""
    if errand.plain:
        for told in read(errand.journal / "trials.jsonl"):
            record = _stored(errand.journal / f"{errand.run}-{told.number:05d}.frame")
            if record is not None:
                yield told.number, Result(tuple(told.gains), told.cost, record)
        return
    with Journal.open(errand.journal) as journal:
        for entry in journal.entries():
            if entry.outcome is not None and not entry.outcome.is_void:
                record = journal.record(entry.trial_id)
                yield entry.number, Result(entry.gains.as_tuple(), entry.cost, record)


def _stored(path: Path) -> TrialRecord | None:
    try:
        return record_frame.decode(path.read_bytes())
    except (OSError, ProtocolError):
        return None


def _interrupted(errand: Errand) -> int:
    with Journal.open(errand.journal) as journal:
        return sum(
            entry.outcome is not None and entry.outcome.is_void for entry in journal.entries()
        )


def _lost(errand: Errand, ledger: Path) -> int:
    """Trials of which the ledger and the journal do not say the same."""
    with Journal.open(errand.journal) as journal:
        told = {entry.trial_id: entry.outcome for entry in journal.entries()}
    lost = 0
    for trial_id, state, data in _ledger(ledger, errand.run):
        outcome = told.pop(trial_id, None)
        if state is TrialState.ENDED:  # the oldest records are let go of in time
            lost += (
                outcome is None
                if data is None
                else record_frame.decode(data).outcome is not outcome
            )
        elif state is TrialState.INTERRUPTED:
            lost += outcome is not Outcome.INTERRUPTED
        else:
            lost += outcome is not Outcome.CANCELLED
    return lost + len(told)  # what is left was told, and the ledger knows nothing of it


def _ledger(path: Path, run: str) -> Iterator[tuple[str, TrialState, bytes | None]]:
    connection = sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)
    rows = connection.execute(
        "SELECT trial_id, state, data FROM trial LEFT JOIN frame USING (sequence)"
        " WHERE trial_id LIKE ?",
        (f"{run}-%",),
    ).fetchall()
    connection.close()
    for trial_id, state, data in rows:
        yield trial_id, TrialState(state), data


def _same(one: TrialRecord, other: TrialRecord) -> bool:
    """Whether two records hold the same measurement of the same gains."""
    return one.gains == other.gains and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in _COLUMNS
    )


def _overlapping(motions: tuple[Motion, ...]) -> int:
    under_way: dict[int, int] = {}
    found = 0
    for motion in motions:
        if motion.what == "begin":
            found += under_way.get(motion.rig, 0) > 0
            under_way[motion.rig] = under_way.get(motion.rig, 0) + 1
        elif motion.what == "end":
            under_way[motion.rig] -= 1
    return found


def _unattended(motions: tuple[Motion, ...], absences: list[Absence]) -> int:
    return sum(
        motion.what == "begin"
        and not motion.trial_id.startswith("rival")
        and any(a.since_s + WITHIN_S < motion.at_s < a.until_s for a in absences)
        for motion in motions
    )


def _never_restored(motions: tuple[Motion, ...]) -> int:
    """Trials after which the process that ran them went on, and never put the gains back."""
    last: Mapping[int, Motion] = {motion.rig: motion for motion in motions}
    open_now: dict[int, int] = {}
    for motion in motions:
        if motion.what in ("begin", "end"):
            open_now[motion.rig] = open_now.get(motion.rig, 0) + (
                1 if motion.what == "begin" else -1
            )
    # A process that was killed in a trial has that one open, and it is its last word.
    return sum(count - (last[rig].what == "begin") for rig, count in open_now.items())


def figures(verdict: Verdict) -> dict[str, int]:
    """By name."""
    return {field.name: getattr(verdict, field.name) for field in fields(verdict)}
