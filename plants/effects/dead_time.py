"""Dead time of the drive."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

from plants.effects.effect import Effect, Port, parameter


@dataclass(frozen=True)
class DeadTime(Effect):
    """Dead time between command and torque on top of the reel's own: `i(t) = u(t - d - d_reel)`.

    It lengthens the reel's dead time, of which fractions of a sample are exact.

    Attributes:
        delay_s: The dead time d added, s.
    """

    name: ClassVar[str] = "dead_time"
    title: ClassVar[str] = "dead time of the drive"
    appearance: ClassVar[str] = (
        "everything comes late by the same time: the phase lags in proportion to the frequency "
        "while gain and tension level play no part"
    )
    port: ClassVar[Port] = Port.ACTUATOR

    delay_s: float = parameter(1e-3, low=0.0, high=0.05, unit="s", neutral=0.0)

    @staticmethod
    def amend(p: SimpleNamespace, reel: SimpleNamespace) -> dict[str, Any]:
        """The dead time of reel and effect together."""
        return {"dead_time_s": reel.dead_time_s + p.delay_s}
