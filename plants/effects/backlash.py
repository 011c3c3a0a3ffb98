"""Play between motor and drum."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca

from plants.effects.effect import Effect, Port, Signal, Site, parameter


@dataclass(frozen=True)
class Backlash(Effect):
    """Play in the gear between the motor, which has the encoder, and the drum.

        T = max(l, min(T_before, l + k R b, T_h)),    l = k R theta

    The cable pulls the drum against the motor's side of the gear, down to the tension T_h that the
    drum's own friction holds. Below it the drum stands still while the motor turns through the
    play b. So play shows only near slack.

    Attributes:
        play_rad: The play b at the drum, rad.
        holding_N: Tension T_h that the drum's friction holds, N.
    """

    name: ClassVar[str] = "backlash"
    title: ClassVar[str] = "backlash between motor and drum"
    appearance: ClassVar[str] = (
        "at low tension the angle moves through a gap, either way, while the tension stays"
    )
    port: ClassVar[Port] = Port.CABLE
    states: ClassVar[int] = 1

    play_rad: float = parameter(0.01, low=0.0, high=0.5, unit="rad", neutral=0.0)
    holding_N: float = parameter(3.0, low=0.0, high=50.0, unit="N")

    @staticmethod
    def prepare(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Signal]:
        """The play as a tension of the linear law, N."""
        return {"play_N": p.play_rad * reel.drum_radius_m * reel.stiffness_N_m}

    @staticmethod
    def respond(
        p: SimpleNamespace,
        state: Signal,
        signal: Signal,
        site: Site,  # noqa: ARG004  only the order of angles counts
    ) -> tuple[Signal, Signal]:
        """The tension of the drum's angle, below zero where it is slack."""
        held = ca.fmin(ca.fmin(state, p.holding_N), signal + p.play_N)
        tension = ca.fmax(signal, held)
        return tension, tension

    @staticmethod
    def rest(
        p: SimpleNamespace,  # noqa: ARG004  the gear is closed
        state: Signal,  # noqa: ARG004  it is the tension
        signal: Signal,
        site: Site,  # noqa: ARG004  the same at any angle
    ) -> tuple[Signal, Signal]:
        """The gear closed by the cable's pull."""
        return signal, signal
