"""What the base model's residual suggests for frequencies and periods, before any fit."""

import math
from collections.abc import Sequence

import numpy as np

from estune.trial import FloatArray
from plants.discrepancy.data.noise import step_of
from plants.discrepancy.data.record import Measurement
from plants.discrepancy.residual.where import Block, Where
from plants.discrepancy.search.screen import Suggest

PEAKS = 3
"""Peaks taken of a spectrum or a periodogram."""
ORDERS = 400
"""Periods per turn that are tried: a quarter of a period apart in all the turning there is."""
SAMPLES = 20_000
"""Samples that the periodogram over the angle looks at."""


def suggestions(measurements: Sequence[Measurement], where: Where) -> Suggest:
    """From `slug.parameter` to values to begin with.

    Args:
        measurements: The records.
        where: Where the base model's residual lives.
    """
    frequencies = sorted({f for block in where.blocks for f in _spectral_peaks(block)})
    lengths = [m.cable_length_m for m in measurements if m.cable_length_m]
    known = {
        "torque_ripple.per_turn": _orders(measurements, where),
        "string_mode.density_kg_m": [
            # (31): f = 1/(2 L) sqrt(T/mu)
            float(np.median([m.preload_N for m in measurements]))
            / (2.0 * float(np.median(lengths)) * f) ** 2
            for f in frequencies
            if lengths and f > 0.0
        ],
    }
    for name in ("gauge_resonance", "structural_mode"):
        known[f"{name}.frequency_Hz"] = frequencies
    return lambda name: known.get(name, [])


def _spectral_peaks(block: Block) -> list[float]:
    """Frequencies at which a block's residual stands highest above its surroundings."""
    power = np.maximum(block.power - block.noise_power, 0.0)
    if power.size < 5 or not power.any():
        return []
    around = np.array([np.median(power[max(0, n - 8) : n + 9]) for n in range(power.size)])
    height = power / (around + 0.01 * power.max())
    inner = np.arange(2, power.size - 1)
    peaks = inner[(power[inner] >= power[inner - 1]) & (power[inner] >= power[inner + 1])]
    best = peaks[np.argsort(-height[peaks])][:PEAKS]
    return [float(block.frequency_Hz[n]) for n in best if height[n] > 2.0]


def _orders(measurements: Sequence[Measurement], where: Where) -> list[float]:
    """Periods per turn that the force block's residual follows, whatever the phase in a record."""
    block = next((b for b in where.blocks if b.name in ("force", "plant")), None)
    if block is None:
        return []
    pairs: list[tuple[FloatArray, FloatArray]] = []
    for m, residual in zip(measurements, block.residual, strict=True):
        if m.angle_rad is None:
            continue
        inside = np.flatnonzero(np.isfinite(residual))
        inside = inside[:: max(1, inside.size * len(measurements) // SAMPLES)]
        if inside.size > 3:
            pairs.append((m.angle_rad[inside], _straight(m.angle_rad[inside], residual[inside])))
    extent = max((float(np.ptp(angle)) for angle, _ in pairs), default=0.0)
    if extent == 0.0:
        return []
    # From one period in all the turning there is, to as fine as a hundredth of it.
    step = 0.5 * math.pi / extent
    orders = 4.0 * step + step * np.arange(ORDERS)
    # An angle read in steps shows no period below two of them.
    read = max(step_of(m.angle_rad) for m in measurements if m.angle_rad is not None)
    orders = orders[orders * read < math.pi]
    power = np.zeros(orders.size)
    for angle, residual in pairs:
        turned = angle - angle.mean()
        wave, further = residual * np.exp(1j * orders[0] * turned), np.exp(1j * step * turned)
        for n in range(orders.size):
            power[n] += abs(wave.sum()) ** 2 / angle.size
            wave *= further
    inner = np.arange(1, orders.size - 1)
    peaks = inner[(power[inner] > power[inner - 1]) & (power[inner] > power[inner + 1])]
    best = peaks[np.argsort(-power[peaks])][:PEAKS]
    return [float(orders[n]) for n in best]


def _straight(angle: FloatArray, residual: FloatArray) -> FloatArray:
    """A residual less its straight line over the angle."""
    columns = np.stack([np.ones(angle.size), angle - angle.mean()], axis=1)
    left: FloatArray = residual - columns @ np.linalg.lstsq(columns, residual, rcond=None)[0]
    return left
