"""A mode that the criterion refuses, in the limits of recommended gains."""

import estune
import plants
from estune.core.gains import Gains
from estune.loop_model.optimum import RobustnessLimits
from estune.service_records.sources import Logs
from experiments.loop_claims.truth import TrueLoop
from experiments.sample_efficiency.problems import PROBLEMS, step_trial
from experiments.service_records.service import Service, serve
from plants.effects import StructuralMode


def test_recommended_gains_keep_their_limits_with_a_mode_that_records_hardly_show():
    plant = plants.reference_reel() + StructuralMode(frequency_Hz=25.0)
    cost, gains = PROBLEMS["friction"].cost, Gains(0.6733, 11.24, 0.007739, 0.01004)
    trial = step_trial(plant, cost)
    record = serve(plant, trial, gains, Service("busy", 300.0), seed=1)
    log = record.log(trial.controller.sampling_Hz, gains)
    found = estune.suggest(Logs((log,), (), trial.controller), trial=trial)
    assert found.fit.order == 2
    better = found.recommendation
    at = TrueLoop(plant, cost).at(better.gains)
    assert at.overshoot <= RobustnessLimits().max_overshoot + 0.01  # 6.3 % by the fit alone
    assert at.sensitivity <= better.margins.sensitivity.high
