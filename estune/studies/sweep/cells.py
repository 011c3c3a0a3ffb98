"""Cells of a sweep: single tunings, each with everything that determines its outcome."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.setting import stated
from estune.errors import InvalidInput
from estune.remote.security import OPEN, read_security
from estune.run import targets
from estune.run.planning import known_start, make_plan, suited_step
from estune.run.start import KnownStart
from estune.studies.law.start import start_from
from estune.studies.sweep.design import SweepDesign, SweptRig
from estune.support.lazy_sequence import LazySequence
from estune.trial import Rig, RigDescription
from estune.trial.profiles import StepProfile
from estune.trial.signals import REEL, Signals
from estune.tuners import DEFAULT_TUNER

LENGTH_TOLERANCE_m = 1e-3
"""Largest difference between the cable length in a rig's description and in the design."""

KEY_LENGTH = 20


@dataclass(frozen=True, slots=True)
class Cell:
    """One tuning of a sweep.

    Attributes:
        key: Digest of everything that determines the outcome; the same on every machine.
        seed: Number of the repeat, from 0.
        search: Arguments of `estune.tune`: trials, repeats, eta_max, bounds, tolerance.
        start: Initial gains; None for the rig's own.
        model: Arguments of a model: cable_length_m, and tension_N where the design varies it.
        signals: What the rig measures and commands.
    """

    key: str
    rig: SweptRig
    length_m: float
    tension_N: float
    tuner: str
    seed: int
    search: dict[str, Any]
    start: Gains | KnownStart | None
    step: StepProfile
    cost: StepCost
    model: Mapping[str, float]
    most_trials: int
    signals: Signals = REEL

    @property
    def label(self) -> str:
        """Name of the cell in messages."""
        return (
            f"{self.rig.label} at {self.length_m:g} m, "
            f"{self.signals.measured(self.tension_N, 6)}, {self.tuner}, seed {self.seed}"
        )

    @property
    def noise_seed(self) -> int:
        """Seed of a model's noise: different at each place, the same for each tuner there.

        With one seed at all lengths the errors of the tunings would be correlated, and a law
        over them would look more certain than it is.
        """
        place = repr((self.rig.label, self.length_m, self.tension_N, self.seed))
        return int.from_bytes(hashlib.sha256(place.encode()).digest()[:8], "little")


@contextmanager
def open_rig(rig: SweptRig, model: Mapping[str, float], seed: int = 0) -> Iterator[Rig]:
    """A simulated rig made from a model and its arguments, or the rig at an endpoint.

    Raises:
        InvalidInput: there is no such model, or it does not take these arguments.
        RigError: the rig cannot be reached.
    """
    if not rig.is_model:
        security = OPEN if rig.security is None else read_security(rig.security)
        patience_s = rig.patience_s
        with targets.open_target(rig.target, rig.rig, security, patience_s) as remote:
            yield remote
        return
    plant = targets.load(rig.target, model)
    if not hasattr(plant, "rig"):
        raise InvalidInput(
            f"a {type(plant).__name__} is no model that can be made at each length; name a "
            "function such as plants:reference_reel, a model file, or an endpoint"
        )
    simulated: Rig = plant.rig(seed=seed)
    try:
        yield simulated
    finally:
        simulated.close()


_Settings = tuple[
    dict[str, Any], Gains | KnownStart | None, StepProfile, StepCost, Mapping[str, float]
]


class _Place(NamedTuple):
    """Cells that differ in their seed alone.

    Attributes:
        where: Length, tension and tuner.
    """

    rig: SweptRig
    where: tuple[float, float, str]
    settings: _Settings
    most_trials: int
    signals: Signals
    keys: str

    def cell(self, seed: int) -> Cell:
        key = self.keys[seed * KEY_LENGTH : (seed + 1) * KEY_LENGTH]
        (length, tension, tuner), (search, start, step, cost, model) = self.where, self.settings
        place = self.rig, length, tension, tuner
        return Cell(
            *(key, *place, seed, search, start, step, cost, model),
            most_trials=self.most_trials,
            signals=self.signals,
        )


def expand_cells(design: SweepDesign) -> LazySequence[Cell]:
    """The cells of a design; rigs at endpoints are asked for their description, nothing moves.

    Raises:
        InvalidInput: a model, length, tension or limit does not fit; one line for each rig.
        RigError: a rig cannot be reached.
    """
    places: list[_Place] = []
    faults: list[str] = []
    for rig in design.rigs:
        try:
            places += _places_of_rig(design, rig)
        except InvalidInput as error:
            faults.append(str(error))
    lengths = {place.where[0] for place in places}
    if not faults and len(lengths) < 2:
        only = ", ".join(f"{length:g} m" for length in lengths)
        faults.append(
            f"all rigs have a cable of {only}: one length only, which gives no law over length; "
            "add rigs with other lengths"
        )
    if faults:
        raise InvalidInput("\n".join(faults))

    seeds = design.seeds
    numbers = range(len(places) * seeds)
    return LazySequence(numbers, lambda n: places[n // seeds].cell(n % seeds))


def _places_of_rig(design: SweepDesign, rig: SweptRig) -> list[_Place]:
    """The cells of one rig.

    Raises:
        InvalidInput: some places do not fit; names the first and the number of the others.
    """
    source = _file_digest(rig)
    lengths = design.lengths_m if rig.is_model else [_remote_length(design, rig)]
    tensions: list[float | None] = [*design.tensions_N] or [None]
    places: list[_Place] = []
    faults: list[str] = []
    for length, tension in product(lengths, tensions):
        try:
            places += _places_at(design, rig, source, length, tension)
        except InvalidInput as error:
            place = "" if tension is None else f" and {tension:g} N"
            faults.append(f"{rig.label} at {length:g} m{place}: {error}")
    if faults:
        others = f" ({len(faults) - 1} more places do not fit)" if len(faults) > 1 else ""
        raise InvalidInput(faults[0] + others)
    return places


def _remote_length(design: SweepDesign, rig: SweptRig) -> float:
    """Cable length of a rig at an endpoint; it must be known, unambiguous and within range."""
    with open_rig(rig, {}) as remote:
        described = remote.describe().cable_length_m
    given = rig.cable_length_m
    if described and given and abs(described - given) > LENGTH_TOLERANCE_m:
        raise InvalidInput(
            f"{rig.label}: its description has a cable of {described:g} m, and cable_length_m is "
            f"{given:g}; correct the wrong one"
        )
    length = described or given
    if length is None:
        raise InvalidInput(f"{rig.label}: it does not state its cable length; give cable_length_m")
    if design.lengths_m and not design.lengths_m[0] <= length <= design.lengths_m[-1]:
        raise InvalidInput(
            f"{rig.label}: its cable is {length:g} m, outside the sweep's range of "
            f"{design.lengths_m[0]:g} to {design.lengths_m[-1]:g} m; widen lengths_m or leave "
            "the rig out"
        )
    return length


def _places_at(
    design: SweepDesign, rig: SweptRig, source: str, length: float, tension: float | None
) -> list[_Place]:
    """The cells of one rig at one length and tension, checked against the rig's limits."""
    model = {"cable_length_m": length}
    if tension is not None:
        model["tension_N"] = tension
    with open_rig(rig, model) as opened:
        description = opened.describe()
    cost = design.cost.of(description)
    step = _step(design, description, tension, cost)
    start = _start(design.start, description, step, cost)
    search = design.search
    places = []
    for tuner in design.tuners or [DEFAULT_TUNER]:
        plan = make_plan(
            description, "check", tuner=tuner, start=start, step=step, cost=cost, **search
        )
        where = length, step.preload_N, tuner
        settings = search, start, step, cost, model
        keys = _keys(rig, source, where, settings, design.seeds)
        places.append(_Place(rig, where, settings, plan.max_trials, description.signals, keys))
    return places


def _start(
    given: Mapping[str, float] | str, rig: RigDescription, step: StepProfile, cost: StepCost
) -> Gains | KnownStart | None:
    if not given:
        return None
    if not isinstance(given, str):
        return replace(rig.gains, **given)
    return known_start(start_from(given), rig, step, cost, None)


def _step(
    design: SweepDesign, rig: RigDescription, tension: float | None, cost: StepCost
) -> StepProfile:
    step = suited_step(design.step.of(rig), cost, rig)
    if tension is not None:
        step = replace(step, preload_N=tension)
    rig.limits.check(step)
    return step


def _keys(
    rig: SweptRig, source: str, where: tuple[float, float, str], settings: _Settings, seeds: int
) -> str:
    """The keys of the cells of a place, one for each seed.

    Each is a digest of everything that determines the outcome, wherever its files lie: the JSON
    list of all these values.
    """
    (length, tension, tuner), (search, start, step, cost, model) = where, settings
    to_json = json.JSONEncoder(sort_keys=True, default=asdict).encode
    before = to_json([version("estune"), rig.label, rig.rig, source, length, tension, tuner])[:-1]
    start_values = start and asdict(start)
    weights = asdict(cost)
    del weights["unscaled"]  # follows from the rig
    after = to_json([search, start_values, stated(step), weights, model])[1:]
    texts = (f"{before}, {seed}, {after}" for seed in range(seeds))
    return "".join(hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH] for text in texts)


def _file_digest(rig: SweptRig) -> str:
    """Digest of a model's file, so that a changed model makes new cells; empty without a file."""
    if not (rig.is_model and rig.target.endswith(targets.MODEL_FILE)):
        return ""
    try:
        return hashlib.sha256(Path(rig.target).read_bytes()).hexdigest()
    except OSError as error:
        raise InvalidInput(
            f"{rig.target}: {error.strerror or error}; name a model file"
        ) from error
