"""A cell of a sweep: one tuning with everything that decides it, and the rig it is of."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.remote.security import OPEN, read_security
from estune.run import targets
from estune.studies.sweep.design import SweptRig
from estune.trial import Rig
from estune.trial.profiles import StepProfile


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


def key_of(rig: SweptRig, source: str, what: tuple[Any, ...]) -> str:
    """Digest of everything that decides a cell; where its files lie is no part of it.

    Args:
        rig: The model or rig.
        source: Digest of a model's file.
        what: The fields of the cell after `rig`, without what follows from the rest.
    """
    *place, search, start, step, cost, model = what
    parts = [
        version("estune"),
        *(rig.label, rig.rig, source),
        *(*place, search, start and asdict(start), asdict(step), asdict(cost), model),
    ]
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:20]
