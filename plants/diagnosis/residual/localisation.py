"""Where the residual of the base model lives: which block, which regime, which band.

Nothing is fitted here but the calibrations in which the balances are linear; no effect is.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise_floor import ALLOWANCE, NoiseFloor
from plants.diagnosis.data.smoothing import Smoother
from plants.diagnosis.models.base import BaseNumbers
from plants.diagnosis.residual.balance import Equation, equations, smoother_for
from plants.diagnosis.residual.dependence import (
    Fit,
    ResidualDependence,
    independent_share,
    strongest,
    views,
)
from plants.diagnosis.residual.distortion import Distortion, distortions
from plants.diagnosis.residual.residuals import (
    FEWEST,
    BalanceFit,
    Record,
    fit_balance,
    inner,
    prepared,
    regime_of,
    spectrum,
    widest_s,
)

__all__ = ["Block", "Distortion", "ResidualDependence", "ResidualLocation", "localise"]

MIDDLE = 0.9
"""Share of the residual's power that its band holds."""
ABOVE = 1.2
"""A block is worth naming from so many times its noise, which is known to some ten per cent."""
WORTH = 0.1
"""A variable is worth naming that explains so much of the residual."""
ALIKE = 0.4
"""Share of a block that another must explain for it to be the one in doubt."""
READING = "gauge's reading"
MOST = 12_000
"""Samples that the views look at; of longer records every so manieth is taken."""
FREE_LINES_dB = 6.0
"""Distortion is worth naming that is so far above the noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The residual of one balance of the base model.

    Attributes:
        name: `force` (torque balance at the drum), `gauge` (cable and gauge), `eyelet`,
            `actuator`, or `plant` where there is one balance only.
        title: The same in plain words.
        unit: Unit of the residual.
        rms: Its root mean square.
        noise_rms: What noise and allowance alone would give.
        smoothing_s: Width of the Gaussian that all terms were smoothed with.
        low_Hz: Lower end of the band that holds the middle 90 % of the residual above the noise.
        high_Hz: Upper end of it.
        views: Strongest first.
        frequency_Hz: Of the spectrum, shape (lines,).
        power: Power spectral density of the residual, unit^2/Hz, same shape.
        noise_power: What noise alone would give, same shape.
        residual: Per measurement, shape (samples,); nan where it is not known.
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
        """Residual over what noise and allowance alone would give."""
        return self.rms / self.noise_rms

    @property
    def regime(self) -> ResidualDependence | None:
        """The variable the residual follows, or None where it follows none."""
        found = strongest(self.views)
        return found if found.share >= WORTH else None

    @property
    def band(self) -> str:
        """The band in words."""
        if not self.high_Hz > 0.0:
            return ""
        if self.low_Hz <= self.frequency_Hz[1]:
            return f"below {self.high_Hz:.2g} Hz"
        if self.high_Hz >= 0.9 * self.frequency_Hz[-1]:
            return f"above {self.low_Hz:.2g} Hz"
        return f"between {self.low_Hz:.2g} and {self.high_Hz:.2g} Hz"

    def to_json(self) -> dict[str, Any]:
        """Its figures as JSON values, without the arrays."""
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
    """Where the residual of the base model lives.

    Attributes:
        blocks: The blocks that the channels allow, the one furthest above its noise first.
        distortion: One entry per periodic record and channel.
        sentence: The strongest of it in words.
    """

    blocks: tuple[Block, ...]
    distortion: tuple[Distortion, ...]
    sentence: str

    def to_json(self) -> dict[str, Any]:
        """Block, regime and band as JSON values, the arrays left out."""
        first = self.blocks[0].to_json() if self.blocks else {}
        return {
            **{key: first.get(key) for key in ("block", "regime", "band")},
            "sentence": self.sentence,
            "blocks": [block.to_json() for block in self.blocks],
            "distortion": [
                {
                    "source": d.source,
                    "channel": d.channel,
                    "even_dB": d.even_dB,
                    "odd_dB": None if math.isnan(d.odd_dB) else d.odd_dB,
                }
                for d in self.distortion
            ],
        }


def localise(
    measurements: Sequence[MeasuredRecord],
    numbers: Sequence[BaseNumbers | None],
    floor: NoiseFloor,
) -> ResidualLocation:
    """Says where the base model's residual lives, before any effect is fitted.

    Args:
        measurements: The records.
        numbers: The base model at each of them; None where it has no such numbers.
        floor: Their noise.
    """
    found = distortions(measurements)
    records = prepared(measurements, numbers, floor)
    best: dict[str, Block] = {}
    if records:
        channels = frozenset.intersection(*(frozenset(r.signals) for r in records))
        for equation in equations(records[0].numbers, channels):
            block = _block(equation, records)
            if block is not None and (
                equation.name not in best or block.rms < best[equation.name].rms
            ):
                best[equation.name] = block
    blocks = _responsible(list(best.values()), records[0].measurement.sampling_Hz) if best else []
    return ResidualLocation(tuple(blocks), found, _sentence(blocks, found))


def _block(equation: Equation, records: Sequence[Record]) -> Block | None:
    rate = records[0].measurement.sampling_Hz
    smoother = smoother_for(
        equation, [(r.numbers, r.signals, r.noise) for r in records], rate, widest_s(records)
    )
    fitted = fit_balance(equation, records, smoother)
    regime = regime_of(records, fitted.slope)
    inside = np.isfinite(fitted.residual) & np.isfinite(fitted.noise)
    if regime.velocity is not None:
        inside &= np.isfinite(regime.velocity) & np.isfinite(regime.command_rate)
    if inside.sum() < FEWEST:
        return None
    residual, noise = fitted.residual[inside], fitted.noise[inside]
    ends = np.cumsum([r.measurement.samples for r in records])[:-1]
    each, each_noise = np.split(fitted.residual, ends), np.split(fitted.noise, ends)
    loose = [independent_share(part) for part in map(inner, each) if part.size >= FEWEST]
    frequency, power = spectrum(each, rate)
    _, noise_power = spectrum(each_noise, rate)
    low_Hz, high_Hz = _band(frequency, np.maximum(power - noise_power, 0.0))

    def spread(columns: FloatArray) -> FloatArray:
        if not equation.smooth:
            return columns
        split = np.split(columns, ends)
        return np.vstack([np.column_stack([smoother.sampled(c, 1.0) for c in p.T]) for p in split])

    allowance = ALLOWANCE * float(fitted.known[inside].std())
    return Block(
        name=equation.name,
        title=equation.title,
        unit=equation.unit,
        rms=float(np.sqrt(np.mean(residual**2))),
        noise_rms=float(np.sqrt(np.mean(noise**2) + allowance**2)),
        smoothing_s=smoother.width_s,
        low_Hz=low_Hz,
        high_Hz=high_Hz,
        views=tuple(views(_seen(fitted, inside, spread, float(np.mean(loose))), regime)),
        frequency_Hz=frequency,
        power=power,
        noise_power=noise_power,
        residual=tuple(each),
    )


def _seen(
    fitted: BalanceFit,
    inside: NDArray[np.bool_],
    spread: Callable[[FloatArray], FloatArray],
    loose: float,
) -> Fit:
    """The residual as the views look at it; of a long one, every so manieth sample."""
    stride = max(1, int(inside.sum()) // MOST)
    chosen = np.flatnonzero(inside)[::stride]
    return Fit(
        residual=fitted.residual[chosen],
        noise=fitted.noise[chosen],
        basis=np.linalg.qr(fitted.columns[chosen])[0],
        chosen=chosen,
        spread=spread,
        independent=max(2.0, min(1.0, stride * loose) * chosen.size),
    )


def _responsible(blocks: Sequence[Block], sampling_Hz: float) -> list[Block]:
    """The blocks in order, first the one that explains what others show too.

    The gauge's reading stands in the force and the gauge balance: what is wrong with the reading
    shows in both, with opposite signs, and what is wrong with the cable in the gauge block alone.
    What an eyelet adds shows against the gauge outside it and against the cable.
    """
    ordered = sorted(blocks, key=lambda block: -block.ratio)
    by_name = {block.name: block for block in blocks}
    force, gauge, eyelet = (by_name.get(name) for name in ("force", "gauge", "eyelet"))
    if gauge is None or not max(block.ratio for block in blocks) > ABOVE:
        return ordered
    if (
        eyelet is not None
        and eyelet.ratio > ABOVE
        and _signed_R2(gauge, eyelet, sampling_Hz) > ALIKE
    ):
        return [eyelet, *(block for block in ordered if block is not eyelet)]
    if (
        force is not None
        and force.ratio > ABOVE
        and _signed_R2(force, gauge, sampling_Hz) < -ALIKE
    ):
        rest = [block for block in ordered if block not in (force, gauge)]
        return [replace(gauge, title=READING), *rest, force]
    if force is not None and force.ratio < ABOVE:
        return [replace(b, title="cable") if b is gauge else b for b in ordered]
    return ordered


def _signed_R2(one: Block, other: Block, sampling_Hz: float) -> float:
    """Share of a block's residual that another's explains, with the sign of the slope."""
    smoother = Smoother(one.smoothing_s, sampling_Hz)
    x = np.concatenate(one.residual)
    y = np.concatenate([smoother.sampled(np.nan_to_num(part), 1.0) for part in other.residual])
    both = np.isfinite(x) & np.isfinite(y)
    rho = float(np.corrcoef(x[both], y[both])[0, 1])
    return math.copysign(rho**2, rho)


def _band(frequency: FloatArray, power: FloatArray) -> tuple[float, float]:
    """The band that holds the middle of a power, Hz; zeros where there is none."""
    total = np.cumsum(power)
    if not total[-1] > 0.0:
        return 0.0, 0.0
    edges = [(1.0 - MIDDLE) / 2.0, (1.0 + MIDDLE) / 2.0]
    low, high = np.searchsorted(total / total[-1], edges)
    return float(frequency[low]), float(frequency[min(high, frequency.size - 1)])


def _sentence(blocks: Sequence[Block], found: Sequence[Distortion]) -> str:
    """The strongest of it in words."""
    return " ".join([_of_blocks(blocks), *_of_distortion(found)])


def _of_blocks(blocks: Sequence[Block]) -> str:
    if not blocks:
        return "The model's equations cannot be balanced against these channels."
    first = blocks[0]
    if first.ratio < ABOVE:
        return (
            f"No block stands out of its noise: the {first.title} most, {first.ratio:.2g} times."
        )
    regime, band = first.regime, first.band
    follows = "it follows no single variable"
    if regime is not None:
        detail = f" of {regime.detail}" if regime.detail else ""
        follows = f"{regime.share:.0%} of the residual follows the {regime.name}{detail}"
    sentence = f"The {first.title}, {first.ratio:.2g} times its noise: {follows}"
    sentence += f"; 90 % of it lies {band}." if band else "."
    # What this block explains in another is not told twice.
    shown = {READING: "force", "eyelet": "gauge"}.get(first.title)
    own = [b for b in blocks[1:] if b.name != shown]
    others = [f"the {b.title} {b.ratio:.2g} times" for b in own if b.ratio >= ABOVE]
    return sentence + (f" Above its noise too: {', '.join(others)}." if others else "")


def _of_distortion(found: Sequence[Distortion]) -> list[str]:
    sentences = []
    for channel in dict.fromkeys(d.channel for d in found):
        of = [d for d in found if d.channel == channel]
        odd = max((d.odd_dB for d in of if not math.isnan(d.odd_dB)), default=math.nan)
        even = max(d.even_dB for d in of)
        shown = [
            f"{name} distortion of {dB:.0f} dB"
            for name, dB in (("odd", odd), ("even", even))
            if dB >= FREE_LINES_dB
        ]
        what = " and ".join(shown) if shown else "no distortion"
        sentences.append(f"Lines left free in {channel} show {what} over the noise.")
    return sentences
