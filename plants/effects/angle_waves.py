"""Torques that are waves over the angle of the drum."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from plants.effects.angle_phase import STATES, advance_angle, encode_angle
from plants.effects.effect import Effect, Port, Response, Signal, Site, Values

Wave = tuple[Signal, Signal, Signal]
"""Amplitude A, N m, periods N in a turn, and phase phi, rad."""


@dataclass(frozen=True)
class AngleWaves(Effect):
    """A torque of waves, each of `STATES` states: `tau = -sum A_k sin(N_k theta + phi_k)`."""

    port = Port.DRUM

    @staticmethod
    @abstractmethod
    def waves(p: Values) -> Sequence[Wave]:
        """The waves by the parameters, in the order of their states."""

    @classmethod
    def respond(cls, p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        return cls._torque(p, state, site.angle_rad, advance_angle)

    @classmethod
    def rest(cls, p: Values, state: Signal, _signal: Signal, site: Site) -> Response:
        return cls._torque(p, state, site.angle_rad, lambda _, angle: encode_angle(angle))

    @classmethod
    def put(cls, p: Values, _state: Signal, angle_rad: Signal) -> Signal:
        return ca.vertcat(*(encode_angle(n * angle_rad + phi) for _, n, phi in cls.waves(p)))

    @classmethod
    def _torque(
        cls, p: Values, state: Signal, angle_rad: Signal, moved: Callable[[Signal, Signal], Signal]
    ) -> Response:
        """The phases after the motion to an angle, and the torque there."""
        after, torque = [], 0.0
        for k, (size, periods, phi) in enumerate(cls.waves(p)):
            phase = moved(state[k * STATES : (k + 1) * STATES], periods * angle_rad + phi)
            after.append(phase)
            torque = torque - size * phase[0]
        return ca.vertcat(*after), torque
