"""Localisation of the base model's residual: block, variable it follows, frequency band.

Only the base-model parameters in which the balances are linear are fitted, no effect.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import NoiseFloor
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.balance import (
    Equation,
    Record,
    Signals,
    equations,
    smoother_for,
)
from plants.diagnosis.residual.dependence import (
    Fit,
    ResidualDependence,
    Variable,
    crossed,
    over_frequency,
    strongest,
    views,
)
from plants.diagnosis.residual.residuals import (
    BalanceFit,
    fit_balance,
    prepared,
    spectrum,
    variables,
    widest_s,
)

__all__ = ["Block", "ResidualDependence", "ResidualLocation", "localise"]

READING = "gauge's reading"


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The residual of one balance of a model.

    Attributes:
        name: `force` (torque balance at the drum), `gauge` (cable and gauge), `eyelet`,
            `actuator`, or `plant` where there is one balance only.
        rms: Root mean square of the residual.
        noise_rms: That of noise and allowance alone.
        smoothing_s: Width of the Gaussian that smoothed all terms.
        low_Hz: Lower end of the band with the middle 90 % of the residual above the noise.
        views: Dependence on variables, strongest first.
        frequency_Hz: Frequencies of the spectrum, shape (lines,).
        power: Power spectral density of the residual, unit^2/Hz, same shape.
        noise_power: That of noise alone, same shape.
        residual: Per measurement, shape (samples,); nan where undefined.
    """

    name: str
    title: str
    unit: str
    rms: float
    noise_rms: float
    smoothing_s: float
    low_Hz: float
    high_Hz: float
    views: tuple[ResidualDependence, ...]
    frequency_Hz: FloatArray
    power: FloatArray
    noise_power: FloatArray
    residual: tuple[FloatArray, ...]

    @property
    def ratio(self) -> float:
        """Residual relative to that of noise and allowance alone."""
        # Of records in which nothing is commanded and nothing moves both are zero.
        return self.rms / self.noise_rms if self.rms > 0.0 else 0.0

    @property
    def is_above_noise(self) -> bool:
        """Whether it exceeds what a complete model may leave, and is to be reported."""
        return self.ratio**2 > CONSTANTS.floor

    @property
    def regime(self) -> ResidualDependence | None:
        """The variable the residual follows, or None where it follows none."""
        view = strongest(self.views)
        return view if view.share >= CONSTANTS.small else None

    @property
    def band(self) -> str:
        """The band in words."""
        if not self.high_Hz > 0.0:
            return ""
        if self.low_Hz <= self.frequency_Hz[1]:
            return f"below {self.high_Hz:.2g} Hz"
        if self.high_Hz >= self.frequency_Hz[-2]:
            return f"above {self.low_Hz:.2g} Hz"
        return f"between {self.low_Hz:.2g} and {self.high_Hz:.2g} Hz"

    def to_json(self) -> dict[str, Any]:
        """JSON values, without the arrays."""
        return {
            "block": self.name,
            "unit": self.unit,
            "rms": self.rms,
            "noise_rms": self.noise_rms,
            "ratio": self.ratio,
            "regime": None if self.regime is None else self.regime.name,
            "band": self.band,
            "band_Hz": [self.low_Hz, self.high_Hz],
            "shares": {view.name: view.share for view in self.views},
        }


@dataclass(frozen=True, slots=True, eq=False)
class ResidualLocation:
    """Localisation of what a model leaves.

    Attributes:
        blocks: The blocks that the channels allow, the one furthest above its noise first.
        sentence: The main findings in words.
    """

    blocks: tuple[Block, ...]
    sentence: str

    def to_json(self) -> dict[str, Any]:
        """JSON values, without the arrays."""
        first = self.blocks[0].to_json() if self.blocks else {}
        return {
            **{key: first.get(key) for key in ("block", "regime", "band")},
            "sentence": self.sentence,
            "blocks": [block.to_json() for block in self.blocks],
        }


def localise(
    measurements: Sequence[MeasuredRecord],
    numbers: Sequence[BaseNumbers | None],
    floor: NoiseFloor,
    runs: Sequence[Signals] | None = None,
) -> ResidualLocation:
    """Localises what a model leaves unexplained.

    Args:
        numbers: Numbers of the model, without its effects, at each record.
        runs: Channels of each record as the model with its effects has them: what these leave of
            a balance is not unexplained. None for a model without.
    """
    records = prepared(measurements, numbers, floor, runs)
    best: dict[str, Block] = {}
    if records:
        motion = variables(records)
        channels = frozenset.intersection(*(frozenset(r.signals) for r in records))
        for equation in equations(records[0].numbers, channels):
            block = _block(equation, records, motion)
            if block is not None and (
                equation.name not in best or block.rms < best[equation.name].rms
            ):
                best[equation.name] = block
    blocks = _responsible(list(best.values()), records[0].measurement.sampling_Hz) if best else []
    model = "refitted model" if runs is None else "model with the effects"
    return ResidualLocation(tuple(blocks), _of_blocks(blocks, model))


def _block(
    equation: Equation, records: Sequence[Record], motion: Sequence[Variable]
) -> Block | None:
    rate = records[0].measurement.sampling_Hz
    smoother = smoother_for(equation, records, rate, widest_s(records))
    fitted = fit_balance(equation, records, smoother)
    inside = np.isfinite(fitted.residual) & np.isfinite(fitted.noise)
    for variable in motion:
        if variable.name in ("velocity", "command rate"):
            inside &= np.isfinite(variable.of)
    if equation.smooth:
        # Each record is smoothed at its own rate, and what may explain it at the first one's.
        spans = (np.ones(r.measurement.samples) for r in records)
        inside &= np.isfinite(np.concatenate([smoother.sampled(one, 1.0) for one in spans]))
    if inside.sum() < CONSTANTS.fewest:
        return None
    ends = np.cumsum([r.measurement.samples for r in records])[:-1]
    each = np.split(fitted.residual, ends)
    frequency, power = spectrum(each, rate)
    _, noise_power = spectrum(np.split(fitted.noise, ends), rate)
    low_Hz, high_Hz = _band(frequency, np.maximum(power - noise_power, 0.0))
    if equation.name == "force":
        motion = [*motion, *_loads(fitted.carried, motion)]
    listed = views(_dependence(equation, smoother, fitted, inside, ends), motion, fitted.slope)
    signal, of_noise = (np.split(one, ends) for one in (fitted.carried, fitted.noise_carried))
    response = over_frequency(each, signal, of_noise, rate)
    listed += [] if response is None else [response]
    allowance = CONSTANTS.allowance * float((fitted.carried + fitted.residual)[inside].std())
    return Block(
        name=equation.name,
        title=equation.title,
        unit=equation.unit,
        rms=float(np.sqrt(np.mean(fitted.residual[inside] ** 2))),
        noise_rms=float(np.sqrt(np.mean(fitted.noise[inside] ** 2) + allowance**2)),
        smoothing_s=smoother.width_s,
        low_Hz=low_Hz,
        high_Hz=high_Hz,
        views=tuple(sorted(listed, key=lambda view: -view.share)),
        frequency_Hz=frequency,
        power=power,
        noise_power=noise_power,
        residual=tuple(each),
    )


def _dependence(
    equation: Equation,
    smoother: Smoother,
    fitted: BalanceFit,
    inside: NDArray[np.bool_],
    ends: NDArray[np.int64],
) -> Fit:
    stride = max(1, int(inside.sum() // CONSTANTS.screened))
    chosen = np.flatnonzero(inside)[::stride]
    sizes = np.diff([0, *ends, fitted.residual.size])
    # Dealt out in turn, so that every part has some of each record, and of all its time.
    stretch = [n + np.arange(size) * CONSTANTS.stretches // size for n, size in enumerate(sizes)]

    def spread(columns: FloatArray) -> FloatArray:
        split = np.split(columns, ends)
        return np.vstack([np.column_stack([smoother.sampled(c, 1.0) for c in p.T]) for p in split])

    return Fit(
        residual=fitted.residual[chosen],
        basis=np.linalg.qr(fitted.columns[chosen])[0],
        chosen=chosen,
        fold=np.concatenate(stretch)[chosen] % CONSTANTS.folds,
        spread=spread if equation.smooth else np.asarray,
    )


def _loads(carried: FloatArray, motion: Sequence[Variable]) -> list[Variable]:
    """What a drive carries by size, alone and in each direction; none where tension is known."""
    if any(variable.name == "tension" for variable in motion):
        return []
    load = np.abs(carried)
    way = next(v.label for v in motion if v.label is not None and v.name == "velocity sign")
    cells = crossed(way, load)
    return [
        Variable("load", "N m", load),
        Variable("velocity sign and load", "N m", load, cells),
    ]


def _responsible(blocks: Sequence[Block], sampling_Hz: float) -> list[Block]:
    """The blocks, first the one that contains the cause of residuals in the others.

    The gauge's reading is in the force and the gauge balance: an error of the reading shows in
    both with opposite signs, an error of the cable in the gauge block alone. Eyelet friction shows
    against the gauge outside and against the cable.
    """
    ordered = sorted(blocks, key=lambda block: -block.ratio)
    by_name = {block.name: block for block in blocks}
    force, gauge, eyelet = (by_name.get(name) for name in ("force", "gauge", "eyelet"))
    if gauge is None or not ordered[0].is_above_noise:
        return ordered
    if (
        eyelet is not None
        and eyelet.is_above_noise
        and _signed_R2(gauge, eyelet, sampling_Hz) > 0.5
    ):
        return [eyelet, *(block for block in ordered if block is not eyelet)]
    if force is not None and force.is_above_noise:
        if _signed_R2(force, gauge, sampling_Hz) < -0.5:
            others = [block for block in ordered if block not in (force, gauge)]
            return [replace(gauge, title=READING), *others, force]
    elif force is not None:
        return [replace(b, title="cable") if b is gauge else b for b in ordered]
    return ordered


def _signed_R2(block: Block, explaining: Block, sampling_Hz: float) -> float:
    """Share of a block's residual that another's explains, with the sign of the slope."""
    smoother = Smoother(block.smoothing_s, sampling_Hz)
    x = np.concatenate(block.residual)
    y = np.concatenate(
        [smoother.sampled(np.nan_to_num(residual), 1.0) for residual in explaining.residual]
    )
    both = np.isfinite(x) & np.isfinite(y)
    rho = float(np.corrcoef(x[both], y[both])[0, 1])
    return math.copysign(rho**2, rho)


def _band(frequency: FloatArray, power: FloatArray) -> tuple[float, float]:
    """The band with the middle 90 % of a power, Hz; zeros without power."""
    total = np.cumsum(power)
    if not total[-1] > 0.0:
        return 0.0, 0.0
    low, high = np.searchsorted(total / total[-1], [0.05, 0.95])
    return float(frequency[low]), float(frequency[min(high, frequency.size - 1)])


_VARIABLES = {
    "velocity sign": "the direction of motion, as dry friction does",
    "velocity sign and tension": "the direction of motion and the tension, as friction in an "
    "eyelet does",
    "velocity sign and load": "the direction of motion and the load, as friction in a gear does",
    "velocity": "speed and direction",
    "position period": "the position",
    "time": "time, as a drift or warming does",
    "frequency": "frequency, as of a mode, a lag or a delay",
}
"""Variables that a residual depends on, where their names say too little."""


def _of_blocks(blocks: Sequence[Block], model: str) -> str:
    if not blocks:
        return "The model's equations cannot be balanced against these channels."
    first = blocks[0]
    if not first.is_above_noise:
        return (
            f"The {model} leaves nothing unexplained above the noise; the largest residual "
            f"is in the {first.title}, {first.ratio:.2g} times the noise."
        )
    sentence = f"What the {model} leaves unexplained in the {first.title} is "
    sentence += f"{first.ratio:.2g} times "
    sentence += f"the noise, mostly {first.band}. " if first.band else "the noise. "
    regime = first.regime
    if regime is None:
        sentence += "It depends on no single variable."
    else:
        detail = f" with a period of {regime.detail}" if regime.detail else ""
        on = _VARIABLES.get(regime.name, f"the {regime.name}")
        sentence += f"{100.0 * regime.share:.0f} % of it depends only on {on}{detail}."
    # The other block with the same cause is not reported again.
    shown = {READING: "force", "eyelet": "gauge"}.get(first.title)
    separate = [b for b in blocks[1:] if b.name != shown]
    others = [f"the {b.title} at {b.ratio:.2g} times" for b in separate if b.is_above_noise]
    return sentence + (f" Also above the noise: {', '.join(others)}." if others else "")
