"""What a result says of a load step that the trials did not have."""

import math

import control
import numpy as np
import pytest

import estune
from estune.cli.runs import result_facts
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.load_rejection import load_rejection
from estune.loop_model.model import LoopModel
from estune.loop_model.poles import pair_coordinates
from estune.run.results.figures import draw_rejections
from estune.support.plot_style import new_axes

SETTINGS = ControllerSettings(10.0, 0.0, -math.inf, math.inf)
STEP, SETTLING_S = 2.0, 4.0


def integrator(rate_per_sample):
    """y' = u at the rate of the settings; a pole nearly at one and one that decays at once."""
    poles = tuple(pair_coordinates(-(1.0 - 1e-9), 0.0).tolist())
    return LoopModel(poles, (rate_per_sample, 0.0, 0.0), 0)


@pytest.fixture(scope="module")
def integrating():
    plant = control.tf([1.0], [0.2, 1.0, 0.0])
    start = Gains(0.3, 0.02, 0.02, 0.3)
    return estune.tune(
        plant, start=start, sampling_Hz=20.0, dead_time_s=0.2, journal=False, watch=None
    )


def test_load_on_an_integrator_leaves_the_load_over_P_without_integral_action():
    at = load_rejection(integrator(0.1), Gains(2.0, 1e-7, 0.0, 0.0), SETTINGS, STEP, SETTLING_S)
    assert at.peak == pytest.approx(at.load / 2.0, rel=1e-3)
    assert at.deviation[-1] == pytest.approx(at.load / 2.0, rel=1e-3)
    assert not at.vanishes


def test_load_is_rejected_when_it_stays_within_two_per_cent_of_the_step():
    gains = Gains(2.0, 1.0, 0.0, 0.0)
    at = load_rejection(integrator(0.1), gains, SETTINGS, STEP, SETTLING_S)
    y, integral, response = 0.0, 0.0, []
    for _ in range(at.time_s.size):  # the difference equations themselves
        response.append(y)
        effort = -gains.P * y + integral
        integral -= 0.1 * gains.I * y
        y += 0.1 * (effort + at.load)
    assert at.deviation == pytest.approx(np.array(response), abs=1e-6 * STEP)
    last = max(k for k, value in enumerate(response) if abs(value) > 0.02 * STEP)
    assert at.vanished_s == pytest.approx(0.1 * (last + 1))


def test_unstable_loop_has_no_load_response():
    unstable = Gains(30.0, 1.0, 0.0, 0.0)
    assert load_rejection(integrator(0.1), unstable, SETTINGS, STEP, SETTLING_S) is None


def test_first_line_names_the_cost_that_rejects_a_load_which_stays(integrating):
    assert integrating.ending.is_tuned
    heading = integrating.heading()
    assert "a load step stays, tune with --cost tracking_and_rejection" in heading
    assert ("load rejected (2 %, predicted)", "never") in {r[::2] for r in integrating.rows()}
    told = result_facts(integrating)["load_rejection"]["tuned"]
    assert told["peak"] > 0.0
    assert told["vanished_s"] is None or not math.isfinite(told["vanished_s"])


def test_response_to_a_load_step_is_drawn_before_and_after(integrating):
    drawn = draw_rejections(new_axes(), integrating.rejections, 1.0, integrating.rig)
    before, after = drawn.get_lines()
    assert [line.get_label() for line in (before, after)] == ["initial gains", "tuned gains"]
    tuned = integrating.rejections["tuned"]
    assert np.max(np.abs(after.get_ydata())) == pytest.approx(tuned.peak)
