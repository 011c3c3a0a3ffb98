"""The colour of a sensor's noise, which the controller feeds back."""

import math

import control
import numpy as np
import pytest

from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model.fitting import fit_loop
from estune.loop_model.margins import robustness
from estune.loop_model.records import LoopRecord

SAMPLING_Hz, GAIN, LAGS_s, COLOUR = 4.0, 7.0, (250.0, 8.0, 1.4), (0.1, -0.35)
SETTINGS = ControllerSettings(SAMPLING_Hz, 0.0, -math.inf, math.inf)


def chamber_record(P: float, seed: int, samples: int = 700) -> LoopRecord:
    """A chamber of three lags under P alone; the noise of its sensor alternates, its air moves."""
    random = np.random.default_rng(seed)
    poles = [math.exp(-1.0 / (SAMPLING_Hz * lag_s)) for lag_s in LAGS_s]
    noise = lfilter([1.0], [1.0, *COLOUR], 0.08 * random.standard_normal(samples))
    noise += lfilter([1.0], [1.0, -math.exp(-1.0 / 24.0)], 0.04 * random.standard_normal(samples))
    setpoint = 12.0 * (np.arange(samples) // 233)
    states, y, u = np.zeros(3), np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        y[k] = states[2] + noise[k]
        u[k] = P * (setpoint[k] - y[k])
        driven = GAIN * u[k]
        for i, pole in enumerate(poles):
            driven = states[i] = pole * states[i] + (1.0 - pole) * driven
    return LoopRecord(u, y, setpoint, Gains(P, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def fit():
    """The fit of records at three gains."""
    return fit_loop([chamber_record(P, n) for n, P in enumerate((3.0, 5.0, 8.0))], 4.0, 18.0)


def test_slow_pole_under_coloured_sensor_noise_is_not_taken_for_load(fit):
    # Taken for white the noise leaves a static gain of 0.13.
    assert GAIN / 2.0 < fit.model.static_gain < 2.0 * GAIN


def test_colour_of_the_sensor_noise_is_part_of_the_fit(fit):
    assert fit.noise.colour[1] == pytest.approx(COLOUR[1], abs=0.1)


def test_sensitivity_under_coloured_sensor_noise_is_that_of_python_control(fit):
    z = control.TransferFunction([1, 0], [1], 1.0 / SAMPLING_Hz)
    L = 8.0 * GAIN / z
    for lag_s in LAGS_s:
        pole = math.exp(-1.0 / (SAMPLING_Hz * lag_s))
        L *= (1.0 - pole) * z / (z - pole)
    omega = SAMPLING_Hz * np.linspace(0.01, 0.99 * math.pi, 2000)
    true = np.max(1.0 / np.abs(1.0 + L(np.exp(1j * omega / SAMPLING_Hz))))
    found = robustness(fit.model, Gains(8.0, 0.0, 0.0, 0.0), SETTINGS).sensitivity
    assert found == pytest.approx(true, rel=0.1)
