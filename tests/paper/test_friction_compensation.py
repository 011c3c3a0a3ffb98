import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from estune.errors import InvalidInput
from estune.reel.friction import StribeckFriction
from estune.reel.velocity import DrumMotion, Windows
from experiments.paper.demonstrations.friction_compensation import (
    FeedForward,
    reference_wrench_trial,
    run_high_and_low,
    run_wrench,
)
from experiments.paper.identify.friction_ramp import fit_friction
from experiments.paper.identify.torque_ramp import RampRecord

DRY = StribeckFriction(coulomb_Nm=0.02, static_Nm=0.03, stribeck_rad_s=0.8)
COUNTS = 8192.0


torques = st.floats(0.001, 1.0)


@st.composite
def identified_friction(draw):
    coulomb = draw(torques)
    return StribeckFriction(coulomb, coulomb + draw(torques), draw(st.floats(0.01, 10.0)))


@given(
    identified=identified_friction(),
    fraction=st.floats(0.0, 0.99),
    velocity=st.floats(-50.0, 50.0),
    bound=st.one_of(st.just(0.0), st.floats(1e-6, 10.0), st.just(math.inf)),
    truth=st.floats(1.0, 3.0),
)
def test_compensation_never_drives_a_drum_of_less_friction(
    identified, fraction, velocity, bound, truth
):
    forward = FeedForward(identified, 2e-3, fraction)

    def given_at(v):
        return forward.friction_Nm(DrumMotion(v, bound, 0.01, 0.0, 1.0))

    share = truth * fraction
    true = StribeckFriction(
        share * identified.coulomb_Nm, share * identified.static_Nm, identified.stribeck_rad_s
    )
    given_Nm = given_at(velocity)
    assert velocity * (true.torque_Nm(velocity) - given_Nm) >= -1e-14
    assert given_at(-velocity) == -given_Nm
    if bound > 0.0:  # no step at rest, however fine the velocity
        steepest = 0.0 if math.isinf(bound) else identified.static_Nm / bound
        assert abs(given_at(1e-9)) <= steepest * 1e-9


def test_compensation_above_the_noise_is_a_fraction_of_friction():
    v = np.array([-3.0, -0.5, 0.2, 0.8, 5.0])
    motion = DrumMotion(v, np.full(5, 0.1), 0.01, np.zeros(5), 1.0)
    assert FeedForward(DRY, 0.0, 0.7).friction_Nm(motion) == pytest.approx(0.7 * DRY.torque_Nm(v))


def unstable_wrench_trial(coefficient_share, noise_counts):
    """Small force on a reel of high friction, with the given errors of the compensation."""
    trial = reference_wrench_trial()
    reel = replace(trial.platform.reel, tension_N=trial.platform.reel.tension_min_N)
    coulomb, static, velocity = 0.08, 0.12, 0.5
    assumed = StribeckFriction(coefficient_share * coulomb, coefficient_share * static, velocity)
    count = 2.0 * math.pi / reel.encoder_counts
    dry = StribeckFriction(coulomb, static, velocity)
    return replace(
        trial,
        platform=replace(trial.platform, reel=reel, friction=dry),
        feed_forward=FeedForward(assumed, 0.0, trial.feed_forward.fraction),
        windows=Windows((1.0 + 6.0 * noise_counts) * count),
        wrench_N=0.1,
        encoder_noise_rad=noise_counts * count,
    )


def run_limits(trial):
    """Trial with (10) fed forward at the estimated velocity and at its limits."""
    dry = trial.feed_forward.friction
    unlimited = run_wrench(trial, lambda motion: float(dry.torque_Nm(motion.velocity_rad_s)))
    return unlimited, run_wrench(trial)


def test_limits_prevent_instability_at_high_friction_coefficients():
    shaking = {}
    for share in (1.0, 3.0):
        for noise in (0.0, 0.3):
            free, limited = run_limits(unstable_wrench_trial(share, noise))
            shaking[share, noise] = np.std(free.tension_N) / np.std(limited.tension_N)
            assert limited.tension_N.min() > 4.5  # of 5 N
    assert shaking[3.0, 0.3] > 10.0
    del shaking[3.0, 0.3]  # one cause alone has no effect
    assert max(shaking.values()) < 1.2
    free, _ = run_limits(unstable_wrench_trial(3.0, 1.0))
    assert free.tension_N.min() < 0.5


def test_inertia_is_compensated_at_high_speed_only():
    high, low = run_high_and_low(reference_wrench_trial())
    assert np.mean(high.inertia_N != 0.0) > 0.5
    residual = np.std(high.true_inertia_N - high.inertia_N)
    assert residual < 0.5 * np.std(high.true_inertia_N)
    assert (low.inertia_N == 0.0).all()
    for traces in (high, low):  # never overcompensated
        moving = np.abs(traces.velocity_rad_s) > 0.3
        assert np.mean(np.abs(traces.friction_N[moving]) > 0.5) > 0.8
        assert np.abs(traces.friction_N).max() <= np.abs(traces.true_friction_N).max()


TRUTH = {"inertia": 2e-3, "viscous": 0.022, "coulomb": 0.02, "static": 0.03, "stribeck": 0.8}


@cache
def ramp(
    *,
    slope=0.03,
    duration=3.5,
    rate=200.0,
    phase=0.3,
    sign=1.0,
    held=False,
    stiffness=None,
    **truth,
):
    """A torque ramp on a drum, integrated by scipy with an event at break-away."""
    p = {**TRUTH, **truth}
    t = np.arange(round(duration * rate)) / rate
    late = 1.5 / rate if held else 0.0  # a held command, and a sample of dead time

    def dry(v):
        return p["coulomb"] + (p["static"] - p["coulomb"]) * math.exp(-((v / p["stribeck"]) ** 2))

    def torque(now):
        now = math.floor(now * rate + 1e-9) / rate - 1.0 / rate if held else now
        return slope * max(now, 0.0)

    def slipping(now, x):
        return [x[1], (torque(now) - p["viscous"] * x[1] - dry(x[1])) / p["inertia"]]

    def bristly(now, x):
        z_rate = x[1] - stiffness * abs(x[1]) * x[2] / dry(x[1])
        friction = stiffness * x[2] + 0.02 * z_rate + p["viscous"] * x[1]
        return [x[1], (torque(now) - friction) / p["inertia"], z_rate]

    if stiffness is None:
        starts, law, x = min(p["static"] / slope + late, t[-1]), slipping, [0.0, 0.0]
    else:
        starts, law, x = 0.0, bristly, [0.0, 0.0, 0.0]
    solved = solve_ivp(
        law, (starts, t[-1] + 1.0), x, "LSODA", rtol=1e-9, atol=1e-12, max_step=1.0 / rate,
        dense_output=True,
    )  # fmt: skip
    turned = np.where(t > starts, solved.sol(np.maximum(t, starts))[0], 0.0)
    count = 2.0 * math.pi / COUNTS
    angle = sign * np.floor(turned / count + phase) * count
    return RampRecord(t, sign * slope * t, angle, COUNTS, dead_time_s=late)


def estimates(fit):
    return {
        "inertia": fit.inertia_kgm2,
        "viscous": fit.viscous_Nms_rad,
        "coulomb": fit.coulomb_Nm,
        "static": fit.static_Nm,
        "stribeck": fit.stribeck_rad_s,
    }


def test_ramps_in_both_directions_recover_friction_and_inertia():
    fit = fit_friction([ramp(held=True), ramp(held=True, sign=-1.0, slope=0.05)], 0.999)
    for name, estimate in estimates(fit).items():
        assert estimate.low <= TRUTH[name] <= estimate.high, name
        assert estimate.value == pytest.approx(TRUTH[name], rel=0.03), name
    assert fit.residual_counts == pytest.approx(1.0 / math.sqrt(12.0), rel=0.1)  # rounding


@pytest.mark.slow
def test_bias_by_presliding_falls_with_its_stiffness():
    off = {}
    for stiffness in (60.0, 300.0):  # the drum creeps half a count before it slips, and a tenth
        estimate = estimates(fit_friction([ramp(stiffness=stiffness, rate=316.0)]))
        off[stiffness] = {name: abs(e.value / TRUTH[name] - 1.0) for name, e in estimate.items()}
    for name in ("coulomb", "static", "inertia", "stribeck"):
        assert off[300.0][name] < 0.3 * off[60.0][name], name
        assert off[300.0][name] < 0.05, name


def drawn_ramp(rng):
    """Ramp on a randomly drawn drum, and its true parameters."""
    spread = np.exp(0.2 * rng.normal(size=5))
    truth = dict(zip(TRUTH, np.array(list(TRUTH.values())) * spread, strict=True))
    truth["static"] = truth["coulomb"] * rng.uniform(1.3, 1.9)
    return ramp(duration=2.6, phase=rng.random(), **truth), truth


@pytest.mark.slow
@pytest.mark.parametrize("fits", [4, pytest.param(100, marks=pytest.mark.nightly)])
def test_confidence_intervals_match_the_spread_of_estimates(fits):
    rng, scores = np.random.default_rng(0), []
    for _ in range(fits):
        record, truth = drawn_ramp(rng)
        estimate = estimates(fit_friction([record], confidence=0.9))
        # Error in standard deviations; a 90 % interval is 1.645 of them to either side.
        scores.append(
            [1.645 * math.log(e.value / truth[n]) / math.log(e.high / e.value)
             for n, e in estimate.items()]
        )  # fmt: skip
    misfit = np.sum(np.square(scores), axis=0)
    least, greatest = chi2.ppf([0.001, 0.999], fits)
    assert (least < misfit).all()
    assert (misfit < greatest).all()


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (lambda: ramp(static=0.2, coulomb=0.1), "no break-away"),
        (lambda: replace(ramp(), torque_Nm=0.05 * np.sin(ramp().time_s)), "not monotone"),
        (lambda: replace(ramp(), torque_Nm=np.zeros(700)), "ends at 0 N m"),
        (lambda: replace(ramp(), angle_rad=0.1 * ramp().time_s), "moves from sample"),
        (lambda: replace(ramp(), angle_rad=np.full(700, math.nan)), "not finite"),
        (lambda: replace(ramp(), time_s=ramp().time_s ** 2), "constant rate"),
        (lambda: replace(ramp(), time_s=ramp().time_s[:-1]), "equally long"),
        (lambda: replace(ramp(), dead_time_s=-1.0), "dead time"),
        (lambda: ramp(duration=0.1), "80 or more"),
    ],
)
def test_record_without_friction_information_is_refused(record, message):
    with pytest.raises(InvalidInput, match=message):
        record()


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (lambda: ramp(slope=3.0, duration=0.5, static=0.3, coulomb=0.02), "slower ramp"),
        pytest.param(lambda: ramp(stribeck=8.0), "end the ramp higher", marks=pytest.mark.slow),
        (lambda: ramp(static=0.02), "Coulomb friction alone|slower ramp"),
    ],
)
def test_ramp_too_fast_for_the_stribeck_velocity_is_refused(record, message):
    with pytest.raises(InvalidInput, match=message):
        fit_friction([record()])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: FeedForward(DRY, -1.0), "inertia"),
        (lambda: FeedForward(DRY, 1e-3, 1.0), "below 1"),
        (lambda: fit_friction([]), "one or more"),
        (lambda: fit_friction([ramp()], confidence=95.0), "between 0 and 1"),
    ],
)
def test_bad_input_is_refused_with_its_remedy(call, message):
    with pytest.raises(InvalidInput, match=message):
        call()
