"""Whether a loop needs a short multisine on its setpoint to be known, and how large a one.

Step trials hardly excite what lies above their crossover. With gains of controller C_0 and a
setpoint of power |r|^2 in each bin of the spectrum, the effort is u = H r, and the noise hides an
error of the plant of two standard deviations s = noise/(|H r| sqrt(bins)) (`plant_error`). Its
share of |1 + L| with other gains, of controller C, is

    |C| 2 s/|1 + L|,

so the setpoint that makes the largest share as small as wanted follows from the loop model. Where
both gains are one and neither filter acts it is 2 noise/(r sqrt(bins)), whatever the plant is.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.margins import loop_response
from estune.loop_model.model import close_loop
from estune.loop_model.near_fit import lacks_excitation
from estune.loop_model.plant_error import (
    DEVIATIONS,
    HALF_WIDTH,
    BandPowers,
    ErrorMargin,
    PlantErrorBound,
    band_powers,
    error_margin,
)
from estune.loop_model.records import LoopRecord

SHARE_WANTED = 0.005
"""Largest share of |1 + L| that the noise may hide after an excitation: it adds 0.5 % to Ms."""

ENOUGH = 0.02
"""Share by which the end of Ms may exceed the model's before an excitation is worth a trial, where
it is not known what that costs."""

DEAR = 0.01
"""Price of caution, as a share of the optimum's cost, above which one is where that is known."""

PAYS = 0.1
"""Share of the distance that the plant's error may take off |1 + L| which a further excitation has
to give back."""


class UnknownLoop(NamedTuple):
    """A loop to be known, and the gains at which its plant can be excited.

    Attributes:
        tried: Gains of a safe trial.
        price: Logarithm of the cost of gains that keep a margin for what is not known, over that
            of the model's optimum within the limits; None where it is not known.
    """

    fit: LoopFit
    records: Sequence[LoopRecord]
    gains: Gains
    tried: Gains
    controller: ControllerSettings
    price: float | None = None

    @property
    def excited_at(self) -> Gains:
        """The gains tried, without the filter of the setpoint: stability does not depend on it."""
        return replace(self.tried, setpoint_filter_s=0.0)

    @property
    def powers(self) -> BandPowers:
        """Powers of the records, by which the plant's error is bounded."""
        return band_powers(self.fit, self.records)

    def margin(self, error: PlantErrorBound) -> ErrorMargin:
        """What a bound of the plant's error leaves of the loop in question."""
        return error_margin(self.fit, error, self.gains, self.controller)

    @property
    def is_known(self) -> bool:
        """Whether more excitation would not tell more about Ms."""
        if lacks_excitation(self.fit, self.records, self.gains, self.tried):
            return False
        margin = self.margin(self.powers.bound())
        if margin.unknown is not None:
            return margin.excited
        if self.price is not None:
            return self.price <= DEAR
        return (1.0 + ENOUGH) * margin.distance >= self.distance

    @property
    def distance(self) -> float:
        """Least |1 + L| by the model."""
        loop = loop_response(self.fit.model, self.gains, self.controller).loop
        return float(np.min(np.abs(1.0 + loop)))

    def pays(self, after: ErrorMargin) -> bool:
        """Whether a trial takes enough of a margin that is known to be dear, or all of it."""
        if self.price is None:
            return after.unknown is None
        now = self.margin(self.powers.bound()).distance
        return after.distance - now >= PAYS * (self.distance - now)


def wanted_setpoint(
    unknown: UnknownLoop, samples: int, lowest: float = 0.0, highest: float = math.pi
) -> float:
    """Setpoint of white power that makes the loop known, as its root mean square.

    Infinite where one of the loops is unstable by the model.

    Args:
        samples: Length of the multisine.
        lowest: Frequency from which the loop is to be known by it, rad/sample.
        highest: Frequency up to which it is.
    """
    fit, controller = unknown.fit, unknown.controller
    lowest = max(lowest, 2.0 * math.pi / samples)
    theta, C, loop, stable = loop_response(fit.model, unknown.gains, controller)
    at = close_loop(fit.model, unknown.excited_at, controller)
    if not (stable and loop_response(fit.model, unknown.excited_at, controller).stable):
        return math.inf
    inside = (theta >= lowest) & (theta <= highest)
    theta, weight = theta[inside], np.abs(C[inside] / (1.0 + loop[inside]))
    later = np.exp(-1j * theta)
    to_effort = np.polyval(at.to_effort[::-1], later) / np.polyval(at.characteristic[::-1], later)
    bins = np.maximum(HALF_WIDTH * theta * samples / math.pi, 1.0)
    hidden = DEVIATIONS * fit.noise_std * weight / (np.abs(to_effort) * np.sqrt(bins))
    return float(hidden.max()) / SHARE_WANTED


def deviations(unknown: UnknownLoop, setpoint: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deviations of measurement and effort for one of the setpoint, each of shape (samples,)."""
    loop = close_loop(unknown.fit.model, unknown.excited_at, unknown.controller)
    return loop.setpoint_response(setpoint)
