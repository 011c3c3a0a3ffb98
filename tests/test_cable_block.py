"""Separation of gauge and encoder residuals into drum motion and cable errors."""

import numpy as np
import pytest

from plants.diagnosis.prediction.prediction import CHANNELS, Index
from plants.diagnosis.search.cable_block import Blocks, CableBlock

SAMPLES, PULL_N_RAD = 40, 190.0
SIGMA = {"tension_N": 0.05, "angle_rad": 2e-4}


def both_channels() -> Index:
    """Index of the gauge and encoder of one record; the encoder's first samples are missing."""
    samples = [np.arange(SAMPLES), np.arange(5, SAMPLES)]
    channel = np.concatenate(
        [
            np.full(s.size, CHANNELS.index(name), np.int64)
            for s, name in zip(samples, SIGMA, strict=True)
        ]
    )
    sample = np.concatenate(samples)
    sigma = np.array([SIGMA[CHANNELS[n]] for n in channel])
    zeros = np.zeros(sample.size, np.int64)
    return Index(zeros, channel, sample, sample / 632.0, sigma, zeros)


def whitened(index: Index, tension_N: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    gauge = index.channel == CHANNELS.index("tension_N")
    return np.where(gauge, tension_N[index.sample], angle_rad[index.sample]) / index.sigma


def fitted_block(index: Index) -> CableBlock:
    block = CableBlock.of(index, np.arange(index.sample.size), np.array([PULL_N_RAD]))
    assert block is not None
    return block


def test_cable_residual_excludes_drum_motion():
    index = both_channels()
    moved_rad = 1e-3 * np.random.default_rng(1).standard_normal(SAMPLES)
    block = fitted_block(index)
    residual = block.left(whitened(index, PULL_N_RAD * moved_rad, moved_rad))
    assert residual == pytest.approx(np.zeros(SAMPLES - 5), abs=1e-12)
    blocks = Blocks.of(block, whitened(index, PULL_N_RAD * moved_rad, moved_rad))
    assert blocks.cable == pytest.approx(0.0, abs=1e-12)
    assert blocks.drum > 1.0


def test_cable_residual_of_a_gauge_error_is_scaled_by_both_noises():
    index = both_channels()
    residual = fitted_block(index).left(whitened(index, np.full(SAMPLES, 0.1), np.zeros(SAMPLES)))
    both = np.hypot(SIGMA["tension_N"], PULL_N_RAD * SIGMA["angle_rad"])
    assert residual == pytest.approx(np.full(SAMPLES - 5, 0.1 / both))


def test_residual_of_noise_keeps_its_power():
    index = both_channels()
    noise = np.random.default_rng(2).standard_normal((20_000, index.sample.size))
    block = fitted_block(index)
    assert np.mean(block.left(noise) ** 2) == pytest.approx(1.0, abs=0.01)
    blocks = Blocks.of(block, noise[0])
    pairs = block.gauge.size
    power = blocks.cable * pairs + blocks.drum * (index.sample.size - pairs)
    assert power == pytest.approx(float(noise[0] @ noise[0]))


def test_without_encoder_or_cable_there_is_no_such_block():
    index = both_channels()
    gauge = np.flatnonzero(index.channel == CHANNELS.index("tension_N"))
    assert CableBlock.of(index, gauge, np.array([PULL_N_RAD])) is None
    everything = np.arange(index.sample.size)
    assert CableBlock.of(index, everything, np.array([np.nan])) is None
    assert np.isnan(Blocks.of(None, np.ones(3))).all()
