"""What a design comes to: its cells, each looked at before anything is run or moves."""

import hashlib
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from estune.errors import InvalidInput
from estune.run import targets
from estune.run.plan import DEFAULT_TUNER, make_plan
from estune.studies.sweep.cell import Cell, key_of, opened
from estune.studies.sweep.design import SweepDesign, SweptRig
from estune.trial import RigDescription

SAME_LENGTH_m = 1e-3
"""A rig's own word for its length and the file's may differ by so much."""


def expand_cells(design: SweepDesign) -> tuple[Cell, ...]:
    """The cells of a design; endpoints are asked what stands there, and nothing moves.

    Raises:
        InvalidInput: a model, length, tension or limit does not fit; a line for each rig.
        RigError: a rig cannot be reached.
    """
    found: list[Cell] = []
    wrong: list[str] = []
    for rig in design.rigs:
        try:
            found += _cells_on(design, rig)
        except InvalidInput as error:
            wrong.append(str(error))
    lengths = {cell.length_m for cell in found}
    if not wrong and len(lengths) < 2:
        only = ", ".join(f"{length:g} m" for length in lengths)
        wrong.append(
            f"all rigs stand at {only}: one length only, which gives no law over length; add rigs "
            "at other lengths"
        )
    if wrong:
        raise InvalidInput("\n".join(wrong))
    return tuple(found)


def _cells_on(design: SweepDesign, rig: SweptRig) -> list[Cell]:
    """The cells of one rig.

    Raises:
        InvalidInput: it cannot be tuned at some place; the first is told, and how many more.
    """
    source = _file_digest(rig)
    lengths = design.lengths_m if rig.is_model else [_standing_at(design, rig)]
    tensions: list[float | None] = [*design.tensions_N] or [None]
    cells: list[Cell] = []
    faults: list[str] = []
    for length, tension in product(lengths, tensions):
        try:
            cells += _cells_at(design, rig, source, length, tension)
        except InvalidInput as error:
            on = "" if tension is None else f" and {tension:g} N"
            faults.append(f"{rig.label} at {length:g} m{on}: {error}")
    if faults:
        others = f" ({len(faults) - 1} more places do not fit)" if len(faults) > 1 else ""
        raise InvalidInput(faults[0] + others)
    return cells


def _standing_at(design: SweepDesign, rig: SweptRig) -> float:
    """At which length a rig at an endpoint stands.

    Raises:
        InvalidInput: nobody says so, it is told twice, or it is outside the sweep's range.
    """
    with opened(rig, {}) as remote:
        length = _told_length(rig, remote.describe())
    if design.lengths_m and not design.lengths_m[0] <= length <= design.lengths_m[-1]:
        raise InvalidInput(
            f"{rig.label}: it stands at {length:g} m, outside the sweep's range of "
            f"{design.lengths_m[0]:g} to {design.lengths_m[-1]:g} m; widen lengths_m or leave "
            "the rig out"
        )
    return length


def _told_length(rig: SweptRig, description: RigDescription) -> float:
    said, given = description.cable_length_m, rig.cable_length_m
    if said is not None and given is not None and abs(said - given) > SAME_LENGTH_m:
        raise InvalidInput(
            f"{rig.label}: it says its cable is {said:g} m long, and cable_length_m is {given:g}; "
            "mend whichever is wrong"
        )
    length = said or given
    if length is None:
        raise InvalidInput(f"{rig.label}: it does not say its cable length; give cable_length_m")
    return length


def _cells_at(
    design: SweepDesign,
    rig: SweptRig,
    source: str,
    length: float,
    tension: float | None,
) -> list[Cell]:
    """The cells of one rig at one place.

    Raises:
        InvalidInput: the rig's limits do not allow the step, or the search does not fit.
    """
    model = {"cable_length_m": length}
    if tension is not None:
        model["tension_N"] = tension
    with opened(rig, model) as the_rig:
        description = the_rig.describe()
    step = design.step.of(description)
    if tension is not None:
        step = replace(step, preload_N=tension)
    description.limits.check(step)
    cost = design.cost.of(description)
    start = replace(description.gains, **design.start) if design.start else None
    search: dict[str, Any] = {
        "trials": design.trials,
        "repeats": design.repeats,
        "tolerance": design.tolerance,
        "eta_max": design.eta_max,
        "bounds": dict(design.bounds) or None,
    }
    cells = []
    for tuner in design.tuners or [DEFAULT_TUNER]:
        plan = make_plan(
            description, "check", tuner=tuner, start=start, step=step, cost=cost, **search
        )
        for seed in range(design.seeds):
            place = (length, step.preload_N, tuner, seed)
            what = (*place, search, start, step, cost, model)
            cells.append(Cell(key_of(rig, source, what), rig, *what, plan.most_trials))
    return cells


def _file_digest(rig: SweptRig) -> str:
    """Digest of a model's file, so that a changed model is tuned anew."""
    if not (rig.is_model and rig.target.endswith(targets.MODEL_FILE)):
        return ""
    try:
        return hashlib.sha256(Path(rig.target).read_bytes()).hexdigest()
    except OSError as error:
        raise InvalidInput(
            f"{rig.target}: {error.strerror or error}; name a model file"
        ) from error
