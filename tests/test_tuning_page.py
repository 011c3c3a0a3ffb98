"""The tuning page in Chromium: its predictions against estune's own, its controls, its speed."""

import math

import numpy as np
import pytest
from playwright.sync_api import expect

import plants
from estune import tune
from estune.core.controller_equation import controller_polynomials
from estune.core.controller_form import ControllerForm
from estune.core.cost import StepCost
from estune.core.filtering import lfilter
from estune.core.gains import GAIN_NAMES, Gains
from estune.core.pidf import ControllerSettings
from estune.core.response import LoadStep, StepShape
from estune.loop_model.model import LoopModel
from estune.loop_model.optimum import RegionSearch, RobustnessLimits
from estune.loop_model.prediction import StepTrial, predict
from estune.loop_model.problem import problem
from estune.run.planning import step_trial
from estune.run.results.tuning_data import tuning_data
from estune.web.server import PageServer
from estune.web.views import run_view
from tests.support_browser import check_forms, needs_browser, opened, serious
from tests.support_loops import loop_of_taps

pytestmark = needs_browser

RATE_HZ = 200.0
MODEL = loop_of_taps((-1.62, 0.66), (0.012, 0.02, 0.006), 3)
FOUR_POLES = LoopModel(
    (*MODEL.coordinates, math.log(0.9), math.log(0.02)), (*MODEL.numerator, 0.05, 0.01), 1
)
PREDICT = """async ([problem, gains]) => {
  const { predict } = await import("/static/loop.js");
  return gains.map(([P, I, D, setpoint_filter_s]) => {
    const p = predict(problem, problem.models[0], { P, I, D, setpoint_filter_s });
    const numbers = [p.cost, p.overshoot, p.Ms, p.phase_margin_deg];
    return numbers.map((x) => (Number.isFinite(x) ? x : null));
  });
}"""

SIMULATE = """async ([problem, [P, I, D, setpoint_filter_s]]) => {
  const { columns, simulate } = await import("/static/loop.js");
  const gains = { P, I, D, setpoint_filter_s };
  return [...simulate(problem, problem.models[0], gains, columns(problem)).y];
}"""


OPTIMUM = """async ([problem, start, Ms, overshoot]) => {
  const { optimum } = await import("/static/optimum.js");
  const { predict } = await import("/static/loop.js");
  const gains = optimum(problem, start, { Ms, overshoot }, problem.cost);
  return predict(problem, problem.models[0], gains);
}"""

EXCESSES = """async ([problem, start, Ms, overshoot]) => {
  const { optimum } = await import("/static/optimum.js");
  const { predict } = await import("/static/loop.js");
  const limits = { Ms, overshoot };
  return [2, 7, 12, 17, 22, 27, 32, 37].map((evaluations) => {
    const quick = optimum(problem, start, limits, problem.cost, { evaluations, size: 0.15 });
    const p = predict(problem, problem.models[0], optimum(problem, quick, limits, problem.cost));
    return [p.Ms / Ms - 1, p.overshoot - overshoot];
  });
}"""
"""What the optimum exceeds of the limits after quick searches that ended at these counts."""


@pytest.fixture(scope="module")
def page(chromium):
    server = PageServer(list)
    with opened(chromium, server.address) as opened_page:
        yield opened_page
    server.close()


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A finished tuning of the reference reel."""
    folder = tmp_path_factory.mktemp("runs")
    return tune(plants.reference_reel(), run="reel", folder=folder, watch=None)


def trial(form=None, limit_N=1e9, load_N=0.0, ramp=1, **cost):
    settings = ControllerSettings(RATE_HZ, 0.01, -limit_N, limit_N, form)
    cost = StepCost(0.2, **({"time_unit": "settling_time", "move_weight": 0.5} | cost))
    load = LoadStep(160, load_N) if load_N else None
    return StepTrial(settings, cost, 10.0, StepShape(20, 2.0, load, ramp), 300)


def likely_gains(count=40):
    rng = np.random.default_rng(29)
    spread = np.exp(rng.uniform(-1.5, 1.5, (count, 4)))
    return [Gains(*row) for row in spread * np.array([0.6, 4.0, 0.02, 0.02])]


def test_controller_of_another_form_in_the_browser_runs_its_own_difference_equation(page):
    form = ControllerForm("series", "tustin", "tustin", "error", setpoint_filter="tustin")
    asked, gains = trial(form), Gains(0.3, 2.0, 0.005, 0.03)
    c = controller_polynomials(asked.controller, gains)
    B, A = np.convolve(np.eye(5)[4], (0.012, 0.02, 0.006)), np.array([1.0, -1.62, 0.66])
    loop = np.polyadd(
        *(np.convolve(x, y)[::-1] for x, y in ((A, c.denominator), (B, c.measurement)))
    )
    through = np.convolve(np.convolve(B, c.setpoint), c.filter_numerator)
    expected = lfilter(through, np.convolve(loop[::-1], c.filter_denominator), asked.setpoint)
    shown = page.evaluate(SIMULATE, [problem([MODEL], asked, 0.0), gains.as_tuple()])
    assert shown == pytest.approx(expected.tolist(), abs=1e-6)


CASES = {
    "cost (35)": (MODEL, trial()),
    "limits that act": (MODEL, trial(limit_N=1.5)),
    "ramp": (MODEL, trial(ramp=12)),
    "friction": (MODEL._replace(friction=0.05), trial()),
    "load and ITAE": (MODEL, trial(load_N=-1.0, criterion="itae", rejection=0.5)),
    "price of the effort": (MODEL, trial(criterion="ise", effort_weight=0.1)),
    "four poles": (FOUR_POLES, trial()),
    "four poles, limits that act": (FOUR_POLES, trial(limit_N=1.5)),
    "integrator": (loop_of_taps((-1.8, 0.8), (0.002, 0.002, 0.0), 1), trial()),
}


@pytest.mark.parametrize("case", CASES)
def test_prediction_in_the_browser_is_that_of_the_loop_model(page, case):
    model, asked = CASES[case]
    gains = likely_gains()
    shown = page.evaluate(PREDICT, [problem([model], asked, 0.01), [g.as_tuple() for g in gains]])
    expected = [predict(model, asked, g, 0.01) for g in gains]
    stable = [math.isfinite(p.cost) for p in expected]
    assert [row[0] is not None for row in shown] == stable
    assert sum(stable) >= 10
    for row, p in zip(shown, expected, strict=True):
        if math.isfinite(p.cost):
            assert row[0] == pytest.approx(p.cost, rel=0.01)
            assert row[1] == pytest.approx(p.overshoot, abs=0.001)
            assert row[2] == pytest.approx(p.sensitivity, rel=0.01)
            if math.isfinite(p.phase_margin_deg):
                assert row[3] == pytest.approx(p.phase_margin_deg, abs=0.6)


def test_optimum_in_the_browser_costs_what_that_of_the_loop_model_does(page, result):
    data = tuning_data(result)
    start = data["gains"]["initial"]
    trial = step_trial(result.rig, result.plan.step, result.plan.cost)
    low, high = (
        np.log([data["bounds"][end][name] for name in GAIN_NAMES]) for end in ("low", "high")
    )
    fit = result.identified.fit
    for Ms in (1.3, 1.6, 1.9):
        limits = RobustnessLimits(Ms, 0.05)
        search = RegionSearch(
            *(fit.model, trial, limits, lambda x: Gains(*np.exp(x)), low, high, fit.noise_std)
        )
        best = search.minimise([np.log(list(start.values()))], scattered=64).prediction
        shown = page.evaluate(OPTIMUM, [data, start, Ms, 0.05])
        assert shown["Ms"] <= 1.01 * Ms
        assert shown["overshoot"] <= 0.055
        assert shown["cost"] <= 1.03 * best.cost


def test_optimum_in_the_browser_keeps_the_limits_wherever_a_quick_search_ended(page, result):
    data = tuning_data(result)
    excesses = page.evaluate(EXCESSES, [data, data["gains"]["tuned"], 1.2, 0.05])
    assert max(max(one) for one in excesses) < 2e-3, excesses


def test_sliders_work_by_keyboard_and_show_what_breaks_a_limit(chromium, result):
    view = run_view(result.folder)
    server = PageServer(lambda: [view])
    with opened(chromium, f"{server.address}?tune") as page:
        cells = page.locator("#tuner table tr")
        expect(cells.nth(3)).to_contain_text("sensitivity Ms")
        expect(page.locator("#tuner .amber")).to_have_count(0)
        P = page.get_by_role("slider", name="P, N/N")
        P.focus()
        for _ in range(20):
            P.press("ArrowRight")
        expect(page.locator("#tuner .amber").first).to_be_visible()
        page.get_by_role("button", name="Optimum for these limits").click()
        expect(page.locator("#tuner .amber")).to_have_count(0)
        check_forms(page)
    server.close()


def test_report_has_the_sliders_without_a_server_and_asks_for_nothing(chromium, result, tmp_path):
    path = result.report(tmp_path / "report.html")
    with opened(chromium, path.as_uri()) as page:
        Ms = page.get_by_label("robustness: largest Ms")
        Ms.focus()
        Ms.press("Home")
        expect(page.locator("#tuner output").first).to_have_text("1.20")
        expect(page.locator("#tuner .amber")).to_have_count(0)
        page.get_by_label("Form of the gains").select_option("TOML")
        page.get_by_role("button", name="Copy gains").click()
        expect(page.locator("#tuner [role=status]")).to_contain_text("[gains]\nP = ")
        assert serious(page) == []
