import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from estune.errors import InvalidInput
from estune.reel.friction import StribeckFriction
from estune.reel.velocity import DrumMotion, Windows
from plants.bench.demonstrations.friction_compensation import (
    FeedForward,
    reference_wrench_trial,
    run_high_and_low,
    run_wrench,
)

DRY = StribeckFriction(coulomb_Nm=0.02, static_Nm=0.03, stribeck_rad_s=0.8)
COUNTS = 8192.0


def lugre_steady_friction(velocity, stiffness=50.0):
    """Steady friction at constant velocity by integration of the LuGre model."""
    fade = math.exp(-((velocity / DRY.stribeck_rad_s) ** 2))
    g = DRY.coulomb_Nm + (DRY.static_Nm - DRY.coulomb_Nm) * fade

    def rate(_, z):
        return velocity - stiffness * abs(velocity) * z / g

    solved = solve_ivp(rate, (0.0, 0.1 / abs(velocity)), [0.0], "Radau", rtol=1e-10, atol=1e-16)
    return stiffness * solved.y[0, -1]


@pytest.mark.equation(10)
@pytest.mark.parametrize("velocity", [-5.0, -0.7, -0.01, 0.02, 0.4, 0.8, 3.0])
def test_stribeck_friction_is_the_steady_state_of_the_lugre_model(velocity):
    assert DRY.torque_Nm(velocity) == pytest.approx(lugre_steady_friction(velocity), rel=1e-6)


@pytest.mark.equation(10)
def test_stribeck_friction_has_its_static_and_dynamic_limits():
    v = np.array([-1e-9, 0.0, 1e-9, 100.0])
    assert DRY.torque_Nm(v) == pytest.approx([-0.03, 0.0, 0.03, 0.02])


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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: StribeckFriction(0.03, 0.02, 1.0), "static one not below"),
        (lambda: StribeckFriction(-0.1, 0.02, 1.0), "zero or above"),
        (lambda: StribeckFriction(0.02, 0.03, 0.0), "Stribeck velocity"),
        (lambda: StribeckFriction(0.02, math.nan, 1.0), "not finite"),
        (lambda: FeedForward(DRY, -1.0), "inertia"),
        (lambda: FeedForward(DRY, 1e-3, 1.0), "below 1"),
    ],
)
def test_bad_input_is_refused_with_its_remedy(call, message):
    with pytest.raises(InvalidInput, match=message):
        call()
