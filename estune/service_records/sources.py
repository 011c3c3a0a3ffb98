"""Logs below paths: files of any known format, or the trials of a run."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.errors import InvalidInput, JournalError
from estune.recordings.issue import DataIssue, Unusable
from estune.recordings.loop_log import DRIFT, LoopLog, read_loop_log
from estune.recordings.raw_file import formats, is_readable
from estune.recordings.timing import Columns
from estune.run.journal import FILE_NAME, Journal
from estune.run.planning import description_from_json
from estune.trial import SATURATED, Outcome, TrialRecord


class Logs(NamedTuple):
    """The logs below paths.

    Attributes:
        logs: Each with its stretches, of one sampling rate.
        issues: Files that cannot be used, and what was done to time stamps.
        controller: The fixed part of the controller, of a run; None of files.
    """

    logs: tuple[LoopLog, ...]
    issues: tuple[DataIssue, ...]
    controller: ControllerSettings | None = None


def read_logs(
    paths: Path | str | Iterable[Path | str],
    sources: Mapping[str, str] | None = None,
    sampling_Hz: float | None = None,
    *,
    reverse: bool = False,
) -> Logs:
    """Reads the logs of a control loop: files, folders of them, or a run.

    Args:
        paths: A file, a folder, or the folder of a run; or several files and folders.
        sources: Channels of the columns that are not found by their names.
        sampling_Hz: Rate, where files have no times.
        reverse: Whether more effort lowers the measurement: both signals are then negated.

    Raises:
        InvalidInput: there is no log, or none that can be used; the message says why.
    """
    given = [Path(path) for path in ([paths] if isinstance(paths, Path | str) else paths)]
    if len(given) == 1 and (given[0] / FILE_NAME).is_file():
        return _read_run(given[0])
    logs, issues = list[LoopLog](), list[DataIssue]()
    for file in _files(given):
        try:
            log = read_loop_log(file, sources, sampling_Hz)
        except Unusable as error:
            issues.append(replace(error.issue, source=file.name))
            continue
        copied = next((other.name for other in logs if _is_copy(log, other)), "")
        if copied:
            same = f"it has the samples of {copied}, and is left out"
            issues.append(DataIssue("warning", same, source=file.name))
            continue
        issues += [replace(issue, source=file.name) for issue in log.issues]
        logs.append(log)
    if not logs:
        why = "; ".join(str(issue) for issue in issues)
        what = why or f"it holds no {', '.join(formats())} or run"
        where = ", ".join(map(str, given))
        raise InvalidInput(f"{where} has no log that can be used: {what}")
    kept, others = _of_one_rate([_reversed(log) if reverse else log for log in logs])
    return Logs(kept, (*issues, *others))


def _is_copy(log: LoopLog, other: LoopLog) -> bool:
    """Whether two logs have the same samples, rate and gains: as two, they would show no noise."""
    pairs = zip(log.parts, other.parts, strict=False)
    own, others = ((one.gains, one.sampling_Hz, len(one.parts)) for one in (log, other))
    return own == others and all(
        one.keys() == two.keys()
        and all(np.array_equal(one[name], two[name]) for name in one if name != "time")
        for one, two in pairs
    )


def _of_one_rate(logs: list[LoopLog]) -> tuple[tuple[LoopLog, ...], list[DataIssue]]:
    """The logs of the commonest rate, at their middle rate, and why the others are left out."""
    near = [[o for o in logs if _is_near(o.sampling_Hz, log.sampling_Hz)] for log in logs]
    most = max(near, key=len)
    rate = float(np.median([log.sampling_Hz for log in most]))
    kept = [log for log in most if _is_near(log.sampling_Hz, rate)]
    others = [
        DataIssue(
            "refused",
            f"it is sampled at {log.sampling_Hz:.6g} Hz, {len(kept)} of {len(logs)} logs at "
            f"{rate:.6g} Hz, and is left out; give logs of one controller",
            source=log.name,
        )
        for log in logs
        if all(log is not one for one in kept)
    ]
    return tuple(log._replace(sampling_Hz=rate) for log in kept), others


def _is_near(rate: float, other: float) -> bool:
    return abs(rate / other - 1.0) <= DRIFT


def _files(paths: Iterable[Path]) -> Iterator[Path]:
    for path in paths:
        if not path.exists():
            raise InvalidInput(f"{path} does not exist; give a log or a folder of logs")
        if path.is_file():
            yield path
            continue
        if (path / FILE_NAME).is_file():
            raise InvalidInput(f"{path} is a run; give it alone, without other logs")
        for file in sorted(path.rglob("*"), key=_numbered):
            hidden = any(part.startswith(".") for part in file.relative_to(path).parts)
            if file.is_file() and is_readable(file) and not hidden:
                yield file


def _numbered(path: Path) -> list[str | int]:
    """The parts of a path, so that run2 comes before run10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", str(path))]


def _reversed(log: LoopLog) -> LoopLog:
    def of(part: Columns) -> Columns:
        signs = {"setpoint": -1.0, "measurement": -1.0}
        return {name: signs.get(name, 1.0) * values for name, values in part.items()}

    return log._replace(parts=tuple(map(of, log.parts)))


def _read_run(folder: Path) -> Logs:
    try:
        with Journal.open(folder) as journal:
            rig = description_from_json(journal.fact("rig"))
            done = [e for e in journal.entries() if e.outcome is Outcome.DONE]
            records = [journal.record(entry.trial_id) for entry in done]
    except JournalError as error:
        raise InvalidInput(str(error)) from error
    logs = tuple(_of_trial(record, rig.newtons_per_ampere) for record in records)
    if not logs:
        raise InvalidInput(f"{folder} has no completed trial; give another run")
    return Logs(logs, (), rig.controller)


def _of_trial(record: TrialRecord, per_ampere: float) -> LoopLog:
    effort = record.controller_A * per_ampere
    columns = {
        "time": record.time_s,
        "setpoint": record.setpoint_N,
        "measurement": record.tension_N,
        "effort": effort,
    }
    free = (record.flags & SATURATED) == 0
    edges = np.flatnonzero(np.diff(free.astype(np.int8))) + 1
    rows = [part for part in np.split(np.arange(free.size), edges) if free[part[0]]]
    parts = tuple({name: values[part] for name, values in columns.items()} for part in rows)
    return LoopLog(record.trial_id, record.sampling_Hz, parts, record.gains, {}, {}, ())


def gains_of(log: LoopLog, given: Gains | Mapping[str, Gains] | None) -> Gains | None:
    """The gains stated for a log: given for all, by its name, or in its metadata."""
    if isinstance(given, Gains):
        return given
    named = {name: gains for name, gains in (given or {}).items() if name in _names(log)}
    return next(iter(named.values()), log.gains)


def check_names(logs: Iterable[LoopLog], given: Iterable[str]) -> None:
    """Refuses gains that are given for a log that is not there.

    Raises:
        InvalidInput: no log has one of the names.
    """
    known = [_names(log) for log in logs]
    for name in given:
        if not any(name in names for names in known):
            there = ", ".join(names[0] for names in known)
            raise InvalidInput(f"gains are given for {name}, but the logs are {there}")


def _names(log: LoopLog) -> tuple[str, str]:
    """Names that a log answers to: that of its file, with and without the suffix."""
    return log.name, log.name.rpartition(".")[0] or log.name
