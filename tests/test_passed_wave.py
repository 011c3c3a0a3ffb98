"""What of a wave a loop lets pass, once the loop is identified."""

from types import SimpleNamespace

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.margins import frequency_response
from estune.service_records.cause.judge import Cause
from estune.service_records.passed_wave import with_passed_wave
from tests.support_loops import loop_of_taps

MODEL = loop_of_taps((-1.5, 0.56), (0.05, 0.01, 0.0), 1)
SETTINGS = ControllerSettings(10.0, 0.0, -np.inf, np.inf)
LOOP = SimpleNamespace(fit=SimpleNamespace(model=MODEL), settings=SETTINGS)


def cause(**numbers):
    return Cause("outside", 0.9, numbers, "a wave", {})


@pytest.mark.parametrize("period_s", [1.5, 6.0, 90.0])
def test_share_of_a_wave_that_passes_is_the_sensitivity_at_its_period(period_s):
    before, after = Gains(0.5, 0.0, 0.0, 0.0), Gains(1.5, 0.0, 0.0, 0.0)
    told = with_passed_wave(cause(kind="period", period_s=period_s), LOOP, before, after)
    G = frequency_response(MODEL, np.array([0.2 * np.pi / period_s]))[0]
    assert told.numbers["passes"] == pytest.approx(1.0 / abs(1.0 + 0.5 * G), rel=1e-3)
    assert told.numbers["could_pass"] == pytest.approx(1.0 / abs(1.0 + 1.5 * G), rel=1e-3)


def test_no_share_is_told_of_a_loop_that_is_not_known():
    told = cause(kind="period", period_s=6.0)
    assert with_passed_wave(told, None, Gains(0.5, 0.0, 0.0, 0.0), None) is told
