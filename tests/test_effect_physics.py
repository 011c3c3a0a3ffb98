"""Each law of drive and drum against an independent calculation."""

import numpy as np
import pytest
from scipy import integrate, signal

import plants
from estune.reel.friction import StribeckFriction
from plants.conformance.reel_runs import RATE, REEL, rest, rollout, wander
from plants.effects import EFFECTS
from plants.effects.bristles import bent
from plants.models.reel_equations import cable_stiffness_N_m
from tests import test_cable_effect_physics as cable
from tests.support_effects import TAUT, J, Kt, Law, R, SUBSTEP_s, b, k
from tests.test_plants import integrated


def coulomb_friction(effect):
    """Against the velocity while it slips, and just enough to stop where it sticks."""
    law = Law(effect(torque_Nm=0.3))
    creeping = Law(effect(torque_Nm=0.3, creep_rad_s=0.05))
    for velocity in (-3.0, -0.1, 0.1, 3.0):
        assert law.pass_(0.0, velocity=velocity) == -0.3 * np.sign(velocity)
        assert creeping.pass_(0.0, velocity=velocity) == -0.3 * np.sign(velocity)
    assert law.pass_(0.0, velocity=1e-8) == pytest.approx(-0.01)  # the mass is 1e6 N m s/rad
    assert creeping.pass_(0.0, velocity=0.01) == pytest.approx(-0.06, rel=1e-4)


def stribeck_friction(effect):
    """The curve that the reel feeds forward, once the bristles slip."""
    law = Law(effect(coulomb_Nm=0.3, excess_Nm=0.2, stribeck_rad_s=0.4, presliding_rad=1e-7))
    curve = StribeckFriction(0.3, 0.5, 0.4)
    velocities = np.concatenate([-np.geomspace(20.0, 1e-3, 60), np.geomspace(1e-3, 20.0, 60)])
    found = [[law.pass_(0.0, velocity=v) for _ in range(10)][-1] for v in velocities]
    assert found == pytest.approx(-curve.torque_Nm(velocities), rel=1e-5)


def dahl_hysteresis(effect):
    """The loop between two reversals has the exponential's sides, of either length."""
    d, spread = 0.006, 2.0
    law = Law(effect(torque_Nm=0.2, presliding_rad=d, spread=spread))
    lengths = np.array([d, d / spread])
    for velocity in (1.0, -1.0, 1.0):
        before, turned, found = np.ravel(law.state), 0.0, []
        for _ in range(60):
            found.append(law.pass_(0.0, velocity=velocity))
            turned += abs(velocity) * SUBSTEP_s
        middle = (np.arange(60)[:, None] + 0.5) * SUBSTEP_s
        expected = velocity + ((before - velocity) * np.exp(-middle / lengths)).mean(axis=1)
        # The torque is that of the mean at a substep's two ends: h^2/8 of the curvature off.
        assert -np.array(found) / 0.2 == pytest.approx(expected, abs=0.006)


def test_stiff_bristles_do_not_make_a_light_drum_ring():
    light = plants.reference_reel(
        drum_inertia_kg_m2=2e-5, viscous_friction_Nms=0.0, viscous_friction_per_length_Ns=0.0
    )
    reel = light + EFFECTS["dahl_hysteresis"](torque_Nm=2.0, presliding_rad=1e-4)
    seen = rollout(reel, np.where(np.arange(600) < 3, 15.8, 15.0))
    bending = 0.8 * R / (2.0 / 1e-4)  # under the pull of 0.8 N
    assert np.abs(seen.theta - seen.theta[0]).max() < 4.0 * bending


def viscous_damping(effect):
    """A free swing dies away as (b + b_added)/(2 J) says."""
    reel = REEL + effect(damping_Nms=0.02)
    seen = rollout(reel, np.where(np.arange(400) < 2, 18.0, 15.0))
    swing = seen.theta - seen.theta[0]
    w = np.sqrt(k * R**2 / J - ((b + 0.02) / (2 * J)) ** 2)
    a = (b + 0.02) / (2 * J)
    size = np.hypot(swing, (seen.omega + a * swing) / w)[5:]
    fall = np.polyfit(np.arange(size.size) / RATE, np.log(size), 1)[0]
    assert fall == pytest.approx(-a, rel=1e-3)


def bent_viscous_friction(effect):
    """A free swing in a drag that grows with the square of the velocity, and in one that bends."""
    for bend in (0.02, -2e-4):
        seen = rollout(REEL + effect(bend_Nms2=bend), np.where(np.arange(300) < 2, 18.0, 15.0))

        def moved(_, x, bend=bend):
            return [x[1], -(k * R**2 * x[0] + b * x[1] + bend * abs(x[1]) * x[1]) / J]

        start, t = 10, np.arange(290) / RATE
        begun = [seen.theta[start] - 15.0 / (k * R), seen.omega[start]]
        exact = integrate.solve_ivp(moved, (0.0, t[-1]), begun, t_eval=t, rtol=1e-9, atol=1e-12)
        found = seen.theta[start:] - 15.0 / (k * R)
        assert found == pytest.approx(exact.y[0], abs=5e-3 * np.abs(exact.y[0]).max())


def directional_friction(effect):
    """A free swing whose damping depends on the direction, either way."""
    for more in (0.03, -0.03):
        seen = rollout(
            REEL + effect(difference_Nms=more), np.where(np.arange(300) < 2, 18.0, 15.0)
        )

        def moved(_, x, more=more):
            drag = b + 0.5 * more * np.sign(x[1])
            return [x[1], -(k * R**2 * x[0] + drag * x[1]) / J]

        start, t = 10, np.arange(290) / RATE
        begun = [seen.theta[start] - 15.0 / (k * R), seen.omega[start]]
        exact = integrate.solve_ivp(moved, (0.0, t[-1]), begun, t_eval=t, rtol=1e-8, atol=1e-12)
        found = seen.theta[start:] - 15.0 / (k * R)
        assert found == pytest.approx(exact.y[0], abs=5e-3 * np.abs(exact.y[0]).max())


def load_friction(effect):
    """A share of the tension against the motion, and just enough to stop where it sticks."""
    law = Law(effect(load_share=0.1))
    for velocity, tension in ((-3.0, 12.0), (0.1, 30.0), (2.0, -5.0), (1.0, 0.0)):
        found = law.pass_(0.0, velocity=velocity, tension=tension)
        assert found == pytest.approx(-0.1 * R * abs(tension) * np.sign(velocity))
    assert law.pass_(0.0, velocity=1e-9, tension=30.0) == pytest.approx(-0.001)


def current_lag(effect):
    """The mean over each sample of a lag's response to a command held between samples."""
    lag, u = 2.3e-3, wander(60, -2.0, 4.0)
    law = Law(effect(lag_s=lag))
    law.settle(u[0])
    found = np.array([law.pass_(one) for one in u])
    fine = np.repeat(u, 400)
    time = np.arange(fine.size) / (400 * RATE)
    _, current, _ = signal.lsim(([1.0], [lag, 1.0]), fine - u[0], time)
    means = u[0] + current.reshape(-1, 400).mean(axis=1)
    assert found == pytest.approx(means, abs=5e-3 * np.ptp(u))


def dead_time(effect):
    """The differential equation with a longer dead time."""
    for samples in (0.4, 1.0, 2.3):
        late = REEL + effect(delay_s=samples / RATE)
        same = plants.reference_reel(dead_time_s=(1.0 + samples) / RATE)
        found = rollout(late, TAUT[:80]).tension
        assert found == pytest.approx(integrated(same, TAUT[:80]), abs=2e-8)


def current_saturation(effect):
    """No more current than the limit, and no more tension than that holds."""
    seen = rollout(REEL + effect(limit_A=1.3), np.full(600, 60.0))
    assert np.abs(seen.current).max() == pytest.approx(1.3, abs=1e-9)
    assert seen.tension[-1] == pytest.approx(1.3 * Kt / R, rel=1e-3)
    # A bend half as wide as the limit: straight below 0.5, flat above 1.5, a quarter of the half
    # width less where they would meet, and the slope between is their mean.
    commanded = np.array([0.4, 0.999, 1.0, 1.001, 1.6])
    law = effect(limit_A=1.0, bend=0.5)
    through = np.array([float(law.respond(law, 0.0, u, None)[1]) for u in commanded])
    assert through[[0, 2, 4]] == pytest.approx([0.4, 0.875, 1.0])
    assert (through[3] - through[1]) / 0.002 == pytest.approx(0.5)
    back = [float(law.rest(law, 0.0, i, None)[1]) for i in through[:4]]
    assert back == pytest.approx(commanded[:4])


def rate_limit(effect):
    """A step becomes a ramp that arrives when the rate says."""
    for to in (35.0, -5.0):
        seen = rollout(REEL + effect(rate_A_per_s=25.0), np.full(60, to))
        moved = np.abs(seen.current - seen.current[0])
        # The command comes a sample late; a thousand moments of each sample tell its mean.
        moments = (np.arange(60 * 1000) + 0.5) / 1000.0 - 1.0
        ramp = np.clip(25.0 * moments / RATE, 0.0, 1.0).reshape(60, 1000)
        assert moved == pytest.approx(ramp.mean(axis=1), abs=1e-6)


def sticking_actuator(effect):
    """He's valve in whole numbers, where it breaks away at 4 and stops 2 short; a dead band."""
    commands = np.array([0.0, 4.0, 5.0, 6.0, 7.0, 8.0, 3.0, 0.0, -1.0])
    positions = np.array([0.0, 0.0, 3.0, 3.0, 3.0, 6.0, 6.0, 2.0, 2.0])
    for weight in (0.0, 0.5, 1.0):
        law = Law(effect(weight=weight, band_A=6.0, slip=1.0 / 3.0))
        law.settle(0.0)
        found = [law.pass_(command) for command in commands]
        assert found == pytest.approx(commands + weight * (positions - commands))
    play = Law(effect(band_A=2.0, slip=0.0))
    play.settle(0.0)
    found = [play.pass_(command) for command in (0.5, 3.0, 2.0, 1.0, 0.0)]
    assert found == pytest.approx([0.0, 2.0, 2.0, 2.0, 1.0])


def gain_error(effect):
    """Less command holds the same tension."""
    assert rest(REEL + effect(error=0.25))[1] == pytest.approx(15.0 / 1.25)


def torque_ripple(effect):
    """The command at rest makes up for it, and on the move it is the sine of the angle."""
    reel = REEL + effect(amplitude_Nm=0.05, per_turn=40.0, phase_rad=0.7)
    state, effort = rest(reel)
    assert effort == pytest.approx(15.0 + 0.05 * np.sin(40.0 * state[0] + 0.7) / R)
    law = Law(reel.effects[0])
    angles = np.cumsum(np.r_[0.1, 8.0 * SUBSTEP_s * np.cos(np.arange(1000) / 180.0)])
    law.settle(0.0, angle=angles[0])
    found = [law.pass_(0.0, angle=angle) for angle in angles]
    assert found == pytest.approx(-0.05 * np.sin(40.0 * angles + 0.7), abs=1e-6)


def cogging(effect):
    """The sum of sines of the angle."""
    waves = (
        (0.3, 7.0, 0.4),
        (0.1, 28.0, -1.0),
        (0.05, 12.0, 2.0),
        (0.02, 36.0, 0.5),
        (0.0, 1.0, 0.0),
    )
    names = ("amplitude_{}_Nm", "per_turn_{}", "phase_{}_rad")
    law = Law(
        effect(
            **{
                n.format(k): v
                for k, w in enumerate(waves, 1)
                for n, v in zip(names, w, strict=True)
            }
        )
    )
    angles = np.cumsum(np.r_[0.1, 8.0 * SUBSTEP_s * np.cos(np.arange(750) / 900.0)])
    law.settle(0.0, angle=angles[0])
    torque = [law.pass_(0.0, angle=angle) for angle in angles]
    expected = -sum(size * np.sin(order * angles + phi) for size, order, phi in waves)
    assert torque == pytest.approx(expected, abs=1e-5)


def link_gravity(effect):
    """The work that it takes off the drum is the energy of a pendulum."""
    size, phi = 0.3, 0.7
    law = Law(effect(torque_Nm=size, phase_rad=phi))
    angles = np.cumsum(np.r_[0.1, 8.0 * SUBSTEP_s * np.cos(np.arange(1000) / 180.0)])
    law.settle(0.0, angle=angles[0])
    torque = np.array([law.pass_(0.0, angle=angle) for angle in angles])
    work = np.cumsum(0.5 * (torque[1:] + torque[:-1]) * np.diff(angles))
    potential = -size * np.cos(angles + phi)
    assert work == pytest.approx(potential[0] - potential[1:], abs=1e-4 * size)


def backlash(effect):
    """Two masses that collide without rebound, in steps a hundred times as small."""
    m, play = 0.4, 0.02
    thrown = np.where(np.arange(240) % 80 < 30, -5.0, 4.0)
    thrown[:5] = 4.0
    for F in (0.0, 0.01):
        rough = REEL + EFFECTS["coulomb_friction"](torque_Nm=F)
        seen = rollout(rough + effect(play_rad=play, motor_share=m), thrown, 4.0)
        closed = rollout(rough, thrown, 4.0)
        found = two_masses(seen.current, 4.0, m, play, F)
        assert np.abs(seen.theta - found).max() < 0.1 * np.abs(seen.theta - closed.theta).max()


def two_masses(currents, preload, m, play, F):
    """The motor's angle at each sample; the drum has the friction."""
    per_rad, h = cable_stiffness_N_m(REEL, preload) * R, SUBSTEP_s / 100.0
    theta = phi = preload / per_rad
    omega = rate = 0.0
    found = []
    for current in currents:
        found.append(theta)
        for _ in range(400):
            omega += h * (Kt * current / m - b * omega) / J
            rate += h * (-R * max(per_rad * phi, 0.0) / (1.0 - m) - b * rate) / J
            theta, phi = theta + h * omega, phi + h * rate
            most = h * F / ((1.0 - m) * J)
            # What overlaps stays until the next step, in which the two turn as one.
            if (phi <= theta and rate < omega) or (phi >= theta + play and rate > omega):
                omega = rate = m * omega + (1.0 - m) * rate
                most *= 1.0 - m
                omega -= min(max(omega, -most), most)
                rate = omega
            else:
                rate -= min(max(rate, -most), most)
    return found


def test_bristles_bend_as_the_exponential_says():
    for z in (-1.0, -0.4, 0.9):
        for travel in (-0.5, -0.1, 1e-3, 0.3):
            s = np.sign(travel)
            exact = s + (z - s) * np.exp(-abs(travel))
            bound = abs(z - s) * travel**4 / 24.0 + 1e-15
            assert abs(z + float(bent(z, travel)) - exact) <= bound
        assert z + float(bent(z, 40.0)) == pytest.approx(1.0)


CHECKS = {name: check for name, check in (vars(cable) | globals()).items() if name in EFFECTS}


@pytest.mark.parametrize("name", EFFECTS)
def test_it_follows_an_independent_calculation(name):
    CHECKS[name](EFFECTS[name])
