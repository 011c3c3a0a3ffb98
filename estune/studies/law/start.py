"""Initial gains from the law of a sweep or of earlier runs, from one earlier run, or from logs."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from estune import api
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput, JournalError
from estune.loop_model.optimum import RobustnessLimits
from estune.loop_model.prediction import StepTrial
from estune.recordings.loop_log import DRIFT
from estune.run.journal import FILE_NAME, RUNS
from estune.run.start import KnownStart, StartRule
from estune.service_records.sources import read_logs
from estune.service_records.suggestion import suggest
from estune.studies.law.law import GainLaw, fit_law
from estune.studies.law.tuned import CELLS, TunedGains
from estune.trial import RigDescription

if TYPE_CHECKING:
    from estune.run.results.result import TuneResult

LENGTHS_MIN = 3
"""Lengths from which a law is fitted; with fewer the run at the nearest length is taken."""

FORMS = "model, run:RUN, law:SWEEP, law:RUNS or records:LOGS"


def start_from(source: str) -> StartRule | Literal["model"]:
    """Initial gains that are known beforehand, as the argument `start` of `estune.tune`.

    Args:
        source: "model" for the optimum of the rig's own linear model, "run:FOLDER" for the gains
            of a run, "law:FOLDER" for the law over cable length of a sweep, or of the tuned runs
            in a folder that have the cost, limits and tuner of the latest, or "records:FOLDER" for
            the gains that `estune.suggest` recommends by logs of the rig in service, at the gains
            that their metadata name or the logged effort shows, else its live ones. A law is used
            within its lengths only; runs at fewer than three lengths give the gains of the one
            nearest in length.

    Raises:
        InvalidInput: the source is none of these.
        JournalError: there is no such run, or nothing tuned in the folder; a rule raises
            InvalidInput for a rig beyond the law's lengths.

    Example:
        >>> import estune, plants
        >>> start = estune.start_from("law:sweeps/reference")  # doctest: +SKIP
        >>> result = estune.tune(plants.reference_reel(1.2), start=start)  # doctest: +SKIP
    """
    kind, _, where = source.partition(":")
    if source == "model":
        return "model"
    if kind == "run" and where:
        known = _of_run(_run_folder(where))
        return lambda *_: known
    if kind == "law" and where:
        return partial(_by_length, _tunings(Path(where)), where)
    if kind == "records" and where:
        return partial(_by_records, Path(where))
    raise InvalidInput(f"{source!r} is no source of initial gains; give {FORMS}")


def _by_records(
    folder: Path, rig: RigDescription, trial: StepTrial, limits: RobustnessLimits
) -> KnownStart:
    """The gains that logs of the rig in service recommend."""
    logs = read_logs(folder)
    doubted = next((issue for issue in logs.issues if issue.level == "doubt"), None)
    if doubted is not None:  # a rig is not moved by gains that may be a thousand times off
        raise InvalidInput(f"{doubted}; write the unit into the heading of the log")
    rate = logs.logs[0].sampling_Hz
    if abs(rate / rig.controller.sampling_Hz - 1.0) > DRIFT:
        raise InvalidInput(
            f"{folder} is sampled at {rate:.6g} Hz, {rig.name} at "
            f"{rig.controller.sampling_Hz:.6g} Hz; give logs of the loop at the rig's own rate"
        )
    # A logged effort shows the gains that ran, which need not be those of now.
    stated = {
        log.name: log.gains or rig.gains
        for log in logs.logs
        if log.gains or "effort" not in log.sources
    }
    found = suggest(
        logs._replace(controller=rig.controller),
        gains=stated,
        trial=trial,
        limits=limits,
    )
    if found.recommendation is None or found.exit_code:
        raise InvalidInput(f"{folder} recommends no gains: {found.heading()}")
    return KnownStart(found.recommendation.gains, f"the gains recommended by the logs of {folder}")


def _run_folder(run: str) -> Path:
    for path in (Path(run), Path(RUNS) / run):
        if (path / FILE_NAME).is_file():
            return path
    raise JournalError(f"there is no run {run}; list the runs with: estune list")


def _of_run(folder: Path) -> KnownStart:
    result = api.load(folder)
    if not result.success:
        raise InvalidInput(f"run {folder} found no better gains: {result.message}")
    return KnownStart(result.gains, f"the gains of run {folder.name}")


def _tunings(folder: Path) -> tuple[TunedGains, ...]:
    """The tuned gains of a sweep, or of the runs of a folder that state their cable length."""
    if (folder / CELLS).is_file():
        return _of_sweep(folder / CELLS)
    paths = sorted(folder.glob(f"*/{FILE_NAME}"), key=lambda path: path.stat().st_mtime)
    tuned = [r for path in paths if (r := api.load(path.parent)).success and r.rig.cable_length_m]
    tunings = tuple(_data_point(r) for r in tuned if _aim(r) == _aim(tuned[-1]))
    if not tunings:
        raise JournalError(
            f"{folder} contains neither a sweep nor a tuned run of a reel with a cable length; "
            "give the folder of a sweep or of runs"
        )
    return tunings


def _of_sweep(path: Path) -> tuple[TunedGains, ...]:
    import pandas as pd  # noqa: PLC0415  slow to import

    rows = [row for _, row in pd.read_csv(path).iterrows()]
    series = {(row["tuner"], row["rig"]) for row in rows}
    if len({tuner for tuner, _ in series}) > 1:
        raise InvalidInput(
            f"{path.parent} holds laws of several tuners; sweep with one of them, or take a "
            "folder of runs"
        )
    return tuple(
        TunedGains(
            label=f"{row['rig']} at {row['length_m']:g} m",
            length_m=row["length_m"],
            tension_N=row["tension_N"],
            gains=Gains(*(row[name] for name in GAIN_NAMES)),
            log_errors=_errors([row[f"{name}_log_error"] for name in GAIN_NAMES]),
            cost=row["cost"],
            cost_error=row["cost_error"],
            safe=bool(row["safe"]),
            converged=bool(row["converged"]),
        )
        for row in rows
        if math.isfinite(row["P"])
    )


def _errors(errors: Sequence[float]) -> tuple[float, ...] | None:
    return None if all(map(math.isnan, errors)) else tuple(errors)


def _aim(result: "TuneResult") -> tuple[object, ...]:
    """The aim of a run: only runs of one aim, that of the latest, make a law."""
    plan = result.plan
    return replace(plan.cost, settling_time_s=1.0), plan.limits, plan.tuner.name


def _data_point(result: "TuneResult") -> TunedGains:
    assert result.folder is not None  # noqa: S101  it was loaded from there
    assert result.rig.cable_length_m is not None  # noqa: S101  checked by the caller
    return TunedGains(
        label=result.folder.name,
        length_m=result.rig.cable_length_m,
        tension_N=result.plan.step.preload_N,
        gains=result.gains,
        log_errors=None,
        cost=result.verdict.cost,
        cost_error=result.verdict.cost_error,
        safe=True,
        converged=True,
    )


def _by_length(
    tunings: Sequence[TunedGains],
    where: str,
    rig: RigDescription,
    _trial: StepTrial,
    _limits: RobustnessLimits,
) -> KnownStart:
    length_m = rig.cable_length_m
    if length_m is None:
        raise InvalidInput(
            f"rig {rig.name} does not state its cable length, by which the law is read; start "
            "from a run, or from the model"
        )
    if len({t.length_m for t in tunings}) >= LENGTHS_MIN:
        return _at(fit_law(tunings), where, rig.step.preload_N, length_m)
    nearest = min(tunings, key=lambda t: abs(t.length_m - length_m))
    return KnownStart(
        nearest.gains,
        f"the gains of {nearest.label} at {nearest.length_m:g} m, the nearest length in {where} "
        f"(a law needs {LENGTHS_MIN} lengths)",
    )


def _at(law: GainLaw, where: str, preload_N: float, length_m: float) -> KnownStart:
    """The gains of a law, with their prediction bands in the source."""
    tension = None if law.tension_N[0] == law.tension_N[1] else preload_N
    bands = {name: law.band(name, [length_m], tension) for name in GAIN_NAMES}
    values = {name: float(f"{band.gain[0]:.6g}") for name, band in bands.items()}
    shown = [
        f"{name} {values[name]:.3g} ({max(band.new_low[0], 0.0):.3g} to {band.new_high[0]:.3g})"
        for name, band in bands.items()
    ]
    return KnownStart(
        Gains(**values),
        f"the gains of the law of {len(law.tunings)} tunings from {law.length_m[0]:g} to "
        f"{law.length_m[1]:g} m in {where}, with 95 % prediction bands: {', '.join(shown)}",
    )
