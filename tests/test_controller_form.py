"""The forms of the controller against each one's recursion written sample by sample."""

import itertools
import math
from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import estune
import plants
from estune.core.controller_equation import controller_polynomials, unlimited_effort
from estune.core.controller_form import OWN_FORM, ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings, bumpless, coefficients, state_at_rest, step
from estune.errors import InvalidInput
from estune.run.journal import Journal
from estune.run.loop import replay
from estune.run.planning import description_from_json, plan_from_json
from estune.trial import TrialRequest
from estune.trial.controller_fit import fitted_form

H, LAG = 1.0 / 200.0, 0.012
SETTINGS = ControllerSettings(200.0, LAG, -math.inf, math.inf)
GAINS = Gains(0.8, 14.0, 0.02, 0.03)
FORMS = [
    ControllerForm(*choice)
    for choice in itertools.product(
        ("parallel", "series"),
        ("forward", "backward", "tustin"),
        ("backward", "tustin", "exact", "exponential"),
        ("measurement", "error"),
        ("derivative", "measurement"),
        ("exact", "backward", "tustin"),
    )
]


def textbook_effort(form, gains, setpoint, measurement, first):
    """Each form as a programmer writes it: filter, derivative, integral, one sample at a time."""
    rising = {"backward": LAG / (LAG + H), "tustin": (2 * LAG - H) / (2 * LAG + H)}
    p = rising.get(form.derivative, math.exp(-H / LAG))
    g = {
        "backward": 1 / (LAG + H),
        "tustin": 2 / (2 * LAG + H),
        "exact": 1 / LAG,
        "exponential": (1 - p) / H,
    }[form.derivative]
    tau = gains.setpoint_filter_s
    a = {
        "exact": math.exp(-H / tau),
        "backward": tau / (tau + H),
        "tustin": (2 * tau - H) / (2 * tau + H),
    }[form.setpoint_filter]
    r0, y0 = setpoint[0], measurement[0]
    rf = last_r = last_rf = r0
    yf = last_y = last_yf = y0
    slope_y = slope_r = 0.0
    integral = last_error = None
    efforts = []
    for r, y in zip(setpoint, measurement, strict=True):
        new = (r + last_r) / 2 if form.setpoint_filter == "tustin" else r
        rf = a * rf + (1 - a) * new
        if form.filter_on == "measurement":
            new = (y + last_y) / 2 if form.derivative == "tustin" else y
            yf = p * yf + (1 - p) * new
            slope_y, slope_r = (yf - last_yf) / H, (rf - last_rf) / H
        else:
            yf = y
            slope_y = p * slope_y + g * (y - last_y)
            slope_r = p * slope_r + g * (rf - last_rf)
        lead = (slope_r if form.derivative_on == "error" else 0.0) - slope_y
        series = form.structure == "series"
        error = rf - yf + (gains.D / gains.P * lead if series else 0.0)
        wanted = gains.P * error + (0.0 if series else gains.D * lead)
        if integral is None:
            integral = 0.0
        else:
            weights = {"forward": (0.0, 1.0), "backward": (1.0, 0.0), "tustin": (0.5, 0.5)}
            now, before = weights[form.integral]
            integral += gains.I * H * (now * error + before * last_error)
        efforts.append(wanted + integral)
        last_r, last_rf, last_y, last_yf, last_error = r, rf, y, yf, error
    return np.array(efforts) - efforts[0] + first


def test_every_form_is_the_recursion_of_its_name():
    rng = np.random.default_rng(1)
    setpoint = 10.0 + 5.0 * (np.arange(120) > 20)
    measurement = 9.0 + np.cumsum(0.1 * rng.standard_normal(120))
    for form in FORMS:
        effort = unlimited_effort(
            SETTINGS, GAINS, setpoint, measurement, first_effort=7.0, form=form
        )
        expected = textbook_effort(form, GAINS, setpoint, measurement, 7.0)
        assert effort == pytest.approx(expected, rel=1e-9, abs=1e-9), form


def test_forms_differ_but_for_the_rule_of_a_filter_that_two_share():
    setpoint, measurement = 10.0 + 5.0 * (np.arange(60) > 9), np.sin(np.arange(60.0))
    seen = {
        unlimited_effort(SETTINGS, GAINS, setpoint, measurement, first_effort=0.0, form=form)
        .round(9)
        .tobytes()
        for form in FORMS
    }
    # A filter on the measurement knows no difference between exact and exponential.
    assert len(seen) == len(FORMS) * 7 // 8


magnitude = st.floats(1e-3, 1e3)


@given(
    st.builds(Gains, magnitude, st.just(0.0) | magnitude, st.just(0.0) | magnitude, magnitude),
    st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=2, max_size=40),
)
def test_own_form_is_the_equation_of_pidf(gains, signals):
    r, y = np.array(signals).T
    c = coefficients(SETTINGS, gains)
    state = state_at_rest(float(r[0]), 3.0)._replace(filtered_measurement=float(y[0]))
    state = bumpless(c, state, r[0], y[0], 3.0)
    effort = unlimited_effort(SETTINGS, gains, r, y, first_effort=3.0, form=OWN_FORM)
    largest = 1.0
    for k in range(r.size):
        state, expected, _ = step(c, state, r[k], y[k])
        largest = max(largest, abs(expected), abs(state.integral))
        assert effort[k] == pytest.approx(expected, abs=1e-9 * largest)


@settings(max_examples=40)
@given(st.sampled_from(FORMS), st.floats(0.5, 30.0))
def test_forms_approach_the_continuous_controller(form, frequency):
    fast = ControllerSettings(2e4, LAG, -math.inf, math.inf)
    c = controller_polynomials(fast, GAINS, form)
    later = np.exp(-1j * frequency / fast.sampling_Hz)
    S, R = (np.polyval(part[::-1], later) for part in (c.measurement, c.denominator))
    s = control.tf("s")
    lead, low_pass = s / (LAG * s + 1), 1 / (LAG * s + 1)
    P, I, D, _ = GAINS.as_tuple()
    PI = P + I / s
    if form.filter_on == "derivative":
        exact = PI * (1 + D / P * lead) if form.structure == "series" else PI + D * lead
    elif form.structure == "series":
        exact = PI * (1 + D / P * s) * low_pass
    else:
        exact = (PI + D * s) * low_pass
    assert pytest.approx(exact(1j * frequency), rel=5e-3) == S / R


def test_what_differs_from_the_own_form_is_told():
    assert str(OWN_FORM) == "as estune's own"
    assert str(ControllerForm(derivative="tustin")) == "derivative: tustin"
    with pytest.raises(InvalidInput, match="derivative_filter_s"):
        controller_polynomials(
            ControllerSettings(200.0, 0.0, -1.0, 1.0), GAINS, ControllerForm(derivative="exact")
        )


@pytest.fixture(scope="module")
def trial():
    rig = plants.reference_reel(0.8).rig(seed=2)
    about = rig.describe()
    return rig.run(TrialRequest("form", 0, about.gains, about.step)), about


def with_form(record, about, form):
    """The record as if its controller had run another form with the same measurement."""
    effort = unlimited_effort(
        *(about.controller, record.gains, record.setpoint_N, record.tension_N),
        first_effort=float(record.current_A[0]) * about.newtons_per_ampere,
        form=form,
    )
    return replace(record, current_A=effort / about.newtons_per_ampere)


def test_undeclared_form_is_that_which_reproduces_the_logged_effort(trial):
    record, about = trial
    assert fitted_form(record, about) is None
    for form in FORMS[1::11]:
        shown = with_form(record, about, form)
        found = fitted_form(shown, about)
        if found != form:  # two forms are one: exact and exponential of the whole measurement
            assert with_form(record, about, found).current_A == pytest.approx(shown.current_A)


def test_log_that_no_form_reproduces_shows_none(trial):
    record, about = trial
    noise = np.random.default_rng(1).normal(0.0, 0.2, record.current_A.size)
    assert fitted_form(replace(record, current_A=noise), about) is None
    ignored = with_form(replace(record, gains=Gains(3.0, 1.0, 0.5, 0.3)), about, OWN_FORM)
    assert fitted_form(replace(ignored, gains=record.gains), about) is None


class OtherForm:
    """A reel whose controller is another: its rig declares nothing, and logs what it did."""

    def __init__(self, form):
        self._rig, self._form = plants.reference_reel(0.8).rig(), form

    def __getattr__(self, name):
        return getattr(self._rig, name)

    def run(self, request):
        record, about = self._rig.run(request), self._rig.describe()
        return with_form(record, about, self._form)


def test_rig_of_another_form_is_told_so_and_resumes(tmp_path):
    form = ControllerForm(derivative="exponential")
    short = {"trials": 1, "watch": None, "folder": tmp_path, "run": "other"}
    result = estune.tune(OtherForm(form), **short)
    assert result.fitted_form == form == result.rig.controller.form
    assert any("derivative: exponential" in remark for remark in result.remarks())
    assert estune.load(tmp_path / "other").fitted_form == form


def test_run_on_a_rig_of_another_form_is_replayed_with_the_state_that_it_had(tmp_path):
    form, states = ControllerForm(derivative="exponential"), []
    short = {"trials": 2, "repeats": 1, "watch": lambda p: states.append(p.session.tuner_state)}
    estune.tune(OtherForm(form), folder=tmp_path, run="other", **short)
    with Journal.open(tmp_path / "other") as journal:
        rig = description_from_json(journal.fact("rig"))
        replayed = replay(plan_from_json(journal.fact("plan")), rig, journal)
    assert replayed.session.tuner_state.centre == states[-1].centre
    assert replayed.session.tuner_state.fit.model == states[-1].fit.model
