"""The noise floor: accurate for known noise, insensitive to mains, drift and excitation."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.paper.identify.excitation import Band, chirp, multisine
from experiments.paper.identify.open_loop import open_loop_record
from plants import reference_reel
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise import spectral_rms, step_of, upper_rms
from plants.diagnosis.data.noise_floor import noise_floor
from plants.diagnosis.data.periods import periods_of

RATE = 632.0
REEL = reference_reel()
STEP_RAD = 2.0 * np.pi / REEL.encoder_counts


def measure(excitation, seed=0):
    return MeasuredRecord.of(open_loop_record(REEL, excitation, seed=seed))


SWEEP = chirp(RATE, Band(1.0, 40.0, period_s=4.0, periods=2, settling_periods=0), 4.0)
SINES = multisine(RATE, Band(1.0, 60.0, periods=3), 4.0)


def once(m):
    """First period of a record, in which nothing repeats."""
    n = m.samples // 2 - 7
    cut = {c: getattr(m, c)[:n] for c in ("time_s", "setpoint_N", "current_A", "tension_N")}
    return replace(m, **cut, angle_rad=m.angle_rad[:n], flags=m.flags[:n])


@pytest.mark.parametrize(
    ("how", "records"),
    [
        ("repeats", [measure(SWEEP, 1), measure(SWEEP, 2)]),
        ("periods", [measure(SINES)]),
        ("upper spectrum", [once(measure(SWEEP))]),
    ],
)
def test_gauge_noise_of_a_reel_is_estimated(how, records):
    floor = noise_floor(records)
    assert floor.channels["tension_N"].how == how
    assert floor.tension_N == pytest.approx(REEL.gauge_noise_N, rel=0.06)
    assert floor.channels["angle_rad"].lsb == pytest.approx(STEP_RAD, rel=1e-6)
    assert floor.angle_rad == pytest.approx(STEP_RAD / 12**0.5, rel=0.1)


def test_what_disturbs_a_drive_between_repeats_is_no_noise_of_its_encoder():
    rng = np.random.default_rng(3)
    records = []
    for m in (measure(SWEEP, 1), measure(SWEEP, 2)):
        pushed = np.convolve(rng.normal(0.0, 1.0, m.samples), np.hanning(60), "same")
        wandered = 2.0 * STEP_RAD * pushed
        read = np.round((m.angle_rad + wandered) / STEP_RAD) * STEP_RAD
        records.append(replace(m, angle_rad=read))
    assert np.std(records[0].angle_rad - records[1].angle_rad) > 2.0 * STEP_RAD
    assert noise_floor(records).angle_rad < 2.0 * STEP_RAD / 12**0.5


def test_encoder_of_a_drum_that_is_held_is_as_coarse_as_that_of_one_that_moves():
    moved = once(measure(SWEEP))
    held = replace(moved, setpoint_N=np.full(moved.samples, 15.0), angle_rad=0.0 * moved.angle_rad)
    floor = noise_floor([moved, held, moved])
    assert floor.angle_rad == pytest.approx(STEP_RAD / 12**0.5, rel=0.1)


def test_noise_is_estimated_from_constant_setpoints():
    rng = np.random.default_rng(5)
    n = 2000
    setpoint = np.where(np.arange(n) < 1000, 10.0, 20.0)
    still = 10.0 + rng.normal(0.0, 0.3, n)
    rung = np.exp(-(np.arange(n) % 1000) / 40.0) * 5.0 * np.sin(np.arange(n) / 3.0)
    drifting = 2.0 * np.arange(n) / n
    m = replace(once(measure(SWEEP)), time_s=np.arange(n) / RATE, setpoint_N=setpoint)
    m = replace(m, tension_N=setpoint + still + rung + drifting, angle_rad=None, current_A=None)
    floor = noise_floor([m])
    assert {n.how for n in floor.channels.values()} == {"quiet stretches"}
    assert floor.tension_N == pytest.approx(0.3, rel=0.08)


@pytest.mark.parametrize("samples", [632, 6320])
@pytest.mark.parametrize("rms_of", [spectral_rms, upper_rms])
def test_noise_excludes_mains_and_drift(samples, rms_of):
    rng = np.random.default_rng(1)
    t = np.arange(samples) / RATE
    mains = 0.5 * np.sin(2.0 * np.pi * 50.0 * t)
    rms = rms_of(rng.normal(0.0, 0.1, samples) + mains + 0.2 * t)
    assert rms == pytest.approx(0.1, rel=0.12)


def test_noise_of_repeats_excludes_mains_of_any_phase():
    humming = []
    for seed in (1, 2):
        m = measure(SWEEP, seed)
        hum = 0.5 * np.sin(2.0 * np.pi * 50.02 * np.arange(m.samples) / RATE + 2.0 * seed)
        humming.append(replace(m, tension_N=m.tension_N + hum))
    floor = noise_floor(humming)
    assert "repeats" in {n.how for n in floor.channels.values()}
    assert floor.tension_N == pytest.approx(REEL.gauge_noise_N, rel=0.15)


def test_noise_of_repeats_includes_coloured_noise():
    rng = np.random.default_rng(2)
    white = rng.standard_normal(8001)
    coloured = white[1:] + 0.9 * white[:-1]
    assert spectral_rms(coloured) == pytest.approx((1.0 + 0.9**2) ** 0.5, rel=0.04)


def test_step_is_found_in_rounded_readings_only():
    rng = np.random.default_rng(3)
    smooth = rng.standard_normal(2000)
    assert step_of(smooth) == 0.0
    for step in (STEP_RAD, 0.25, 3e-5):
        readings = 1.7 + np.round(smooth * 40.0) * step
        assert step_of(readings) == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize(("counts", "decimals"), [(4096, 2), (8192, 3), (10_000, 3)])
def test_step_of_an_encoder_is_found_in_degrees_with_few_decimals(counts, decimals):
    turned = np.random.default_rng(4).integers(-2 * counts, 2 * counts, 3000)
    written = np.round(turned * 360.0 / counts, decimals)
    assert step_of(written) == pytest.approx(360.0 / counts, rel=1e-4)


@pytest.mark.parametrize("period_s", [1.0, 2.5])
def test_period_equals_that_of_the_excitation(period_s):
    period_s = round(period_s * RATE) / RATE
    excitation = multisine(RATE, Band(2.0, 50.0, period_s=period_s, periods=4), 3.0)
    lead = np.full(100, 15.0)
    periods = periods_of(np.concatenate([lead, 15.0 + excitation.waveform_N, lead]))
    assert periods.samples == round(period_s * RATE)
    assert periods.periods == 5


@pytest.mark.parametrize("setpoint", [np.repeat([1.0, 2.0], 500), np.linspace(0.0, 1.0, 900)])
def test_step_and_ramp_have_no_period(setpoint):
    assert periods_of(setpoint) is None
