"""That naming what is hidden is not recognising one's own formula.

The best a model with the right effect can do, all its numbers free and without any noise, still
differs from the hidden machine by more than rounding, integrator or one common formula would.
"""

import numpy as np
import pytest
from scipy.optimize import least_squares

import plants
from experiments.hidden_machines import signals
from experiments.hidden_machines.bases import REEL, as_believed
from experiments.hidden_machines.effects import CATALOGUE
from experiments.hidden_machines.machine import DriveSignals, NoCompiler, run
from experiments.hidden_machines.records import MachineRecord, machine
from experiments.hidden_scores import measurement
from experiments.paper.identify import Band, multisine, open_loop_record
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.models.diagnosed_model import diagnosed
from plants.diagnosis.prediction.prediction import Predictor
from plants.effects import EFFECTS

RATE, LENGTH_m, TENSION_N = 632.0, 0.8, 15.0
CLOSEST = 2e-3
"""Error of a channel, relative to its deviation, below which the two would be one formula."""

STARTED = 250
"""Samples after which it no longer counts from where a free run was begun."""

MAIN = (
    "coulomb_friction",
    "stribeck_friction",
    "dahl_hysteresis",
    "eyelet_friction",
    "dead_time",
    "current_saturation",
    "rate_limit",
    "gauge_nonlinearity",
    "gauge_drift",
    "gauge_resonance",
    "cable_stiffening",
    "cable_creep",
    "structural_mode",
    "torque_ripple",
)


def noiseless(name):
    """A record of a machine with one effect, without noise or steps of converter and encoder."""
    rng = np.random.default_rng(11)
    base = as_believed(rng, REEL)
    hidden = CATALOGUE[name](rng, base)
    settings = machine(base, (hidden,), LENGTH_m) | {"encoder_step": 1e-9, "lag": 9e-5}
    setpoint = np.concatenate(
        [
            signals.steps(RATE, 1.5, [15.0, 21.0, 10.0, 15.0]),
            signals.triangle(RATE, 2.0, 15.0, 11.0, 1),
            signals.multisine(rng, RATE, 1.0, 1, 15.0, rms=4.5, high_Hz=110.0),
        ]
    )
    t, about = np.arange(setpoint.size) / RATE, hidden.instrument
    drift = about.get("drift", 0.0) * about.get("drift_s", 1.0)
    added = -drift * np.expm1(-t / about.get("drift_s", 1.0))
    drive = DriveSignals(setpoint, added, np.zeros(setpoint.size))
    try:
        done = run(settings, drive, RATE, rest_N=TENSION_N)
    except NoCompiler as error:
        pytest.skip(str(error))
    columns = {
        "time_s": t,
        "setpoint_N": setpoint,
        "current_A": setpoint / REEL.newtons_per_ampere,
        "tension_N": done.tension,
        "angle_rad": done.angle,
    }
    about = {
        "trial_id": "noiseless",
        "rig": "bench",
        "sampling_Hz": RATE,
        "cable_length_m": LENGTH_m,
        "preload_N": TENSION_N,
        "loop": "open",
        "profile": "custom",
        "gains": None,
    }
    return measurement(MachineRecord(columns, about)), hidden


class BestFit:
    """The model with one effect, fitted to a record in free run."""

    def __init__(self, name, record, truth) -> None:
        model = diagnosed(plants.reference_reel(LENGTH_m, TENSION_N), [record])
        self.predictor = Predictor(model, (EFFECTS[name],), [record], horizon_s=None)
        self.channels = [record.tension_N, record.angle_rad]
        self.log = np.array([free.scale == "log" for free in self.predictor.free])
        # Begun at the truth, where it is known, so that no local minimum flatters the contract.
        known = {f"{name}.{parameter}": value for parameter, value in truth.items()}
        start = self.predictor.row(known)
        bounds = np.array([(free.low, free.high) for free in self.predictor.free]).T
        low, high = map(self.searched, bounds)
        fit = least_squares(
            lambda x: self.errors(x[None, :])[0],
            np.clip(self.searched(start), low + 1e-12, high - 1e-12),
            self.slopes,
            bounds=(low, high),
            x_scale="jac",
            max_nfev=40,
        )
        self.worst = float(np.sqrt(np.mean(fit.fun.reshape(2, -1) ** 2, axis=1)).max())

    def searched(self, values):
        return np.where(self.log, np.log(np.where(self.log, values, 1.0)), values)

    def errors(self, points):
        rows = np.where(self.log, np.exp(np.where(self.log, points, 0.0)), points)
        found = self.predictor.predict(rows)[0]
        predicted = (found.tension_N, found.angle_rad)
        return np.concatenate(
            [
                ((p - c) / c.std())[:, STARTED:]
                for p, c in zip(predicted, self.channels, strict=True)
            ],
            axis=1,
        )

    def slopes(self, x):
        step = 1e-5 * np.maximum(np.abs(x), 0.02)
        rows = self.errors(np.vstack([x, x + np.diag(step)]))
        return ((rows[1:] - rows[0]) / step[:, None]).T


def test_formula_of_the_package_is_recognised():
    reel = plants.reference_reel(LENGTH_m, TENSION_N, encoder_counts=1e9)
    friction = plants.CoulombFriction(torque_Nm=0.03)
    excitation = multisine(RATE, Band(0.5, 100.0, 2.0, 2, 1), 8.0)
    record = MeasuredRecord.of(open_loop_record(reel + friction, excitation, seed=None))
    assert BestFit("coulomb_friction", record, {"torque_Nm": 0.025}).worst < 0.1 * CLOSEST


@pytest.mark.slow
@pytest.mark.parametrize("name", MAIN)
def test_hidden_formula_differs_from_that_of_the_package(name):
    record, hidden = noiseless(name)
    assert BestFit(name, record, hidden.truth).worst > CLOSEST
