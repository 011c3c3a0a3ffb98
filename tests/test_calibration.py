"""Gauge and current calibration, against other fits, textbook statistics and true curves."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, f_oneway

from estune.errors import InvalidInput
from estune.hardware.scales import CurrentScale
from estune.reel.calibration import CurrentCalibration, GaugeCalibration

FORCES = np.repeat(np.linspace(0.0, 40.0, 9), 4)  # N, loaded and unloaded twice
COMMANDS = np.repeat(np.linspace(-2000.0, 2000.0, 11), 2)


def gauge_counts(force_N, position_m=0.0):
    """Counts of a nearly linear gauge, softer away from its centre."""
    softening = 1.0 - 30.0 * np.square(position_m - 0.002)
    return 400.0 + 55.0 * force_N * softening + 0.12 * np.square(force_N)


def amplifier_A(command):
    """Current of a controller with a cubic nonlinearity and an offset."""
    return 0.03 + 2.9e-3 * command - 6e-11 * command**3


def read_gauge(seed, noise=3.0, forces=FORCES, **position):
    rng = np.random.default_rng(seed)
    return gauge_counts(forces, **position) + noise * rng.standard_normal(forces.size)


def test_quadratic_agrees_with_an_independent_fit():
    counts = read_gauge(0)
    calibration = GaugeCalibration.fit(FORCES, counts)
    reference, covariance = np.polyfit(FORCES, counts, 2, cov="unscaled")
    force = np.linspace(0.0, 40.0, 33)
    assert calibration.reading(force) == pytest.approx(np.polyval(reference, force), rel=1e-10)
    fit = calibration.regression
    residuals = counts - np.polyval(reference, FORCES)
    assert fit.residuals == pytest.approx(residuals, abs=1e-8)
    assert fit.standard_error**2 == pytest.approx(residuals @ residuals / (FORCES.size - 3))
    # The leverage of each point by leaving it out: its new residual is r/(1 - h).
    for i in (0, 17, 35):
        keep = np.arange(FORCES.size) != i
        without = np.polyval(np.polyfit(FORCES[keep], counts[keep], 2), FORCES[i])
        assert counts[i] - without == pytest.approx(residuals[i] / (1.0 - fit.leverage[i]))
    row = np.vander([2.0 * 17.0 / 40.0 - 1.0], 3, increasing=True)[0]
    design = np.vander([17.0], 3)[0]
    deviation = fit.standard_error * np.sqrt(design @ covariance @ design)
    assert fit.half_width(row) == pytest.approx(2.0345 * deviation, rel=1e-4)  # t, 33 dof


def test_surface_in_force_and_position_agrees_with_an_independent_fit():
    forces, positions = map(
        np.ravel, np.meshgrid(np.linspace(1.0, 40.0, 6), np.linspace(-0.01, 0.01, 5))
    )
    counts = read_gauge(1, forces=forces, position_m=positions)
    calibration = GaugeCalibration.fit(forces, counts, positions, position_order=2)

    def rows(f, y):
        return np.stack([f**i * (100 * y) ** j for i in range(3) for j in range(3)], -1)

    reference = np.linalg.lstsq(rows(forces, positions), counts)[0]
    rng = np.random.default_rng(2)
    f, y = rng.uniform(1.0, 40.0, 50), rng.uniform(-0.01, 0.01, 50)
    assert calibration.reading(f, y) == pytest.approx(rows(f, y) @ reference, rel=1e-9)
    assert sum(calibration.regression.leverage) == pytest.approx(9.0)


@given(
    st.floats(-300.0, 300.0).filter(lambda slope: abs(slope) > 1.0),
    st.floats(-0.49, 0.49),
    st.floats(-0.3, 0.3),
)
def test_force_and_reading_are_inverse(slope, bend, turn):
    forces, positions = map(
        np.ravel, np.meshgrid(np.linspace(0.0, 40.0, 5), np.linspace(0.0, 0.02, 4))
    )

    def curve(f, y):
        return 1e4 + slope * (f + bend * f * f / 40.0) * (1.0 + turn * y / 0.02)

    calibration = GaugeCalibration.fit(
        forces, curve(forces, positions), positions, position_order=1
    )
    f, y = np.linspace(0.0, 40.0, 21)[:, None], np.linspace(0.0, 0.02, 7)
    assert calibration.force_N(calibration.reading(f, y), y) == pytest.approx(
        np.broadcast_to(f, (21, 7)), abs=1e-8
    )
    assert type(calibration.force_N(calibration.reading(7.0, 0.01), 0.01)) is float


def test_current_of_a_command_is_that_of_the_amplifier():
    calibration = CurrentCalibration.fit(COMMANDS, amplifier_A(COMMANDS))
    command = np.linspace(-2000.0, 2000.0, 1001)
    assert calibration.current_A(command) == pytest.approx(amplifier_A(command), abs=1e-12)
    assert type(calibration.current_A(0.5)) is float


def test_linearised_current_follows_the_setpoint():
    rng = np.random.default_rng(5)
    measured = amplifier_A(COMMANDS) + 0.01 * rng.standard_normal(COMMANDS.size)
    scale = CurrentScale.of(CurrentCalibration.fit(COMMANDS, measured))
    setpoint = np.linspace(-5.0, 5.0, 101)
    command = np.array([scale.counts(current_A) for current_A in setpoint])
    assert np.max(np.abs(amplifier_A(command) - setpoint)) < 0.02
    uncorrected = (setpoint - 0.03) / 2.9e-3
    worst = np.max(np.abs(amplifier_A(uncorrected) - setpoint))
    assert np.max(np.abs(amplifier_A(command) - setpoint)) < 0.1 * worst


def test_half_width_covers_the_true_curve_at_95_percent():
    seeds, row = 400, np.array([1.0, 0.15, 0.15**2])  # at 23 N of 0 to 40 N
    hits = 0
    for seed in range(seeds):
        fit = GaugeCalibration.fit(FORCES, read_gauge(seed)).regression
        hits += abs(row @ fit.coefficients - gauge_counts(23.0)) < fit.half_width(row)
    low, high = binom.interval(0.999, seeds, 0.95)
    assert low <= hits <= high


def test_lack_of_fit_detects_too_low_an_order():
    seeds = 400
    refused = sum(
        GaugeCalibration.fit(FORCES, read_gauge(seed)).regression.lack_of_fit.p_value < 0.05
        for seed in range(seeds)
    )
    low, high = binom.interval(0.999, seeds, 0.05)
    assert low <= refused <= high
    bent = read_gauge(0) + 0.02 * (FORCES - 20.0) ** 3
    assert GaugeCalibration.fit(FORCES, bent).regression.lack_of_fit.p_value < 1e-6


def test_lack_of_fit_statistic_is_an_analysis_of_variance():
    # Saturate the model but for the curve: residuals of the fit, grouped by force, have group
    # means that are the misses, so the one-way F needs only its degrees of freedom corrected.
    fit = GaugeCalibration.fit(FORCES, read_gauge(3)).regression
    groups = [np.asarray(fit.residuals)[force == FORCES] for force in np.unique(FORCES)]
    one_way = f_oneway(*groups).statistic
    test = fit.lack_of_fit
    assert test.degrees == (9 - 3, 36 - 9)
    assert pytest.approx(one_way * (9 - 1) / (9 - 3)) == test.F
    assert test.pure_error == pytest.approx(np.sqrt(np.mean([np.var(g, ddof=1) for g in groups])))


def test_lack_of_fit_needs_differing_repeats():
    forces = np.linspace(0.0, 40.0, 9)
    assert GaugeCalibration.fit(forces, gauge_counts(forces)).regression.lack_of_fit is None
    twice = np.repeat(forces, 2)
    assert (
        GaugeCalibration.fit(twice, np.round(gauge_counts(twice))).regression.lack_of_fit is None
    )


def test_extrapolation_is_refused_outside_the_margin():
    calibration = GaugeCalibration.fit(FORCES, read_gauge(0))
    with pytest.raises(InvalidInput, match=r"force 40.5 N is outside the calibrated 0 to 40 N"):
        calibration.reading([3.0, 40.5])
    with pytest.raises(InvalidInput, match=r"reading 9000 is outside .* 0 to 40 N"):
        calibration.force_N(9000.0)
    wider = GaugeCalibration.fit(FORCES, read_gauge(0), margin=0.05)
    assert wider.force_N(wider.reading(41.9)) == pytest.approx(41.9)
    with pytest.raises(InvalidInput, match="calibrated -2 to 42 N"):
        wider.reading(42.1)
    current = CurrentCalibration.fit(COMMANDS, amplifier_A(COMMANDS))
    with pytest.raises(InvalidInput, match="outside the calibrated -2000 to 2000"):
        current.current_A(2001.0)


def test_calibration_survives_json():
    forces, positions = np.tile(FORCES, 3), np.repeat([-0.01, 0.0, 0.01], FORCES.size)
    counts = read_gauge(7, forces=forces, position_m=positions)
    for calibration in (
        GaugeCalibration.fit(FORCES, read_gauge(0), margin=0.1),
        GaugeCalibration.fit(forces, counts, positions, position_order=2),
        CurrentCalibration.fit(COMMANDS, amplifier_A(COMMANDS), order=5),
    ):
        text = json.dumps(calibration.as_dict(), allow_nan=False)
        assert type(calibration).from_dict(json.loads(text)) == calibration
        damaged = json.loads(text)
        del damaged["regression"]["leverage"]
        with pytest.raises(InvalidInput, match="damaged"):
            type(calibration).from_dict(damaged)
        damaged = json.loads(text)
        damaged["regression"]["coefficients"].pop()
        with pytest.raises(InvalidInput, match="calibrate again"):
            type(calibration).from_dict(damaged)


CLEAN = gauge_counts(FORCES)
SWAPPED = gauge_counts(np.where(FORCES == 10.0, 15.0, np.where(FORCES == 15.0, 10.0, FORCES)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"reading": SWAPPED}, r"not monotone: .* at force 10 N"),
        ({"reading": CLEAN - 0.9 * FORCES**2}, "not monotone"),
        (
            {"reading": CLEAN - 0.8 * FORCES**2 + 25.0 * FORCES, "margin": 0.5},
            "significantly monotone",
        ),
        ({"reading": np.full(36, 812.0)}, "flat"),
        ({"force_N": np.arange(3.0), "reading": CLEAN[:3]}, "3 points are too few"),
        ({"force_N": np.full(36, 5.0)}, "force_N has 1 different values in 36 points"),
        ({"force_N": np.where(FORCES < 20.0, 5.0, 9.0)}, "force_N has 2 different values"),
        ({"reading": np.where(FORCES == 40.0, np.nan, CLEAN)}, "reading is nan .* index 32"),
        ({"force_N": np.where(FORCES == 0.0, np.inf, FORCES)}, "force_N is inf N at index 0"),
        ({"reading": CLEAN[:5]}, "columns of one length"),
        ({"position_m": FORCES * 1e-4, "position_order": 1}, "do not determine"),
        ({"position_m": np.full(36, 0.1), "position_order": 1}, "position_m has 1 different"),
        ({"position_order": 1}, "without positions"),
        ({"position_m": FORCES}, "with positions"),
        ({"margin": -0.1}, "margin of force"),
    ],
)  # fmt: skip
def test_bad_gauge_data_are_refused_by_name(data, message):
    columns = {"force_N": FORCES, "reading": CLEAN} | data
    with pytest.raises(InvalidInput, match=message):
        GaugeCalibration.fit(**columns)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"current_A": np.abs(amplifier_A(COMMANDS))}, "not monotone"),
        ({"current_A": np.zeros(22)}, "flat"),
        ({"order": 11}, "command has 11 different values"),
        ({"order": 0}, "order is 0"),
        ({"current_A": amplifier_A(COMMANDS), "margin": 1.0}, "significantly monotone"),
    ],
)
def test_bad_current_data_are_refused_by_name(data, message):
    columns = {"command": COMMANDS, "current_A": amplifier_A(COMMANDS)} | data
    with pytest.raises(InvalidInput, match=message):
        CurrentCalibration.fit(**columns)


def test_noise_in_repeats_is_not_a_reversal():
    forces = np.repeat(np.linspace(0.0, 4.0, 21), 3)  # 11 counts apart, noise 30 counts
    counts = read_gauge(4, noise=30.0, forces=forces)
    means = counts.reshape(21, 3).mean(axis=1)
    assert np.any(np.diff(means) < 0.0)
    GaugeCalibration.fit(forces, counts)
    with pytest.raises(InvalidInput, match="repeat each point"):
        GaugeCalibration.fit(forces[::3], means)


def test_missing_or_needless_position_is_refused():
    plain = GaugeCalibration.fit(FORCES, CLEAN)
    with pytest.raises(InvalidInput, match="has no contact position"):
        plain.reading(3.0, 0.01)
    positions = np.tile([0.0, 0.005, 0.01, 0.015], 9)
    surface = GaugeCalibration.fit(FORCES, CLEAN, positions, position_order=1)
    with pytest.raises(InvalidInput, match="needs a contact position"):
        surface.force_N(800.0)
