"""The stages along the signal's path through a reel, with the effects that sit at each."""

from collections.abc import Iterable, Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import casadi as ca

from plants.effects.effect import Effect, Port, Site
from plants.simulation.equations import Expression


def amended(
    reel: SimpleNamespace, effects: Iterable[tuple[type[Effect], SimpleNamespace]]
) -> SimpleNamespace:
    """A reel's own numbers as its effects leave them; the effects come with their parameters."""
    changed = SimpleNamespace(**vars(reel))
    for effect, p in effects:
        vars(changed).update(effect.amend(p, changed))
    return changed


class Place(NamedTuple):
    """One effect within a reel: its numbers, and which part of the reel's state is its own."""

    effect: type[Effect]
    p: SimpleNamespace
    own: slice


class Stages:
    """The effects of one reel, visited port by port."""

    def __init__(
        self, effects: tuple[type[Effect], ...], numbers: list[dict[str, Any]], first_state: int
    ) -> None:
        """Gives each effect its part of the state.

        Args:
            effects: In the order in which the signal meets them.
            numbers: For each the parameters and what it prepared, by name.
            first_state: Where in the state the effects' parts begin.
        """
        self._places: list[Place] = []
        for effect, known in zip(effects, numbers, strict=True):
            own = slice(first_state, first_state + effect.states)
            self._places.append(Place(effect, SimpleNamespace(**known), own))
            first_state += effect.states
        self.states = first_state

    def forward(
        self, x: Expression, signal: Expression, site: Site
    ) -> tuple[Expression, Expression]:
        """State and signal after the effects of the site's port."""
        for effect, p, own in self._at(site.port):
            remembered, signal = effect.respond(p, x[own, :], signal, site)
            x = _with(x, own, remembered)
        return x, signal

    def torque(
        self, x: Expression, site: Site, velocity_per_torque: Expression
    ) -> tuple[Expression, Expression]:
        """State, and torque that effects add at the drum, each seeing what the others leave.

        Args:
            x: The state.
            site: With the velocity the span would end with if no effect gave a torque.
            velocity_per_torque: Velocity at the end of the span per torque held over it.
        """
        torque = ca.SX(0.0)
        for effect, p, own in sorted(self._at(Port.DRUM), key=_turn):
            remembered, added = effect.respond(p, x[own, :], torque, site)
            x = _with(x, own, remembered)
            torque = torque + added
            velocity = site.velocity_rad_s + velocity_per_torque * added
            friction = site.friction_Nm + added if effect.resists else site.friction_Nm
            site = site._replace(velocity_rad_s=velocity, friction_Nm=friction)
        return x, torque

    def back(
        self, x: Expression, signal: Expression, site: Site, *, moved: bool = False
    ) -> tuple[Expression, Expression]:
        """State at rest, and what goes into the site's port when the signal steadily comes out.

        Args:
            x: The state.
            signal: What comes out.
            site: Where and when.
            moved: Whether the reel is only put elsewhere, and effects know what they remember.
        """
        for effect, p, own in reversed(list(self._at(site.port))):
            state = x[own, :] if moved else ca.SX.zeros(effect.states)
            remembered, signal = effect.rest(p, state, signal, site)
            x = _with(x, own, remembered)
        return x, signal

    def rest_torque(self, x: Expression, site: Site) -> tuple[Expression, Expression]:
        """State at rest, and torque that effects then add at the drum."""
        torque = ca.SX(0.0)
        for effect, p, own in self._at(Port.DRUM):
            remembered, added = effect.rest(p, ca.SX.zeros(effect.states), torque, site)
            x = _with(x, own, remembered)
            torque = torque + added
        return x, torque

    def put(self, x: Expression, angle_rad: Expression) -> Expression:
        """State of a drum that is put at an angle, with what the effects then remember."""
        for effect, p, own in self._places:
            x = _with(x, own, effect.put(p, x[own, :], angle_rad))
        return x

    def _at(self, port: Port) -> Iterator[Place]:
        return (place for place in self._places if port in place.effect.ports())


def _turn(place: Place) -> tuple[bool, bool]:
    """Where in the order of effects at the drum one comes."""
    return place.effect.divides, place.effect.resists


def _with(x: Expression, own: slice, remembered: Expression) -> Expression:
    """The state with one effect's part renewed."""
    # Both indices: x[1:] of a single row is a row without columns, which vertcat counts as one.
    return ca.vertcat(x[: own.start, :], remembered, x[own.stop :, :])
