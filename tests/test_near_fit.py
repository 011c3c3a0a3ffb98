"""The loop of the trials near some gains, where no linear model explains all trials."""

from dataclasses import replace

import control
import numpy as np
import pytest

from estune.core.gains import Gains
from estune.loop_model.fit_signals import FitSignals, RecordGroup
from estune.loop_model.fitting import fit_loop
from estune.loop_model.intervals import predict_with_intervals
from estune.loop_model.margins import robustness
from estune.loop_model.near_fit import fit_near
from estune.loop_model.whiteness import is_contradicted
from estune.trial import TrialRequest
from estune.trial.loop_records import loop_signals
from experiments.batch.__main__ import start_of
from experiments.batch.loop import ProcessLoop
from experiments.batch.processes import PROCESSES
from experiments.batch.rig import BatchRig, Disturbance
from experiments.loop_claims import true_sensitivity
from tests.test_loop_model import COST, SAMPLING_HZ, SYSTEM, W, linear, record_of, trial_of

TIMID, TRIED = Gains(0.1, 2.0, 0.002, 0.05), Gains(0.8, 12.0, 0.02, 0.01)


def changed_between():
    """Three timid trials of a plant, and two of one of a smaller gain."""
    before, after = linear(), linear(system=0.7 * SYSTEM)
    records = [record_of(before, TIMID, n) for n in range(3)]
    return after, [*records, *(record_of(after, TRIED, n) for n in (3, 4))]


def test_plant_that_changed_is_known_by_the_trials_near_the_gains():
    after, records = changed_between()
    all_of_them = fit_loop(records, SAMPLING_HZ, COST.settling_time_s)
    assert not all_of_them.is_white
    near = fit_near(
        TRIED, records, (), SAMPLING_HZ, COST.settling_time_s, misfit=all_of_them.misfit
    )
    assert near.steps == (3, 4)
    assert near.fit.near_error > all_of_them.near_error == 0.0
    true = true_sensitivity(after, TRIED)
    told = predict_with_intervals(near.fit, trial_of(after), TRIED).sensitivity
    assert told.low <= true <= told.high
    assert told.value == pytest.approx(true, rel=0.02)
    of_all = robustness(all_of_them.model, TRIED, after.controller).sensitivity
    assert of_all != pytest.approx(true, rel=0.02)


def test_fewer_than_two_trials_near_the_gains_are_no_fit_of_their_own():
    _, records = changed_between()
    assert fit_near(TRIED, records[:4], (), SAMPLING_HZ, COST.settling_time_s, misfit=0.01) is None


def test_excitation_that_contradicts_the_steps_near_it_stays_as_an_error_of_the_plant():
    _, records = changed_between()
    damped = control.tf([W * W], [1.0, 1.4 * W, W * W])
    excitation = record_of(linear(system=damped), TRIED, 5)
    near = fit_near(TRIED, records, [excitation], SAMPLING_HZ, COST.settling_time_s, misfit=0.01)
    assert near.excitations == (excitation,)
    assert len(near.fit.errors) == 3
    assert near.fit.misfits[2] > 3.0 * max(near.fit.misfits[:2])
    assert not near.fit.is_white


def test_coloured_load_before_the_steps_is_noise_and_not_a_pole():
    process = next(p for p in PROCESSES if p.name == "e^-s/(2s+1)")
    loop, start = ProcessLoop(process, 0.003), start_of(process)
    rig, rate = BatchRig(loop, start, 3, Disturbance(0.01)), 1.0 / loop.h
    description, tried = rig.describe(), replace(start, P=3.0 * start.P, I=3.0 * start.I)
    records = [
        loop_signals(
            rig.run(TrialRequest("run", n, g, description.step)), description.step, description
        )
        for n, g in enumerate((start, start, tried, tried))
    ]
    fit = fit_loop([one.record for one in records], rate, process.settling_time_s)
    assert fit.is_white
    assert fit.noise.load > 0.0
    assert fit.order <= 2
    Ms = robustness(fit.model, tried, description.controller).sensitivity
    assert loop.at(tried, COST).Ms == pytest.approx(Ms, rel=0.1)


@pytest.mark.parametrize("rests", [False, True])
def test_load_that_foretells_a_resting_reading_worse_than_its_mean_is_contradicted(rests):
    noise = np.random.default_rng(1).standard_normal((2, 160))
    reading = noise if rests else np.cumsum(noise, axis=1)
    errors = np.diff(reading, axis=1, prepend=0.0)
    group = RecordGroup(np.zeros_like(reading), reading, 0, (0, 1), 80)
    assert is_contradicted(FitSignals((group,), 100.0, 0.01), errors.ravel()) == rests
