"""Laws that act as a torque: the terms of the balance that each is made of, and its values."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.result import family_of
from plants.diagnosis.torque_balance.balance import (
    COSINE,
    COULOMB,
    DRAG,
    SINE,
    SPEED,
    TorqueBalance,
)
from plants.effects import (
    BentViscousFriction,
    CoulombFriction,
    DirectionalFriction,
    Effect,
    LinkGravity,
    LoadFriction,
    StribeckFriction,
)

Sizes = Mapping[str, float]
Values = dict[str, float]


class TorqueLaw(NamedTuple):
    """A law, or a curve without a name.

    Attributes:
        effect: The effect that it stands for; None of a curve without a name.
        family: Laws that do the same in more or less detail.
        variable: What its torque depends on: velocity, angle or load.
        columns: Terms of the balance, each with a size that is fitted.
        positive: Those of them whose size is above zero.
        values: Parameters of the effect from the sizes of its terms.
    """

    effect: type[Effect] | None
    title: str
    family: str
    variable: str
    columns: tuple[str, ...]
    positive: tuple[str, ...] = ()
    values: Callable[[Sizes], Values] = dict


VELOCITY, ANGLE = "velocity", "angle"
LOAD = "load"
"""The share of the load among the sizes of a fit."""


def _gravity(sizes: Sizes) -> Values:
    sine, cosine = sizes[SINE], sizes[COSINE]
    return {
        "torque_Nm": float(np.hypot(sine, cosine)),
        "phase_rad": float(np.arctan2(cosine, sine)),
    }


def _stribeck(fading: str, speed_rad_s: float) -> Callable[[Sizes], Values]:
    def values(sizes: Sizes) -> Values:
        return {
            "coulomb_Nm": sizes[COULOMB],
            "excess_Nm": sizes[fading],
            "stribeck_rad_s": speed_rad_s,
        }

    return values


def _law(
    effect: type[Effect],
    variable: str,
    columns: tuple[str, ...],
    values: Callable[[Sizes], Values],
    *,
    positive: bool = False,
) -> TorqueLaw:
    above = columns if positive else ()
    family = family_of(effect)
    return TorqueLaw(effect, effect.title, family, variable, columns, above, values)


def laws(balance: TorqueBalance, effects: Sequence[type[Effect]]) -> tuple[TorqueLaw, ...]:
    """The laws of some effects that a balance may show; none of the sign of a one-way motion."""
    listed = [
        _law(BentViscousFriction, VELOCITY, (DRAG,), lambda sizes: {"bend_Nms2": sizes[DRAG]})
    ]
    if balance.both_ways:
        listed += [
            _law(
                *(CoulombFriction, VELOCITY, (COULOMB,)),
                lambda sizes: {"torque_Nm": sizes[COULOMB]},
                positive=True,
            ),
            _law(
                *(LoadFriction, LOAD, (LOAD,)),
                lambda sizes: {"load_share": sizes[LOAD]},
                positive=True,
            ),
            _law(
                *(DirectionalFriction, VELOCITY, (SPEED,)),
                lambda sizes: {"difference_Nms": 2.0 * sizes[SPEED]},
            ),
        ]
        for n, speed in enumerate(balance.scale.fadings_rad_s.tolist()):
            fading = f"fading {n}"
            values = _stribeck(fading, speed)
            columns = COULOMB, fading
            listed.append(_law(StribeckFriction, VELOCITY, columns, values, positive=True))
    if balance.turned_rad >= CONSTANTS.turned_rad:
        listed.append(_law(LinkGravity, ANGLE, (SINE, COSINE), _gravity))
    return tuple(law for law in listed if law.effect in effects)


CHANGING = TorqueLaw(
    None,
    "a dry friction that changes with time",
    CoulombFriction.family,
    VELOCITY,
    tuple(f"time {n}" for n in range(CONSTANTS.time_knots)),
)
"""Dry friction by the time since a record's start, which warms or wears in."""


def curves() -> tuple[TorqueLaw, ...]:
    """Curves without a name: any function of the velocity, and any of the angle."""
    of_velocity = tuple(f"velocity {n}" for n in range(CONSTANTS.velocity_knots))
    of_angle = tuple(f"over angle {n}" for n in range(CONSTANTS.angle_knots))
    return (
        TorqueLaw(None, "a smooth function of the velocity", "", VELOCITY, of_velocity),
        TorqueLaw(None, "a smooth function of the angle", "", ANGLE, of_angle),
    )
