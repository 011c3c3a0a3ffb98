"""What can be done about an effect: declared by the effect, with its numbers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from plants.effects.plant_scale import PlantScale


class Place(StrEnum):
    """Where a remedy is applied."""

    LOOP = "loop"  # a term beside the controller, in [compensation] of the rig's file
    CALIBRATION = "calibration"  # a number of C1, C2 or the rig's file
    WORKSHOP = "workshop"  # mechanical or electrical
    LIMIT = "limit"  # a limit of what tuning can reach: told, not mended


WORK = {
    Place.LOOP: "one table in the rig's file",
    Place.CALIBRATION: "recalibrate: weights on the cable, or an instrument at the motor",
    Place.WORKSHOP: "workshop",
    Place.LIMIT: "none",
}

BY_HAND = "by hand, in the drive's own controller"
"""Work of what a loop of a reel does by a table of its file, on a machine that is no reel."""

SAFE_FRACTION = 0.8
"""Greatest share of a feed-forward that is offered: from 0.8 to 1.0 it gains most, and above that
an error of the identified size turns it into a disturbance (`experiments.compensation`)."""


@dataclass(frozen=True, slots=True)
class Remedy:
    """One thing that can be done.

    Attributes:
        place: Where.
        title: What to do, an imperative without a full stop.
        harm: What it may harm, and how much of it is safe.
        sized_by: The effect's parameter whose interval decides whether it can be done; empty where
            it has no number.
        removes: Share of that parameter that it takes away where the number is right.
        tables: Tables of `[compensation]` in the rig's file, for a loop that has them. A
            `fraction` in one is set by the interval of `sized_by`.
    """

    place: Place
    title: str
    harm: str = ""
    sized_by: str = ""
    removes: float = 0.0
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    work: str = ""

    @property
    def effort(self) -> str:
        """What work it takes, by its place where nothing else is declared."""
        return self.work or WORK[self.place]


def in_loop(
    plant: PlantScale,
    title: str,
    sized_by: str,
    table: tuple[str, Mapping[str, Any]],
    harm: str,
) -> Remedy:
    """A term beside the controller; by hand on a machine that is no reel."""
    if not plant.has_cable:
        return Remedy(Place.LOOP, title, sized_by=sized_by, work=BY_HAND)
    name, keys = table
    return Remedy(Place.LOOP, title, harm, sized_by, tables={name: dict(keys)})


def friction_feed_forward(
    plant: PlantScale, sized_by: str, friction: Mapping[str, float]
) -> tuple[Remedy, ...]:
    """Friction fed forward along the known motion; see `estune.reel.friction`.

    Args:
        plant: Words and sizes of the plant.
        sized_by: The parameter that sizes it.
        friction: Keys of `[compensation.friction]` that the effect gives.
    """
    table = {"coulomb_Nm": 0.0, "static_Nm": 0.0, "stribeck_rad_s": 1.0} | dict(friction)
    title = "feed the friction forward along the known motion"
    harm = "at 1.5 of the true friction tracking is as bad as without"
    return (in_loop(plant, title, sized_by, ("friction", table | known_motion(plant)), harm),)


def known_motion(plant: PlantScale) -> dict[str, float]:
    """Keys of every table of a friction along the known motion."""
    per_rad = plant.stiffness_N_m * plant.radius_m
    known = {"tension_per_rad_N": per_rad} if math.isfinite(per_rad) else {}
    return {"fraction": SAFE_FRACTION} | known


def angle_map(
    plant: PlantScale, sized_by: str, waves: Sequence[Mapping[str, float]]
) -> tuple[Remedy, ...]:
    """A map of the torque over the drum's angle, fed forward; see `[compensation.angle_map]`.

    Args:
        plant: Words and sizes of the plant.
        sized_by: The parameter that sizes it.
        waves: Of each wave `orders`, `phase_rad`, and `torque_Nm` or `load_share`.
    """
    table: dict[str, Any] = {key: [wave[key] for wave in waves] for key in waves[0]}
    # The effort acts for one sample after the dead time: in its middle on the average.
    table["lead_s"] = plant.dead_time_s + 0.5 / plant.sampling_Hz
    table |= {"zero": "absolute", "fraction": SAFE_FRACTION}
    harm = (
        "a zero of the encoder that moves by a sixth of a period makes it worse than without: the "
        "encoder must be absolute or indexed; zero_rad is what it reads where the cable is just "
        "taut; it gains most where the far end moves, which no trial shows"
    )
    title = "feed a map over the drum's angle forward"
    return (in_loop(plant, title, sized_by, ("angle_map", table), harm),)


NOTCH_HARM = "its lag below the notch costs phase margin: keep the gains' limits, or tune anew"
"""What a notch in the measurement may harm."""


def recalibrate(title: str, sized_by: str) -> Remedy:
    """A number of a calibration, which then takes the effect away."""
    return Remedy(Place.CALIBRATION, title, sized_by=sized_by, removes=1.0)


def workshop(title: str, sized_by: str = "", removes: float = 0.0) -> Remedy:
    """A mechanical or electrical remedy."""
    return Remedy(Place.WORKSHOP, title, sized_by=sized_by, removes=removes)


def limit(title: str) -> Remedy:
    """A limit of what tuning can reach."""
    return Remedy(Place.LIMIT, title)
