"""Dead time of the drive."""

import math
from dataclasses import dataclass
from typing import Any

from plants.effects.effect import Effect, Port, Values
from plants.effects.parameter import Share, parameter
from plants.effects.plant_scale import PlantScale, digits, si
from plants.effects.remedy import limit, workshop


@dataclass(frozen=True)
class DeadTime(Effect):
    """Dead time between command and torque on top of the reel's own: `i(t) = u(t - d - d_reel)`.

    It lengthens the reel's dead time, of which fractions of a sample are exact. The lag of a
    current loop much faster than the sampling counts as dead time.

    Attributes:
        delay_s: The dead time d added, s.
    """

    name = "dead_time"
    title = "dead time of the drive"
    appearance = (
        "everything comes late by the same time: the phase lags in proportion to the "
        "frequency, whatever gain and level"
    )
    excitation = "fast changes of the command, as in a multisine"
    family = "delay of the drive"
    port = Port.ACTUATOR
    plain_remedies = (
        workshop("shorten the exchange with drive and gauge", "delay_s", 1.0),
        limit("each sample of dead time costs bandwidth, whatever the gains"),
    )

    delay_s: float = parameter(
        1e-3,
        low=0.0,
        unit="s",
        neutral=0.0,
        start=Share(0.6, "sample_s"),
        between=(Share(0.0), Share(0.25, "record_s")),
        least=(Share(0.2, "sample_s"),),
    )

    @classmethod
    def describe(cls, p: Values, plant: PlantScale) -> str:
        d, samples = p.delay_s, p.delay_s * plant.sampling_Hz
        counted = "" if math.isnan(samples) else f", {samples:.3g} samples,"
        return (
            f"has dead time that the model lacks: every command acts {si(d, 's')}{counted} later, "
            f"which takes {digits(3600.0 * d)} degrees of phase at 10 Hz"
        )

    @staticmethod
    def amend(p: Values, reel: Values) -> dict[str, Any]:
        return {"dead_time_s": reel.dead_time_s + p.delay_s}
