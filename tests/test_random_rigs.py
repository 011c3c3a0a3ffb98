"""Whole tunings of random rigs end with an outcome or an error of ours, and can be resumed."""

from dataclasses import replace

import control
import numpy as np
import pytest

import estune
import plants
from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.run.loop import Stopped
from estune.trial.profiles import StepProfile
from estune.tuners import TUNERS
from tests.test_first_trial import Changed


def random_rig(seed):
    """A rig drawn at random: order, time scale, gain, sign, noise, faults, saturation, drift."""
    rng = np.random.default_rng(seed)
    period_s = float(np.exp(rng.uniform(np.log(1e-3), np.log(3600.0))))
    gain = float(np.exp(rng.normal(0.0, 1.5))) * (-1.0 if rng.random() < 0.15 else 1.0)
    transfer = control.tf([gain], [1.0])
    for lag in rng.uniform(0.02, 0.4, rng.integers(1, 6)):
        transfer *= control.tf([1.0], [float(lag) * period_s, 1.0])
    if rng.random() < 0.3:
        w, damping = 2.0 * np.pi * rng.uniform(2.0, 20.0) / period_s, rng.uniform(0.002, 0.1)
        transfer *= control.tf([w * w], [1.0, 2.0 * damping * w, w * w])
    most = float(rng.choice([1e3, 3.0])) / abs(gain)
    P, I, D, filter_s = np.exp(rng.normal([-2.0, -1.0, -6.0, -3.0], 1.0)).tolist()
    P, I, D = P / abs(gain), I / period_s / abs(gain), D * period_s / abs(gain)
    made = plants.linear_plant(
        transfer,
        sampling_Hz=100.0 / period_s,
        profile=StepProfile(0.0, 1.0, 0.2 * period_s, 2.0 * period_s),
        settling_time_s=period_s,
        gains=Gains(P, I, D, filter_s * period_s),
        noise_rms_N=float(rng.choice([0.0, 0.003, 0.03])),
        output_min_N=-most,
        output_max_N=most,
    )
    fault, drift = rng.integers(0, 8), rng.normal(0.0, 0.05)

    def spoil(record):
        values = np.array(record.tension_N)
        if fault == 0:
            values[:] = values[0]
        elif fault == 1 and record.trial_id.endswith(("2", "5")):
            values[values.size // 2] = np.nan
        elif fault == 2:
            values = values + drift * record.time_s / period_s
        return replace(record, tension_N=values)

    return Changed(made.rig(seed=seed), spoil)


@pytest.mark.parametrize("tuner", list(TUNERS))
@pytest.mark.parametrize(
    "rigs",
    [
        range(2, 3),
        pytest.param(range(4), marks=pytest.mark.slow),
        pytest.param(range(100), marks=pytest.mark.nightly),
    ],
    ids=len,
)
def test_random_rigs_end_with_an_outcome_or_an_error_of_ours(tuner, rigs, tmp_path):
    def stop(progress):
        if progress.session.number == 3:
            raise KeyboardInterrupt

    refused = 0
    for number in rigs:
        run = f"run-{number}"
        try:
            options = {"folder": tmp_path, "run": run, "watch": stop}
            estune.tune(random_rig(number), tuner=tuner, trials=8, **options)
        except Stopped:
            resumed = estune.resume(tmp_path / run, random_rig(number), watch=None)
            assert resumed.ending
        except EstuneError:
            refused += 1
    assert refused <= len(rigs) / 2  # or the fuzz hardly tunes
