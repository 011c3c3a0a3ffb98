"""Residuals of gauge and encoder, separated into those of the drum and those of the cable."""

import numpy as np
import pytest

from plants.diagnosis.prediction.prediction import CHANNELS, Index
from plants.diagnosis.search.cable_block import block_powers

SAMPLES, PULL_N_RAD = 40, 190.0
SIGMA = {"tension_N": 0.05, "angle_rad": 2e-4}


def both_channels() -> Index:
    """Gauge and encoder of one record, in one window; the encoder's first samples are missing."""
    samples = [np.arange(SAMPLES), np.arange(5, SAMPLES)]
    channels = [
        np.full(s.size, CHANNELS.index(name)) for s, name in zip(samples, SIGMA, strict=True)
    ]
    sample, channel = np.concatenate(samples), np.concatenate(channels)
    sigma = np.array([SIGMA[CHANNELS[n]] for n in channel])
    zeros = np.zeros(sample.size, np.int64)
    return Index(zeros, channel, sample, sample / 632.0, sigma, zeros)


def powers(tension_N: np.ndarray, angle_rad: np.ndarray) -> tuple[float, float]:
    index = both_channels()
    gauge = index.channel == CHANNELS.index("tension_N")
    errors = np.where(gauge, tension_N[index.sample], angle_rad[index.sample]) / index.sigma
    return block_powers(index, errors, np.array([PULL_N_RAD]))


def test_motion_error_of_the_drum_is_absent_from_the_cable_block():
    moved_rad = 1e-3 * np.random.default_rng(1).standard_normal(SAMPLES)
    cable, drum = powers(PULL_N_RAD * moved_rad, moved_rad)
    assert cable == pytest.approx(0.0, abs=1e-12)
    assert drum > 1.0


def test_reading_error_of_the_gauge_is_relative_to_the_noise_of_both_channels():
    cable, _ = powers(np.full(SAMPLES, 0.1), np.zeros(SAMPLES))
    both = np.hypot(SIGMA["tension_N"], PULL_N_RAD * SIGMA["angle_rad"])
    assert cable == pytest.approx((0.1 / both) ** 2)


def test_noise_gives_both_blocks_a_power_of_one():
    rng = np.random.default_rng(2)
    found = [
        powers(0.05 * rng.standard_normal(SAMPLES), 2e-4 * rng.standard_normal(SAMPLES))
        for _ in range(2000)
    ]
    assert np.mean(found, axis=0) == pytest.approx([1.0, 1.0], abs=0.02)


def test_blocks_are_unknown_without_a_cable():
    index = both_channels()
    assert np.isnan(block_powers(index, np.ones(index.sigma.size), np.array([np.nan]))).all()
