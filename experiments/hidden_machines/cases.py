"""A case: records with something hidden in them, drawn blind from a seed.

What is handed over (`Case`) and what is hidden (`Secret`) are two objects; only a scorer may look
at the second.
"""

import copy
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.hidden_machines import bases, batteries
from experiments.hidden_machines.bases import Base
from experiments.hidden_machines.effects import CATALOGUE, FURTHER, Hidden
from experiments.hidden_machines.records import CaseProperties, MachineRecord, record
from experiments.hidden_machines.undeclared_effects import OUTSIDE

Rng = np.random.Generator

LOW = ("cable_slack", "cable_weight")
SHOWS = 1.5
"""Gap in floors from which on something shows."""
SOFT = ("drum_eccentricity",)
AS_BELIEVED = ("gain_error", "viscous_damping", "gauge_offset")
"""Effects that are nothing but a wrong number: all others are then right."""
UNLOADED = (
    "coulomb_friction",
    "stribeck_friction",
    "dahl_hysteresis",
    "dead_time",
    "current_saturation",
    "rate_limit",
    "torque_ripple",
    "backlash",
)
STAGE = ("coulomb_friction", "stribeck_friction")
OUTSIDE_UNLOADED = (
    "quadratic_drag",
    "motor_heating",
    "sector_rub",
    "lost_samples",
    "amplifier_deadband",
)
PAIRED = (
    "coulomb_friction",
    "stribeck_friction",
    "dahl_hysteresis",
    "eyelet_friction",
    "dead_time",
    "current_saturation",
    "gauge_nonlinearity",
    "gauge_drift",
    "gauge_resonance",
    "cable_stiffening",
    "cable_creep",
    "torque_ripple",
    "structural_mode",
    "mains_interference",
)
FAMILIES = (
    ("coulomb_friction", "dahl_hysteresis", "stribeck_friction", "load_friction"),
    ("dead_time", "rate_limit", "nonlinear_lag", "current_lag"),
    ("cable_weight", "string_mode"),
)

VARIANTS = (
    "plain",
    "none",
    "outside",
    "two",
    "left_out",
    "noise5",
    "steps_only",
    "no_encoder",
    "none_no_encoder",
    "none_unloaded",
    "wrong_base",
    "unloaded",
    "outside_unloaded",
    "stage",
)


@dataclass(frozen=True, eq=False)
class Case:
    """The data that are handed over.

    Attributes:
        variant: What kind of case it is; says nothing of what is hidden.
        kind: `reel`, `unloaded` or `stage`: what model its owner has of it.
        given: The numbers of that model.
        records: The records.
    """

    variant: str
    kind: str
    given: dict[str, Any]
    records: tuple[MachineRecord, ...]


@dataclass(frozen=True)
class Secret:
    """The hidden truth, for the scorer only.

    Attributes:
        names: Slugs of what is hidden; none is hidden where it is empty.
        parameters: By slug, where a report's mean the same.
        calibrations: What the machine's own numbers really are.
        named: Whether reports have names for all that is hidden.
        accepted: Sets of names that are right.
    """

    names: tuple[str, ...]
    parameters: dict[str, dict[str, float]]
    calibrations: dict[str, float]
    named: bool
    accepted: tuple[tuple[str, ...], ...]


def draw(
    seed: int, variant: str = "plain", effect: str | None = None, *, only: str | None = None
) -> tuple[Case, Secret]:
    """Draws a case.

    Args:
        seed: All chance comes from it and the variant.
        variant: One of `VARIANTS`.
        effect: Slug to hide instead of one drawn; several joined by +.
        only: Of the effects drawn the one that acts, all else as it is with the others.
    """
    rng, own, names, bench = _bench(seed, variant, effect, only)
    hidden, believed, actual = bench.hidden, bench.believed, bench.actual
    lengths = _lengths(rng, believed, names)
    plans = _battery(rng, variant, believed, names)
    again = copy.deepcopy((rng, own))
    records = _taken((rng, own), bench, plans, lengths)
    case = Case(variant, believed.kind, believed.given(), records)
    there = tuple(sorted(one.name for one in hidden))
    accepted = _accepted(there, believed.kind)
    if "backlash" in there and believed.kind == "reel":
        closed = replace(bench, hidden=tuple(map(_without_play, hidden)))
        if not _differ(records, _taken(again, closed, plans, lengths), bench):
            accepted = (*accepted, ("coulomb_friction",))
    secret = Secret(
        there,
        {one.name: _measurable(one.truth, actual) for one in hidden},
        bases.facts(actual),
        named=all(one.name not in OUTSIDE for one in hidden),
        accepted=accepted,
    )
    return case, secret


def further_record(
    seed: int, effect: str, length_m: float | None, plan: batteries.RecordPlan
) -> MachineRecord:
    """One record more of the machine of a plain case; its noise depends on the seed alone."""
    *_, bench = _bench(seed, "plain", effect, None)
    chance = np.random.default_rng([seed, 2]), np.random.default_rng([seed, 3])
    return record(chance, bench, plan, length_m, number=0, warmth=0.0)[0]


def _bench(
    seed: int, variant: str, effect: str | None, only: str | None
) -> tuple[Rng, Rng, tuple[str, ...], CaseProperties]:
    """Both sources of chance, the names that were drawn, and the machine; see `draw`."""
    if variant not in VARIANTS:
        raise ValueError(f"{variant!r} is none of {VARIANTS}")
    # What is hidden has chance of its own: with another effect all else stays the same.
    own = np.random.default_rng([zlib.crc32(variant.encode()), seed, 1])
    names = _names(own, variant, effect)
    rng = np.random.default_rng([zlib.crc32(variant.encode()), seed, 0])
    believed = _believed(rng, variant, names)
    hidden = tuple((CATALOGUE | FURTHER | OUTSIDE)[name](own, believed) for name in names)
    hidden = tuple(one for one in hidden if only in (None, one.name))
    if set(names) & set(AS_BELIEVED):
        actual = bases.as_believed(rng, believed)
    else:
        actual = bases.actual(rng, believed, wrong=variant == "wrong_base")
    bench = CaseProperties(
        actual,
        believed,
        hidden,
        gains=(
            rng.uniform(0.3, 0.5),
            rng.uniform(8.0, 14.0),
            rng.uniform(0.008, 0.012),
            rng.uniform(0.01, 0.04),
        ),
        noise=5.0 if variant == "noise5" else 1.0,
        encoder=variant not in ("no_encoder", "none_no_encoder"),
        outside_gauge=believed.kind == "reel" and rng.random() < 0.15,
        measured_current=believed.kind == "reel" and rng.random() < 0.15,
    )
    return rng, own, names, bench


def _taken(
    chance: tuple[Rng, Rng],
    bench: CaseProperties,
    plans: list[batteries.RecordPlan],
    lengths: list[float | None],
) -> tuple[MachineRecord, ...]:
    """The records of a battery, one after the other."""
    records: list[MachineRecord] = []
    warmth = 0.0
    for number, plan in enumerate(plans):
        same = number if plan.repeats is None else plan.repeats
        length = lengths[same % len(lengths)]
        taken, warmth = record(chance, bench, plan, length, number=number, warmth=warmth)
        records.append(taken)
    return tuple(records)


def _measurable(truth: dict[str, float], actual: Base) -> dict[str, float]:
    """Parameters of an effect as records show them.

    Without a gauge nothing but the drive's own current measures a torque: it is known relative to
    the gain of the drive.
    """
    gain = 1.0 if actual.kind == "reel" else actual.gain
    torques = ("_Nm", "_Nms")
    return {name: x / gain if name.endswith(torques) else x for name, x in truth.items()}


def _without_play(effect: Hidden) -> Hidden:
    """The same with a gear that is closed."""
    return (
        replace(effect, machine=effect.machine | {"play": 0.0})
        if "play" in effect.machine
        else effect
    )


def _differ(
    some: tuple[MachineRecord, ...], others: tuple[MachineRecord, ...], bench: CaseProperties
) -> bool:
    """Whether records of the same noise differ by what shows.

    What shows is a gap of one and a half floors: the difference in stretches of a tenth of a
    second, less a straight line, as its root mean square in floors.
    """
    floors = {
        "tension_N": bench.actual.noise_N * bench.noise,
        "angle_rad": 2.0 * np.pi / bench.actual.encoder_counts / np.sqrt(12.0),
    }
    stretch = round(0.1 * bench.actual.rate_Hz)
    left: list[NDArray[np.float64]] = []
    for one, other in zip(some, others, strict=True):
        for name in floors.keys() & one.columns.keys():
            apart = (one.columns[name] - other.columns[name]) / floors[name]
            left.append(_bent(apart[: apart.size // stretch * stretch].reshape(-1, stretch)))
    squares = np.square(np.concatenate(left))
    return float(1.0 + squares.mean()) >= SHOWS**2


def _bent(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Residuals of rows about straight lines, flat."""
    t = np.linspace(-1.0, 1.0, rows.shape[1])
    basis = np.stack([np.ones_like(t), t]) / np.sqrt(np.array([[float(t.size)], [float(t @ t)]]))
    left: NDArray[np.float64] = rows - rows @ basis.T @ basis
    return left.ravel()


def family(name: str) -> str:
    """Effects of one family have one name here."""
    return next((group[0] for group in FAMILIES if name in group), name)


def _accepted(names: tuple[str, ...], kind: str) -> tuple[tuple[str, ...], ...]:
    """The drum behind a reel's gear has dry friction, which an answer may name, too.

    Where records would hardly be other ones with the gear closed, they show nothing but friction;
    `draw` then takes that for an answer as well. (Records run freely, so that what a difference
    leads to counts as much as what makes it: few are let off.)
    """
    if "backlash" in names and kind == "reel":
        return (names, tuple(sorted({*names, "coulomb_friction"})))
    return (names,)


def _names(rng: Rng, variant: str, effect: str | None) -> tuple[str, ...]:
    if effect is not None:
        return tuple(name for name in effect.split("+") if name != "none")
    if variant.startswith("none"):
        return ()
    if variant == "two":
        while True:
            pair = [str(name) for name in rng.choice(PAIRED, 2, replace=False)]
            if family(pair[0]) != family(pair[1]):
                return tuple(pair)
    choice = {
        "outside": tuple(name for name in OUTSIDE if name != "amplifier_deadband"),
        "outside_unloaded": OUTSIDE_UNLOADED,
        "unloaded": UNLOADED,
        "stage": STAGE,
    }.get(variant, tuple(CATALOGUE))
    if variant in ("steps_only", "no_encoder", "wrong_base", "left_out"):
        choice = tuple(n for n in choice if n not in (*LOW, *SOFT, *AS_BELIEVED, "backlash"))
    return (str(rng.choice(choice)),)


def _believed(rng: Rng, variant: str, names: tuple[str, ...]) -> Base:
    if variant == "stage":
        return bases.STAGE
    if variant in ("unloaded", "outside_unloaded", "none_unloaded"):
        return bases.UNLOADED
    if set(names) & set(SOFT) or (variant == "none" and rng.random() < 0.1):
        return bases.SOFT
    return bases.REEL


def _lengths(rng: Rng, believed: Base, names: tuple[str, ...]) -> list[float | None]:
    """One or two deployed lengths, in turn."""
    if believed.kind != "reel":
        return [None]
    if set(names) & {"cable_weight"}:
        return [float(rng.uniform(1.1, 1.4))]
    length = float(rng.uniform(0.5, 1.3))
    if rng.random() < 0.3:
        return [length, float(min(1.4, length * rng.uniform(1.1, 1.5)))]
    return [length]


def _battery(
    rng: Rng, variant: str, believed: Base, names: tuple[str, ...]
) -> list[batteries.RecordPlan]:
    if believed.kind == "stage":
        return batteries.stage(rng, believed)
    if believed.kind == "unloaded":
        reverses = "backlash" in names or (not names and rng.random() < 0.2)
        return (batteries.reversing if reverses else batteries.unloaded)(rng, believed)
    if believed is bases.SOFT:
        return batteries.soft(rng, believed)
    battery = batteries.steps_only if variant == "steps_only" else batteries.tensioned
    chance = rng.random() if variant == "none" else 1.0
    if "backlash" in names or 0.1 <= chance < 0.2:
        battery = batteries.parting
    elif set(names) & set(LOW) or chance < 0.1:
        battery = batteries.low
    return battery(rng, believed)
