"""Laws of cable, eyelet and gauge, which test_effect_physics tests with the others."""

import control
import numpy as np
import pytest
from scipy import integrate, optimize, signal, stats

import plants
from plants.conformance.reel_runs import RATE, REEL, rest, rollout, wander
from plants.diagnosis.models.calibration import SaggingCalibration
from plants.effects import EFFECTS, Port
from plants.models.reel_equations import cable_stiffness_N_m
from tests.support_effects import TAUT, J, Law, R, SUBSTEP_s, b, k

INTO_SLACK = wander(200, -4.0, 45.0)


def gripped(law, T, speed, substeps):
    """Ratio of the tensions inside and outside of an eyelet as the drum winds in from rest."""
    B, c = law.effect.attenuation, law.effect.inner_share
    a, creep = law.effect.knee, law.effect.creep_rad_s
    x = min(speed / creep, 1.5)
    goal = x - 4.0 * x**3 / 27.0

    def ratio(z):
        return 1.0 + z * (1 / B - B) / 2 + z**2 * (1 / B + B - 2) / 2

    def rate(_, z):
        inside = T * ratio(z) / (1 - c + c * ratio(z))
        left = np.maximum((goal - z) / 2, 0.0)
        built_up = 2.0 * (1.0 + a) * left / (left + a)  # in a length
        return built_up * k * R * (speed + creep) / (2.0 * inside * np.log(1 / B) * c)

    at = SUBSTEP_s * np.arange(1, substeps + 1)
    done = integrate.solve_ivp(rate, (0.0, at[-1]), [0.0], "Radau", at, rtol=1e-7, atol=1e-7)
    return ratio(done.y[0])


def eyelet_friction(effect):
    """Slides in with T_o = B T and out with T = B T_o, and sticks first after a reversal."""
    B, c = 0.8, 0.3
    slow = plants.reference_reel(viscous_friction_Nms=0.3)
    there_and_back = np.r_[np.linspace(15.0, 35.0, 800), np.linspace(35.0, 15.0, 800)]
    seen = rollout(slow + effect(attenuation=B, inner_share=0.01), there_and_back)
    assert seen.outside[799] == pytest.approx(B * seen.tension[799], rel=1e-3)
    assert seen.tension[1599] == pytest.approx(B * seen.outside[1599], rel=1e-3)
    # Both parts of the cable together are stretched by what the drum has wound in.
    seen = rollout(slow + effect(attenuation=B, inner_share=c), there_and_back)
    wound = cable_stiffness_N_m(slow, 15.0) * R * seen.theta
    pulled = c * seen.tension + (1 - c) * seen.outside
    assert pulled[[799, 1599]] == pytest.approx(wound[[799, 1599]], rel=1e-4)
    T, speed = 10.0, 0.05
    for knee, creep in [(1.0, 1e-7), (20.0, 0.05), (0.1, 0.02), (0.02, 1e-7)]:
        law = Law(effect(B, c, knee, creep))
        ratio = []
        for _ in range(400):
            outside = law.pass_(T, velocity=speed, port=Port.CABLE)
            ratio.append(law.pass_(outside, velocity=speed) / outside)
        assert ratio == pytest.approx(gripped(law, T, speed, 400), abs=1e-3), knee
    for _ in range(200):
        outside = law.pass_(T, velocity=speed, port=Port.CABLE)
    assert law.pass_(outside, velocity=speed) == pytest.approx(outside / B, rel=1e-7)  # it slides
    # Put where the gauge reads so much, friction is what it was.
    for speed in (0.0, -0.05, 0.0):
        outside = law.pass_(T, velocity=speed, port=Port.CABLE)
        inside = law.pass_(outside, velocity=speed)
    assert law.settle(inside) == pytest.approx(outside)
    assert law.settle(outside, port=Port.CABLE) == pytest.approx(T)


def gauge_nonlinearity(effect):
    """The angle at rest is that of the polynomial's root."""
    c = 2e-3
    root = np.roots([c, 1.0, -15.0]).max()
    state, effort = rest(REEL + effect(curvature_per_N=c))
    assert (state[0] * k * R, effort) == (pytest.approx(root), pytest.approx(root))


def gauge_offset(effect):
    """The true tension is less by the offset."""
    state, effort = rest(REEL + effect(offset_N=2.0))
    assert (state[0] * k * R, effort) == (pytest.approx(13.0), pytest.approx(13.0))


def gauge_drift(effect):
    """At rest the reading is a straight line over the time."""
    seen = rollout(REEL + effect(rate_N_per_s=0.7), np.full(200, 15.0))
    assert seen.tension == pytest.approx(15.0 + 0.7 * np.arange(200) / RATE)


def gauge_resonance(effect):
    """The mode's response, by scipy, to the tension that the plain gauge reads."""
    w, zeta, s = 2 * np.pi * 120.0, 0.05, 0.3
    plain = rollout(REEL, INTO_SLACK).tension
    system = signal.StateSpace([[0, 1], [-w * w, -2 * zeta * w]], [[0], [w * w]], [[1, 0]], [[0]])
    _, mode, _ = signal.lsim(system, plain, np.arange(200) / RATE, X0=[15.0, 0.0])
    seen = rollout(REEL + effect(share=s, frequency_Hz=120.0, damping=zeta), INTO_SLACK)
    assert seen.tension == pytest.approx((1 - s) * plain + s * mode, abs=1e-8)


def static(effect, tension, **parameters):
    """The linear law's tension where the reel settles at this one."""
    state, effort = rest(REEL + effect(**parameters), tension)
    assert effort == pytest.approx(tension)
    return state[0] * cable_stiffness_N_m(REEL, tension) * R


def cable_stiffening(effect):
    """The settled angle is that of the law's root."""
    for tension in (5.0, 15.0, 40.0):
        for c, d in [(0.01, 0.0), (0.0, 2e-3), (0.02, 0.1)]:
            law = lambda l, T=tension, c=c, d=d: l + c * l**2 + d * l**3 - T  # noqa: E731
            root = optimize.brentq(law, 0.0, 100.0)
            found = static(effect, tension, stiffening_per_N=c, cubic_per_N2=d)
            assert found == pytest.approx(root, rel=1e-9)


def cable_creep(effect):
    """A length suddenly wound in relaxes exponentially to 1/(1 + c) of its tension."""
    c, tau = 0.4, 0.05
    law = Law(effect(share=c, time_s=tau))
    found = [law.pass_(10.0) for _ in range(800)]
    time = np.arange(800) * SUBSTEP_s
    expected = 10.0 * (1.0 - c / (1 + c) * (1.0 - np.exp(-(1 + c) / tau * time)))
    assert found == pytest.approx(expected)
    assert static(effect, 20.0, share=c) == pytest.approx(28.0)


def cable_slack(effect):
    """Tension is the integral of a stiffness that grows to its full value over the toe."""
    s = 2e-3
    law = Law(effect(slack_m=s))
    for l in (-14.0, -5.0, 0.0, 3.0, 12.0, 80.0):
        stiffness = stats.triang(0.5, -k * s, 2 * k * s).cdf  # relative to k
        area = integrate.quad(stiffness, -k * s, l, points=[0.0, k * s])[0]
        assert law.pass_(l) == pytest.approx(area, abs=1e-9)
    for tension in (1.0, 7.0, 12.0, 30.0):
        law = Law(effect(slack_m=s), preload=tension)
        assert law.pass_(static(effect, tension, slack_m=s)) == pytest.approx(tension, rel=1e-9)


def cable_weight(effect):
    """What the sag takes up is the difference between a catenary's length and its span."""
    extra, L = 0.05, REEL.cable_length_m

    def taken_up(T, density):
        a = T / (9.80665 * density)
        return L - 2 * a * np.arcsinh(L / (2 * a))

    law = Law(effect(density_kg_m=extra))
    mu = REEL.cable_density_kg_m
    for T in (4.0, 8.0, 15.0, 40.0):
        more = [taken_up(x, mu + extra) - taken_up(x, mu) for x in (15.0, T)]
        l = T + k * (more[0] - more[1])
        for _ in range(30):
            found = law.pass_(l)
        assert found == pytest.approx(T, rel=2e-3)
        assert law.settle(T) == pytest.approx(l, abs=2e-3 * T)


def string_mode(effect):
    """It rings at the string's frequency, at any tension, and slowly sags as a heavy cable."""
    L, mu = REEL.cable_length_m, 0.05
    for T in (8.0, 15.0, 40.0):
        q = (9.80665 * mu) ** 2 * L**3 / 24.0
        expected = T - k * q * (T**-2 - 15.0**-2)
        found = Law(effect(density_kg_m=mu)).settle(T)
        assert found - T == pytest.approx(expected - T, rel=0.02)
    L, mu = 1.2, 0.02
    for T in (8.0, 30.0):
        reel = plants.reference_reel(L, T, viscous_friction_Nms=0.2)
        reel = reel + effect(coupling=0.1, density_kg_m=mu, damping=2e-3)
        seen = rollout(reel, np.where(np.arange(3000) < 30, T + 3.0, T), T)
        ringing = signal.detrend(seen.tension[400:]) * np.hanning(2600)
        spectrum = np.abs(np.fft.rfft(ringing, 1 << 16))
        f = np.fft.rfftfreq(1 << 16, 1.0 / RATE)[spectrum.argmax()]
        assert f == pytest.approx(np.sqrt(T / mu) / (2 * L), rel=0.02)


def structural_mode(effect):
    """Drum, cable, frame and gauge as one linear system, by python-control."""
    c, w, zeta = 0.3, 2 * np.pi * 45.0, 0.2
    g, xi = 2 * np.pi * REEL.gauge_Hz, REEL.gauge_damping
    # theta, omega, reading, its rate, q, its rate; T = (1 + c) k R theta - q
    T = np.array([(1 + c) * k * R, 0, 0, 0, -1.0, 0])
    A = np.zeros((6, 6))
    A[0, 1] = A[2, 3] = A[4, 5] = 1.0
    A[1] = -R / J * T + np.eye(6)[1] * (-b / J)
    A[3] = g * g * T - g * g * np.eye(6)[2] - 2 * xi * g * np.eye(6)[3]
    A[5] = w * w * c * T - w * w * np.eye(6)[4] - 2 * zeta * w * np.eye(6)[5]
    B = np.array([[0, R / J, 0, 0, 0, 0]]).T
    system = control.ss(A, B, [[0, 0, 1, 0, 0, 0]], 0.0).sample(1.0 / RATE)
    late = np.concatenate([[15.0], TAUT[:-1]])
    time = np.arange(200) / RATE
    expected = np.asarray(control.forced_response(system, U=late - 15.0, T=time).outputs)
    seen = rollout(REEL + effect(share=c, frequency_Hz=45.0, damping=zeta), TAUT)
    assert seen.tension - 15.0 == pytest.approx(expected, abs=1e-3 * np.ptp(expected))
    # One that stiffens, under what is wound in, by scipy's solver.
    s = 0.03
    law = Law(effect(share=c, frequency_Hz=45.0, damping=zeta, stiffening_per_N=s))
    wound = law.settle(15.0)
    q = c * 15.0 / (1 + s * 15.0)
    assert (1 + c) * wound - q == pytest.approx(15.0)

    def frame(t, state):
        T = (1 + c) * wound * (1 + 0.4 * np.sin(200.0 * t)) - state[0]
        return state[1], w * w * (c * T - (1 + s * T) * state[0]) - 2 * zeta * w * state[1]

    t = SUBSTEP_s * np.arange(600)
    given = wound * (1 + 0.4 * np.sin(200.0 * t))
    q = integrate.solve_ivp(frame, (0.0, t[-1]), (q, 0.0), t_eval=t, rtol=1e-9).y[0]
    found = [law.pass_(l) for l in given]
    expected = (1 + c) * given - q
    assert found == pytest.approx(expected, abs=0.01 * np.ptp(expected))


def drum_eccentricity(effect):
    """Without friction, drum, cable and a constant motor torque keep their energy."""
    e, phi = 0.15, 1.0
    free = plants.reference_reel(viscous_friction_Nms=0.0, viscous_friction_per_length_Ns=0.0)
    u = np.r_[np.full(4, 30.0), np.full(300, 18.0)]
    seen = rollout(free + effect(eccentricity=e, phase_rad=phi), u)
    wound = R * (seen.theta + e * (np.sin(seen.theta + phi) - np.sin(phi)))
    energy = 0.5 * J * seen.omega**2 + 0.5 * k * wound**2 - 18.0 * R * seen.theta
    assert np.ptp(energy[6:]) < 1e-5 * np.ptp(0.5 * k * wound[6:] ** 2)
    assert k * wound[0] == pytest.approx(15.0)


def quantisation(effect):
    """Every reading is the nearest step."""
    plain = rollout(REEL, TAUT).tension
    found = rollout(REEL + effect(step_N=0.25), TAUT).tension
    assert found == pytest.approx(0.25 * np.round(plain / 0.25), abs=1e-9)


def mains_interference(effect):
    """The reading less the plain one is the sine."""
    hum = effect(amplitude_N=0.4, frequency_Hz=50.0, phase_rad=1.1)
    found = rollout(REEL + hum, TAUT).tension - rollout(REEL, TAUT).tension
    time = np.arange(200) / RATE
    assert found == pytest.approx(0.4 * np.sin(2 * np.pi * 50.0 * time + 1.1), abs=1e-9)


def test_weight_added_to_a_cable_that_sags_in_full_is_one_weight():
    """From rest at 3 N to 6 N the drum takes up what the stretch and both weights' sag say."""
    long = plants.reference_reel(1.3)
    heavy = EFFECTS["cable_weight"](density_kg_m=0.1)
    there = np.r_[np.full(50, 3.0), np.linspace(3.0, 6.0, 1200), np.full(300, 6.0)]
    seen = rollout(long + heavy + SaggingCalibration(), there, 3.0)
    assert np.ptp(seen.theta[:50]) < 1e-9
    per_N = 1.0 / long.structure_stiffness_N_m + 1.3 / long.cable_EA_N
    q = ((long.cable_density_kg_m + 0.1) * 9.80665) ** 2 * 1.3**3 / 24.0
    length = per_N * seen.tension - q / seen.tension**2
    assert R * (seen.theta[-1] - seen.theta[0]) == pytest.approx(length[-1] - length[0], rel=1e-6)


def test_slack_beside_the_sag_of_the_own_weight_adds_length_to_length():
    """From rest at 2 N to 8 N the drum takes up the strands' straightening less the sag."""
    long, slack = plants.reference_reel(1.3), 1e-3
    there = np.r_[np.full(50, 2.0), np.linspace(2.0, 8.0, 1200), np.full(300, 8.0)]
    reel = long + EFFECTS["cable_slack"](slack_m=slack) + SaggingCalibration()
    seen = rollout(reel, there, 2.0)
    assert np.ptp(seen.theta[:50]) < 1e-9
    per_N = 1.0 / long.structure_stiffness_N_m + 1.3 / long.cable_EA_N
    q = (long.cable_density_kg_m * 9.80665) ** 2 * 1.3**3 / 24.0
    holds = stats.triang(0.5, -slack, 2 * slack).cdf

    def tension(stretch_m):
        return integrate.quad(holds, -slack, stretch_m, points=[0.0, slack])[0] / per_N

    ends = seen.tension[[0, -1]]
    stretch = [optimize.brentq(lambda e, T: tension(e) - T, -slack, 0.1, (T,)) for T in ends]
    length = np.array(stretch) - q / ends**2
    assert R * (seen.theta[-1] - seen.theta[0]) == pytest.approx(np.ptp(length), rel=1e-5)
