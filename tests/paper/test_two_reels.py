"""The two-reel bench and its procedures: accuracy and warnings."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from estune.errors import InvalidInput, RigError
from experiments.paper import two_reels as tr
from tests.paper.test_transparency import slides_at

SETPOINTS = (8.0, 16.0, 24.0, 32.0, 40.0)
GAUGE_Y = tr.BenchGauge(zero=3.0, sensitivity=0.8, curvature_per_N=1e-3)

# The bench


def bench(eyelet=None, *, seed=0, noise_N=0.011, drift_N=0.0, other=None, drive=None):
    """Two reels with one eyelet and an uncalibrated gauge at Y."""
    eyelet, drive = eyelet or tr.Eyelet(), drive or tr.BenchDrive()
    quiet = {"noise_N": noise_N, "drift_N": drift_N}
    x = tr.ReelModel(eyelet, tr.BenchGauge(**quiet), drive)
    y = tr.ReelModel(other or eyelet, replace(GAUGE_Y, **quiet), drive)
    return tr.SimulatedBench(x, y, seed=seed)


def test_simulated_reels_follow_the_bench_protocol():
    two = bench(noise_N=0.0)
    started = two.record(1.0)
    assert started.time_s.shape == started.x.gauge.shape == started.y.angle_rad.shape == (50,)
    two.x.hold_tension(20.0, 1.0)
    rising = two.record(8.0)
    assert rising.time_s[0] > started.time_s[-1]
    assert rising.x.gauge.max() < 20.0 * 1.001
    assert rising.x.gauge[-1] == pytest.approx(20.0, rel=1e-3)
    assert rising.x.angle_rad[-1] > started.x.angle_rad[-1]
    assert rising.y.angle_rad[-1] == pytest.approx(started.y.angle_rad[-1], abs=2e-3)
    two.x.hold_position()
    goal = GAUGE_Y.reading(25.0)
    two.y.hold_tension(goal, 1.0)
    assert two.record(8.0).y.gauge[-1] == pytest.approx(goal, rel=1e-3)
    two.x.hold_velocity(-0.2)
    moving = two.record(6.0).x
    assert np.polyfit(np.arange(100) / 50.0, moving.angle_rad[-100:], 1)[0] == pytest.approx(
        -0.2, rel=0.02
    )
    two.x.hold_position(float(moving.angle_rad[-1]) - 0.1)
    assert two.record(6.0).x.angle_rad[-1] == pytest.approx(moving.angle_rad[-1] - 0.1, abs=1e-3)
    two.x.hold_velocity(0.0, -1.0)
    gives = two.record(2.0).x
    assert gives.angle_rad[0] - gives.angle_rad[-1] > 0.02


@settings(max_examples=30)
@given(st.lists(st.tuples(st.booleans(), st.floats(6.0, 40.0)), min_size=1, max_size=6))
def test_bench_eyelets_never_exceed_their_friction_limit(commands):
    eyelet = tr.Eyelet(0.15, (2.0,), variation=0.0)
    two = bench(eyelet, noise_N=0.0)
    B = slides_at(0.15, 2.0)
    for on_x, tension in commands:
        puller, holder = (two.x, two.y) if on_x else (two.y, two.x)
        holder.hold_position()
        puller.hold_tension(tension if on_x else GAUGE_Y.reading(tension), 1.0)
        two.record(3.0)
        outside = 10e3 * (two.x.slid_m + two.y.slid_m)
        for reel in (two.x, two.y):
            assert B - 1e-9 <= outside / reel.tension_N <= 1.0 / B + 1e-9


def test_bench_readings_are_reproducible_by_seed():
    first, second = (bench(seed=7, drift_N=0.1).record(1.0) for _ in range(2))
    assert np.array_equal(first.y.gauge, second.y.gauge)


# The procedure


def measure(two, angles, angles_y=None, **choices):
    choices = {"setpoints_N": SETPOINTS, "preload_N": 2.0, **choices}
    return tr.evaluate(tr.TwoReelProcedure(**choices).run(two), angles, angles_y)


benches = st.fixed_dictionaries(
    {
        "coefficient": st.floats(0.03, 0.25),
        "gamma": st.floats(1.6, 2.9),
        "noise_N": st.floats(0.002, 0.05),
        "drift_N": st.floats(0.0, 0.05),
        "variation": st.floats(0.0, 0.02),
        "seed": st.integers(0, 2**16),
    }
)


@pytest.mark.slow
@settings(max_examples=15)
@given(benches)
def test_procedure_is_accurate_to_two_percent_or_warns(case):
    check_accuracy(case)


@pytest.mark.nightly
@settings(max_examples=200)
@given(benches)
def test_procedure_is_accurate_or_warns_on_many_benches(case):
    check_accuracy(case)


def check_accuracy(case):
    """Measures one bench: an accurate result, a warning, or a reported stuck cable."""
    eyelet = tr.Eyelet(case["coefficient"], (case["gamma"],), variation=case["variation"])
    quiet = {name: case[name] for name in ("seed", "noise_N", "drift_N")}
    stuck = ""
    try:
        result = measure(bench(eyelet, **quiet), eyelet.angles_rad, sweeps=6)
    except RigError as error:
        stuck = str(error)
    if stuck:
        event("the cable stuck")
        # The tension returns as B^4 times the setpoint, which must exceed the preload.
        assert "did not slide through" in stuck
        assert slides_at(case["coefficient"], case["gamma"]) ** 4 < 0.6
    elif result.resolved:
        event("resolved")
        assert result.friction_coefficient.value == pytest.approx(eyelet.coefficient, rel=0.02)
    else:
        event("not resolved")
        assert result.warnings


@pytest.mark.parametrize(
    ("coefficient", "angles"), [(0.1, (2.1,)), (0.04, (2.6,)), (0.06, (2.2, 2.8))]
)
def test_procedure_resolves_the_default_bench(coefficient, angles):
    result = measure(bench(tr.Eyelet(coefficient, angles), seed=3), angles)
    assert result.resolved
    assert result.friction_coefficient.value == pytest.approx(coefficient, rel=0.01)
    assert result.curve.follows_coulomb
    B = math.prod(slides_at(coefficient, gamma) for gamma in angles)
    assert result.attenuation.value == pytest.approx(B, abs=0.01 * (1.0 - B))


def test_procedure_calibrates_the_gauge_of_the_other_reel():
    result = measure(bench(seed=4), (2.1,))
    calibration = result.calibration_y()
    tension = np.array([8.0, 15.0, 22.0, 30.0])
    measured = calibration.force_N([GAUGE_Y.reading(T) for T in tension])
    assert measured == pytest.approx(tension, rel=2e-3)


def test_growing_friction_is_detected_and_measured_at_mean_tension():
    eyelet = tr.Eyelet(growth_per_N=5e-4)
    result = measure(bench(eyelet, seed=3), eyelet.angles_rad)
    assert not result.curve.follows_coulomb
    assert any("Coulomb's law" in remark for remark in result.warnings)
    truth = eyelet.coefficient_at(result.mean_tension_N)
    assert result.friction_coefficient.value == pytest.approx(truth, rel=0.01)
    ratios = [B.value for B in result.ratio_at_setpoints()]
    assert ratios == sorted(ratios, reverse=True)
    assert result.transparency().log_spread > 1e-3


@pytest.mark.slow
def test_dynamic_ratio_is_measured_at_the_cable_velocity():
    eyelet = tr.Eyelet(dynamic_share=0.7, viscous_s_m=0.5)
    result = measure(
        bench(eyelet, seed=5),
        eyelet.angles_rad,
        setpoints_N=(15.0, 20.0, 25.0, 32.0, 40.0),
        holding="moving",
        velocity_m_s=0.02,
    )
    truth = eyelet.coefficient_at(0.0, 0.02)
    assert truth < 0.93 * eyelet.coefficient
    assert result.friction_coefficient.value == pytest.approx(truth, rel=0.02)


def test_breakout_holding_is_unbiased_with_a_fast_tension_controller():
    eager = tr.BenchDrive(position_lag_s=3.0, compliance_m_N=3e-5)
    excess = {}
    for holding in ("position", "breakout"):
        two = bench(tr.Eyelet(variation=0.0), noise_N=0.0, drive=eager)
        result = measure(two, (2.1,), holding=holding, sweeps=3, settle_s=1.0)
        excess[holding] = result.ratios - slides_at(0.1, 2.1)
    assert excess["position"].min() > 50.0 * np.abs(excess["breakout"]).max()


def test_noise_above_friction_gives_a_warning():
    eyelet = tr.Eyelet(0.01, (2.9,))
    result = measure(bench(eyelet, noise_N=0.3, drift_N=0.3), eyelet.angles_rad, preload_N=3.5)
    assert not result.resolved
    assert "no friction can be determined" in result.warnings[0]
    assert result.friction_coefficient.low <= 0.01 <= result.friction_coefficient.high


def test_sweeps_needed_follow_from_the_repeatability():
    eyelet = tr.Eyelet(variation=0.05)
    result = measure(bench(eyelet, seed=1), eyelet.angles_rad, sweeps=5)
    assert not result.resolved
    assert result.sweeps_needed > 5
    assert f"take about {result.sweeps_needed} sweeps" in result.warnings[0]
    # There the stated interval is as wide as the tolerance, 3.29 standard errors.
    error = result.friction_coefficient.standard_error * math.sqrt(5.0 / result.sweeps_needed)
    assert 3.29 * error == pytest.approx(0.02 * result.friction_coefficient.value, rel=0.1)


def test_uncertain_angle_widens_the_interval_with_a_warning():
    measurements = tr.TwoReelProcedure(SETPOINTS, preload_N=2.0, sweeps=4).run(bench(seed=2))
    exact, unsure = (
        tr.evaluate(measurements, (2.1,), angle_error_rad=error) for error in (0.0, 0.03)
    )
    # C_R is proportional to 1/cos(gamma/2): relative errors scale by tan(gamma/2)/2.
    expected = 0.5 * math.tan(1.05) * 0.03 * exact.friction_coefficient.value
    added = math.sqrt(
        unsure.friction_coefficient.standard_error**2
        - exact.friction_coefficient.standard_error**2
    )
    assert added == pytest.approx(expected, rel=0.05)
    assert unsure.sweeps_needed is None
    assert any("angles" in remark for remark in unsure.warnings)


def test_ratios_above_one_give_a_warning():
    rows = [m._replace(x_2_N=2.01 * m.x_1_N - m.x_2_N / 0.9**4) for m in drifting(0.0)]
    result = tr.evaluate(rows, [2.1])
    assert result.attenuation.value > 1.0
    assert not result.resolved
    assert result.friction_coefficient.low == 0.0
    assert result.friction_coefficient.high > 0.0
    assert result.transparency().friction_share == 0.0


def drifting(per_sweep):
    """Readings with friction that grows from sweep to sweep, and small noise."""
    noise = np.random.default_rng(0).normal(0.0, 1e-4, (6, 5))
    rows = []
    for sweep in range(6):
        for k, x in enumerate(SETPOINTS):
            B = 0.9 - per_sweep * sweep + noise[sweep, k]
            rows.append(tr.SetpointReadings(x, sweep, x, 3.0 + B**2 * x, B**4 * x, 3.0 + B**2 * x))
    return rows


def test_drift_between_sweeps_gives_a_warning():
    assert tr.evaluate(drifting(0.0), [2.1]).resolved
    result = tr.evaluate(drifting(0.0005), [2.1])
    assert not result.resolved
    assert any("drifts" in remark for remark in result.warnings)


@pytest.mark.slow
def test_exchanged_angles_separate_unequal_reels_only():
    for other, alike in ((0.1, True), (0.15, False)):
        runs = [
            measure(
                bench(tr.Eyelet(0.1, (a,)), other=tr.Eyelet(other, (b,)), seed=seed), (a,), (b,)
            )
            for seed, (a, b) in enumerate([(1.9, 2.5), (2.5, 1.9)])
        ]
        comparison = tr.compare_reels(*runs)
        assert comparison.alike is alike
        assert comparison.coefficient_x.value == pytest.approx(0.1, rel=0.03)
        assert comparison.coefficient_y.value == pytest.approx(other, rel=0.03)
    with pytest.raises(InvalidInput, match="exchange the angles"):
        tr.compare_reels(runs[0], runs[0])


def test_hysteresis_loop_has_the_slopes_of_the_ratio():
    two = bench(tr.Eyelet(variation=0.0), noise_N=0.0)
    loop = tr.HysteresisTest(6.0, 36.0).run(two)
    B = slides_at(0.1, 2.1)
    y = np.array([brentq(lambda T, r=r: GAUGE_Y.reading(T) - r, 0.0, 100.0) for r in loop.y])
    rising = (loop.rising == 1.0) & (loop.x_N > 1.2 * 6.0 / B**4)
    falling = (loop.rising == 0.0) & (loop.x_N < 36.0 * B**4 / 1.2)
    assert rising.sum() > 10
    assert y[rising] / loop.x_N[rising] == pytest.approx(B**2, rel=5e-3)
    assert y[falling] / loop.x_N[falling] == pytest.approx(B**-2, rel=5e-3)


def test_loop_and_procedure_agree_on_the_ratio():
    two = bench(seed=6)
    result = measure(two, (2.1,))
    loop = tr.HysteresisTest(6.0, 36.0).run(two, result.calibration_y(margin=0.4))
    assert loop.attenuation() == pytest.approx(result.attenuation.value, abs=2e-3)
    heavy = bench(tr.Eyelet(0.3, (1.2,)))
    with pytest.raises(InvalidInput, match="too narrow"):
        tr.HysteresisTest(10.0, 20.0).run(heavy).attenuation()


class FaultyBench:
    """Bench that records its commands; its gauges fail after some records."""

    def __init__(self, good_records):
        self.commands = []
        self.x, self.y = self._Reel("x", self.commands), self._Reel("y", self.commands)
        self._good, self._time = good_records, 0.0

    class _Reel:
        drum_radius_m = 0.025

        def __init__(self, name, commands):
            self._name, self._commands = name, commands

        def hold_tension(self, setpoint, within_s):  # noqa: ARG002  the protocol's
            self._commands.append((self._name, "tension"))

        def hold_position(self, angle_rad=None):  # noqa: ARG002  the protocol's
            self._commands.append((self._name, "position"))

        def hold_velocity(self, velocity_rad_s, force_ramp_N_s=0.0):  # noqa: ARG002  likewise
            self._commands.append((self._name, "velocity"))

    def record(self, duration_s):
        time = self._time + np.arange(1, 11) * duration_s / 10.0
        self._time += duration_s
        self._good -= 1
        level = 16.0 if self._good > 0 else math.nan
        side = tr.BenchReading(np.full(10, level), np.zeros(10))
        return tr.BenchRecord(time, side, side)


@pytest.mark.parametrize("good_records", [1, 3, 5, 6])
def test_reels_hold_their_position_after_a_gauge_failure(good_records):
    faulty = FaultyBench(good_records)
    procedure = tr.TwoReelProcedure((16.0, 17.0, 18.0, 19.0, 20.0), holding="position")
    with pytest.raises(RigError):
        procedure.run(faulty)
    assert faulty.commands[-2:] == [("x", "position"), ("y", "position")]


def test_missing_breakout_is_reported():
    with pytest.raises(RigError, match="did not break out"):
        tr.TwoReelProcedure((16.0, 17.0, 18.0, 19.0, 20.0)).run(FaultyBench(10**6))


# Bad input


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: tr.TwoReelProcedure((8.0, 16.0, 24.0, 32.0)), "5 or more"),
        (lambda: tr.TwoReelProcedure(SETPOINTS, sweeps=2), "3 or more"),
        (lambda: tr.TwoReelProcedure(SETPOINTS, preload_N=5.0), "twice"),
        (lambda: tr.TwoReelProcedure(SETPOINTS, holding="moving"), "velocity_m_s"),
        (lambda: tr.HysteresisTest(10.0, 5.0), "must rise"),
        (lambda: tr.Eyelet(angles_rad=(4.0,)), "in radians"),
        (lambda: tr.evaluate(drifting(0.0), [math.pi]), "straight cable"),
        (lambda: tr.evaluate(drifting(0.0)[:-1], [2.1]), "whole sweeps"),
        (lambda: tr.evaluate(drifting(0.0)[:10], [2.1]), "2 sweeps"),
        (
            lambda: tr.evaluate([m._replace(y_2=m.y_2 - 9.0) for m in drifting(0.0)], [2.1]),
            "too far off",
        ),
        (lambda: tr.evaluate(drifting(0.0), [3.1], angle_error_rad=0.1), "straight to within"),
    ],
)
def test_two_reel_procedure_rejects_bad_input_with_a_remedy(call, message):
    with pytest.raises(InvalidInput, match=message):
        call()
