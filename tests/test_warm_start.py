"""Warm starts from a rig's own linear model."""

from dataclasses import replace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.margins import Margins
from estune.errors import InvalidInput
from estune.interop import linear_model, margins, model_gains
from estune.run.plan import model_start
from tests.support_runs import description
from tests.test_initial import SETTINGS

s = control.tf("s")


def loop(model) -> Margins:
    return margins(model, model_gains(model, SETTINGS), SETTINGS)


@pytest.mark.parametrize(
    "model",
    [
        linear_model(50.0**2 / (s**2 + 2 * 0.1 * 50.0 * s + 50.0**2), 0.002),
        linear_model(2.0 / (0.3 * s + 1), 0.05),
        linear_model(1.0 / ((s + 1) * (0.2 * s + 1) * (0.04 * s + 1))),
        linear_model((1 - 0.1 * s) / ((s + 1) * (0.5 * s + 1)), 0.3),
    ],
    ids=["reel", "first order with dead time", "three lags", "non-minimum phase"],
)
def test_warm_start_of_stable_model_has_stability_margins(model):
    loop_margins = loop(model)
    assert loop_margins.stable
    # |1 + L| >= 1/1.6 everywhere means margins of at least 2.67 and 36 degrees.
    assert loop_margins.gain_margin > 2.6
    assert loop_margins.phase_margin_deg > 36.0


@pytest.mark.parametrize(
    ("system", "words"),
    [
        (1.0 / (s - 5.0), "unstable by itself"),
        (5.0 / ((s + 1.0) * (s**2 - s + 5.0)), "unstable by itself"),
        (1.0 / (s * (s + 1.0)), "integrates"),
        (-1.0 / (s + 1.0), "turn the sign"),
    ],
)
def test_warm_start_refuses_unsuitable_model(system, words):
    with pytest.raises(InvalidInput, match=words):
        model_gains(linear_model(system), SETTINGS)


def test_warm_start_of_rig_without_model_names_a_remedy():
    with pytest.raises(
        InvalidInput, match=r"arithmetic gives no linear model.*give the initial gains"
    ):
        model_start(replace(description(), linear_model=None))


@pytest.mark.parametrize("length_m", [0.5, 1.4])
def test_warm_start_is_safe_and_closer_to_the_optimum(length_m):
    reel = plants.reference_reel(cable_length_m=length_m)
    warm = estune.tune(reel, start="model", trials=1, journal=False, watch=None)
    cold = estune.tune(reel, trials=1, journal=False, watch=None)
    assert warm.unsafe == 0
    assert warm.start_gains == model_start(warm.rig)
    assert np.mean(warm.session.baseline) < 0.7 * np.mean(cold.session.baseline)
