"""Reels that hold a platform: equations, tension distribution, pose control."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from estune.core.gains import Gains
from estune.errors import InvalidInput, RigError
from estune.reel.hybrid import SwitchingRules
from estune.trial import Feedback, Setpoint
from experiments.paper.cable_platform import PoseController, distribute
from plants.bench.cable_platform import Simulation
from plants.bench.cable_platform.examples import platform
from plants.bench.cable_platform.real_time import RealTimePlatform
from plants.models.reel import SAFE_GAINS

TUNED = Gains(P=1.055, I=28.1, D=0.0178, setpoint_filter_s=0.0018)
LOW_N, HIGH_N = 5.0, 40.0
MECHANISM, _ = platform()
EVERY = 6
"""Samples from one setpoint to the next: 105 per second."""


def jacobian(pose) -> np.ndarray:
    return np.asarray(MECHANISM.kinematics(pose)[1])


coordinate = st.floats(-0.15, 0.15)
poses = st.tuples(coordinate, coordinate, st.floats(-0.2, 0.2))
force = st.floats(-60.0, 60.0)


@settings(deadline=None, max_examples=40)
@given(poses, st.tuples(force, force, st.floats(-2.0, 2.0)))
def test_distribution_balances_the_wrench_nearest_to_the_middle_or_none_can(pose, wrench):
    J, wrench = jacobian(pose), np.array(wrench)
    found = distribute(J, wrench, LOW_N, HIGH_N)
    best = minimize(
        lambda t: ((t - 22.5) ** 2).sum(),
        np.full(4, 22.5),
        jac=lambda t: 2.0 * (t - 22.5),
        bounds=[(LOW_N, HIGH_N)] * 4,
        constraints={"type": "eq", "fun": lambda t: -J.T @ t - wrench, "jac": lambda _: -J.T},
        method="SLSQP",
    )
    balanced = best.success and np.abs(-J.T @ best.x - wrench).max() < 1e-6
    if found is None:
        assert not balanced
        return
    assert -J.T @ found == pytest.approx(wrench, abs=1e-9)
    assert found.min() >= LOW_N - 1e-9
    assert found.max() <= HIGH_N + 1e-9
    if balanced:
        assert found == pytest.approx(best.x, abs=1e-3)


def test_distribution_of_other_redundancies_is_refused():
    with pytest.raises(InvalidInput, match="one more cable"):
        distribute(np.ones((3, 3)), np.zeros(3), LOW_N, HIGH_N)


def test_tensions_outside_the_eyelets_stay_within_the_friction_limits():
    simulation = Simulation(MECHANISM)
    simulation._noise_N = np.zeros(4)
    random = np.random.default_rng(0)
    for _ in range(300):
        simulation.setpoints.tension_N[:] = random.uniform(LOW_N, HIGH_N, 4)
        for _ in range(4):
            simulation.sample()
        theta, slid = simulation._state[:20].reshape(4, 5)[:, [0, 2]].T
        inside = np.maximum(0.0, 20e3 * (0.025 * theta - slid))
        assert (simulation.outside_N >= 0.99 * inside - 1e-6).all()
        assert (simulation.outside_N <= inside / 0.99 + 1e-6).all()


def make_controller() -> PoseController:
    return PoseController(
        MECHANISM,
        natural_rad_s=10.0,
        damping_ratio=1.0,
        rules=SwitchingRules(LOW_N, 1.0),
        tension_max_N=HIGH_N,
    )


def track(gains: Gains) -> tuple[np.ndarray, np.ndarray]:
    """Errors of pose and of its estimate while the platform moves in simulated time."""
    simulation = Simulation(MECHANISM, [gains] * 4)
    controller = make_controller()
    errors, estimates = [], []
    for k in range(2000):
        if k % EVERY == 0:
            t = k / MECHANISM.sampling_Hz
            readings = zip(simulation.tension_N, simulation.angle_rad, strict=True)
            feedback = [Feedback(t, float(T), float(a), 0.0) for T, a in readings]
            w = 2.0
            wanted = 0.1 * np.array([np.sin(w * t), 0.0, 0.0])
            speed = 0.1 * w * np.array([np.cos(w * t), 0.0, 0.0])
            wanted_setpoints = controller.update(feedback, wanted, speed, -(w**2) * wanted)
            for n, setpoint in enumerate(wanted_setpoints):
                simulation.setpoints.tension_N[n] = setpoint.tension_N
            errors.append(simulation.pose - wanted)
            estimates.append(controller.pose - simulation.pose)
        simulation.sample()
    half = len(errors) // 2
    return np.array(errors)[half:], np.array(estimates)[half:]


def test_platform_on_tuned_reels_follows_better_than_on_untuned_ones():
    (untuned, estimate), (tuned, _) = (track(gains) for gains in (SAFE_GAINS, TUNED))
    assert np.abs(estimate[:, :2]).max() < 1e-3
    rms = [np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()) for errors in (tuned, untuned)]
    assert rms[0] < 0.6 * rms[1]


def test_reels_hold_their_position_where_no_tensions_balance_the_wrench():
    controller = make_controller()
    home, far, still = np.zeros(3), np.array([2.0, 0.0, 0.0]), np.zeros(3)

    def update(angle_rad: float, tension_N: float, wanted) -> set[float | None]:
        feedback = [Feedback(0.0, tension_N, angle_rad, 0.0)] * 4
        setpoints = controller.update(feedback, wanted, still, still)
        assert all(LOW_N <= setpoint.tension_N <= HIGH_N for setpoint in setpoints)
        return {setpoint.angle_rad for setpoint in setpoints}

    assert update(0.1, 15.0, home) == {None}
    assert update(0.11, 15.0, far) == {0.11}
    assert update(0.12, 15.0, far) == {0.11}  # the angle at the switch
    assert update(0.12, LOW_N - 0.1, far) == {None}  # a slack cable is taken in
    assert update(0.13, 15.0, home) == {None}


def follow_often(running: RealTimePlatform) -> None:
    for _ in range(1000):
        running.follow(0, Setpoint(10.0))
        time.sleep(0.01)


def test_reels_of_a_failed_simulation_refuse_setpoints(monkeypatch):
    with RealTimePlatform(MECHANISM) as running:
        monkeypatch.setattr(running.simulation, "sample", lambda: 1 / 0)
        with pytest.raises(RigError, match="the simulation has failed: division by zero"):
            follow_often(running)
