"""What a design comes to: its cells, each looked at before anything is run or moves."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from estune import targets
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.planning import DEFAULT_TUNER, make_plan
from estune.profiles import StepProfile
from estune.security import OPEN, read_security
from estune.sweeping.design import SweepDesign, SweptRig
from estune.trial import Rig, RigDescription

SAME_LENGTH_m = 1e-3
"""A rig's own word for its length and the file's may differ by so much."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One tuning of a sweep, with everything that decides it.

    Attributes:
        key: Digest of all the rest; the same in every process and on every machine.
        rig: The model or rig.
        length_m: Cable length, m.
        tension_N: Preload of the step, N.
        tuner: Name of the tuner.
        seed: Which of the repeats this is, from 0.
        search: What else `estune.tune` is told: trials, repeats, eta_max, bounds, tolerance.
        start: Gains to begin from; None is the rig's own.
        step: The step trial.
        cost: How it is scored.
        model: What a model is made with: cable_length_m, and tension_N where the design says it.
        most_trials: Trials it takes if nothing ends it early; follows from the rest.
    """

    key: str
    rig: SweptRig
    length_m: float
    tension_N: float
    tuner: str
    seed: int
    search: dict[str, Any]
    start: Gains | None
    step: StepProfile
    cost: StepCost
    model: Mapping[str, float]
    most_trials: int

    @property
    def label(self) -> str:
        """What to call it in messages."""
        return (
            f"{self.rig.label} at {self.length_m:g} m, {self.tension_N:g} N, {self.tuner}, "
            f"seed {self.seed}"
        )


def cells_of(design: SweepDesign) -> tuple[Cell, ...]:
    """The cells of a design; endpoints are asked what stands there, and nothing moves.

    Raises:
        InvalidInput: a model, length, tension or limit does not fit; a line for each rig.
        RigError: a rig cannot be reached.
    """
    found: list[Cell] = []
    wrong: dict[str, None] = {}
    for rig in design.rigs:
        source, faults = _file_digest(rig), []
        for length, tension in _places(design, rig, wrong):
            try:
                found += _cells_at(design, rig, source, length, tension)
            except InvalidInput as error:
                faults.append(f"{_place(rig, length, tension)}: {error}")
        if faults:
            others = f" ({len(faults) - 1} more places do not fit)" if len(faults) > 1 else ""
            wrong[faults[0] + others] = None
    lengths = {cell.length_m for cell in found}
    if not wrong and len(lengths) < 2:
        only = ", ".join(f"{length:g} m" for length in lengths)
        wrong[f"all rigs stand at {only}: one length only, which gives no law over length"] = None
    if wrong:
        raise InvalidInput("\n".join(wrong))
    return tuple(found)


@contextmanager
def opened(rig: SweptRig, model: Mapping[str, float], seed: int = 0) -> Iterator[Rig]:
    """The rig itself: a model made for the place, or what stands at an endpoint.

    Args:
        rig: Which.
        model: What a model is made with.
        seed: Seed of a model's noise.

    Raises:
        InvalidInput: there is no such model, or it cannot be made so.
        RigError: the rig cannot be reached.
    """
    if not rig.is_model:
        who = OPEN if rig.security is None else read_security(rig.security)
        with targets.open_target(rig.target, rig.rig, who) as remote:
            yield remote
        return
    plant = targets.load(rig.target, model)
    if not hasattr(plant, "rig"):
        raise InvalidInput(
            f"a {type(plant).__name__} is no model that can be made at each length; name a "
            "function such as plants:reference_reel, a model file, or an endpoint"
        )
    made: Rig = plant.rig(name="simulated-reel", seed=seed)
    try:
        yield made
    finally:
        made.close()


def noise_seed(cell: Cell) -> int:
    """Seed of a model's noise: another for each place, the same for each tuner there.

    Were it the same at all lengths, the errors of the tunings would be alike, and a law over them
    would look surer than it is.
    """
    place = repr((cell.rig.label, cell.length_m, cell.tension_N, cell.seed))
    return int.from_bytes(hashlib.sha256(place.encode()).digest()[:8], "little")


def _places(
    design: SweepDesign, rig: SweptRig, wrong: dict[str, None]
) -> list[tuple[float | None, float | None]]:
    """Lengths and tensions to be tuned at; None where the rig says it."""
    tensions: list[float | None] = [*design.tensions_N] or [None]
    if rig.is_model:
        return [(length, tension) for length in design.lengths_m for tension in tensions]
    with opened(rig, {}) as remote:
        length = _length_of(rig, remote.describe(), wrong)
    if length is None:
        return []
    if design.lengths_m and not design.lengths_m[0] <= length <= design.lengths_m[-1]:
        wrong[
            f"{rig.label}: it stands at {length:g} m, outside the sweep's range of "
            f"{design.lengths_m[0]:g} to {design.lengths_m[-1]:g} m; widen lengths_m or leave "
            "the rig out"
        ] = None
        return []
    return [(length, tension) for tension in tensions]


def _place(rig: SweptRig, length: float | None, tension: float | None) -> str:
    """A place in messages."""
    at = "" if length is None else f" at {length:g} m"
    return rig.label + at + ("" if tension is None else f" and {tension:g} N")


def _length_of(rig: SweptRig, description: RigDescription, wrong: dict[str, None]) -> float | None:
    """At which length a rig stands."""
    said, given = description.cable_length_m, rig.cable_length_m
    if said is None and given is None:
        wrong[f"{rig.label}: it does not say its cable length; give cable_length_m"] = None
    if said is not None and given is not None and abs(said - given) > SAME_LENGTH_m:
        wrong[
            f"{rig.label}: it says its cable is {said:g} m long, and cable_length_m is {given:g}; "
            "mend whichever is wrong"
        ] = None
        return None
    return given if said is None else said


def _cells_at(
    design: SweepDesign,
    rig: SweptRig,
    source: str,
    length: float | None,
    tension: float | None,
) -> list[Cell]:
    """The cells of one rig at one place.

    Raises:
        InvalidInput: the rig's limits do not allow the step, or the search does not fit.
    """
    given = {"cable_length_m": length, "tension_N": tension}
    model = {name: value for name, value in given.items() if value is not None}
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
            place = (length or 0.0, step.preload_N, tuner, seed)
            what = (*place, search, start, step, cost, model)
            cells.append(Cell(_key(rig, source, what), rig, *what, plan.most_trials))
    return cells


def _key(rig: SweptRig, source: str, what: tuple[Any, ...]) -> str:
    """Digest of everything that decides a cell; where its files lie is no part of it."""
    *place, search, start, step, cost, model = what
    parts = [
        version("estune"),
        *(rig.label, rig.rig, source),
        *(*place, search, start and asdict(start), asdict(step), asdict(cost), model),
    ]
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


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
