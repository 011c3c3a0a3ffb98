"""The cable and gauge block of the residuals, and the rest of them, the drum's.

A drum that does not move as predicted shows in angle and tension alike, k R newtons a radian. What
is left of the tension beside that is the cable's and the gauge's own. So an effect of the one is
seen under an effect of the other whose law is not quite the machine's.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.prediction.prediction import CHANNELS, Index
from plants.effects import Effect, Port

Numbers = NDArray[np.int64]

Block = Literal["cable", "drum"]
PORTS = {Port.CABLE, Port.EYELET, Port.GAUGE}


class CableBlock(NamedTuple):
    """Entries of the gauge and of the encoder at the same samples.

    Attributes:
        gauge: Places of the gauge's among the entries, shape (pairs,).
        encoder: Places of the encoder's, same shape.
        gauge_weight: sigma_y over that of both.
        encoder_weight: k R sigma_theta over that of both.
    """

    gauge: Numbers
    encoder: Numbers
    gauge_weight: FloatArray
    encoder_weight: FloatArray

    @classmethod
    def of(cls, index: Index, entries: Numbers, pull_N_rad: FloatArray) -> Self | None:
        """The pairs among some entries; None where there are none.

        Args:
            index: What entries stand for.
            entries: Their numbers.
            pull_N_rad: k R of each record, shape (records,).
        """
        if not np.isfinite(pull_N_rad).all():
            return None
        channel, sample = index.channel[entries], index.sample[entries]
        moment = index.measurement[entries] * (int(sample.max(initial=0)) + 1) + sample
        gauge, encoder = (
            np.flatnonzero(channel == CHANNELS.index(name)) for name in ("tension_N", "angle_rad")
        )
        _, first, second = np.intersect1d(
            moment[gauge], moment[encoder], assume_unique=True, return_indices=True
        )
        if not first.size:
            return None
        gauge, encoder = gauge[first], encoder[second]
        mine = index.sigma[entries[gauge]]
        pulled = pull_N_rad[index.measurement[entries[gauge]]] * index.sigma[entries[encoder]]
        both = np.hypot(mine, pulled)
        return cls(gauge, encoder, mine / both, pulled / both)

    def left(self, residuals: FloatArray) -> FloatArray:
        """(y - y^ - k R (theta - theta^))/sigma, sigma^2 = sigma_y^2 + (k R sigma_theta)^2.

        Args:
            residuals: Of the entries, shape (..., entries).

        Returns:
            Shape (..., pairs).
        """
        found: FloatArray = (
            residuals[..., self.gauge] * self.gauge_weight
            - residuals[..., self.encoder] * self.encoder_weight
        )
        return found


class Blocks(NamedTuple):
    """Mean squares of the two blocks; nan without gauge or encoder.

    Attributes:
        cable: Of the cable and gauge block.
        drum: Of the rest: turned into the first, the entries of each pair keep their power.
    """

    cable: float
    drum: float

    @classmethod
    def of(cls, block: CableBlock | None, residuals: FloatArray) -> Self:
        """Of the residuals of the entries that the block was found among."""
        if block is None:
            return cls(np.nan, np.nan)
        left = block.left(residuals)
        power, rest = float(left @ left), residuals.size - left.size
        return cls(power / left.size, (float(residuals @ residuals) - power) / rest)


def pull_N_rad(model: Any, measurements: Sequence[MeasuredRecord]) -> FloatArray:
    """What a model's cable pulls per angle at each record, N/rad; nan without a cable."""
    numbers = [BaseNumbers.of(model, m) for m in measurements]
    return np.array([np.nan if b is None else b.tension_per_angle_N_rad for b in numbers])


def block_of(effect: type[Effect]) -> Block:
    """The block that an effect acts in."""
    return "cable" if PORTS & set(effect.ports()) else "drum"
