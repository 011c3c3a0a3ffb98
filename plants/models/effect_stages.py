"""The effects of one plant as stages along the signal's path."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import casadi as ca

from plants.effects.effect import Effect, Port, Site
from plants.simulation.equations import Expression


class _Stage(NamedTuple):
    """One effect: its parameters and prepared constants, and its slice of the state."""

    effect: type[Effect]
    p: SimpleNamespace
    own: slice


class EffectStages:
    """The effects of one plant, evaluated port by port.

    Args:
        effects: In the order in which the signal meets them.
        numbers: For each effect its parameters and prepared constants, by name.
        first_state: Index in the state at which the effects' states begin.
    """

    def __init__(
        self, effects: tuple[type[Effect], ...], numbers: list[dict[str, Any]], first_state: int
    ) -> None:
        self._stages: list[_Stage] = []
        for effect, values in zip(effects, numbers, strict=True):
            own = slice(first_state, first_state + effect.states)
            self._stages.append(_Stage(effect, SimpleNamespace(**values), own))
            first_state += effect.states
        self.states = first_state

    def forward(
        self, x: Expression, signal: Expression, site: Site
    ) -> tuple[Expression, Expression]:
        """State and signal after the effects of the site's port."""
        for effect, p, own in self._at(site.port):
            memory, signal = effect.respond(p, x[own, :], signal, site)
            x = _with_slice(x, own, memory)
        return x, signal

    def drum_torque(
        self, x: Expression, site: Site, velocity_per_torque: Expression
    ) -> tuple[Expression, Expression]:
        """State, and the effects' torque at the drum; each effect sees the sum of those before it.

        Args:
            site: With the velocity at the end of the span if no effect gave a torque.
            velocity_per_torque: Velocity at the end of the span per torque held over it.
        """
        torque = ca.SX(0.0)
        for effect, p, own in sorted(self._at(Port.DRUM), key=_drum_order):
            memory, added = effect.respond(p, x[own, :], torque, site)
            x = _with_slice(x, own, memory)
            torque = torque + added
            velocity = site.velocity_rad_s + velocity_per_torque * added
            friction = site.friction_Nm + added if effect.resists else site.friction_Nm
            site = site._replace(velocity_rad_s=velocity, friction_Nm=friction)
        return x, torque

    def inverse(
        self, x: Expression, signal: Expression, site: Site, *, keep_memory: bool = False
    ) -> tuple[Expression, Expression]:
        """State at rest, and the port's input for a steady output.

        Args:
            signal: The port's output.
            site: The port and its conditions.
            keep_memory: Whether the effects start from their present states instead of zero.
        """
        for effect, p, own in reversed(list(self._at(site.port))):
            memory = x[own, :] if keep_memory else ca.SX.zeros(effect.states)
            memory, signal = effect.rest(p, memory, signal, site)
            x = _with_slice(x, own, memory)
        return x, signal

    def rest_torque(self, x: Expression, site: Site) -> tuple[Expression, Expression]:
        """State at rest, and the effects' torque at the drum there."""
        torque = ca.SX(0.0)
        for effect, p, own in self._at(Port.DRUM):
            memory, added = effect.rest(p, ca.SX.zeros(effect.states), torque, site)
            x = _with_slice(x, own, memory)
            torque = torque + added
        return x, torque

    def place(self, x: Expression, angle_rad: Expression) -> Expression:
        """State after the drum has been placed at an angle."""
        for effect, p, own in self._stages:
            x = _with_slice(x, own, effect.put(p, x[own, :], angle_rad))
        return x

    def _at(self, port: Port) -> Iterator[_Stage]:
        return (stage for stage in self._stages if port in stage.effect.ports())


def _drum_order(stage: _Stage) -> tuple[bool, bool]:
    return stage.effect.divides, stage.effect.resists


def _with_slice(x: Expression, own: slice, memory: Expression) -> Expression:
    # Both indices: x[1:] of a single row is a row without columns, which vertcat counts as one.
    return ca.vertcat(x[: own.start, :], memory, x[own.stop :, :])
