"""An FMU as a plant, built here from a few lines of C: FMI 2 and 3, crashes, wrong files."""

import pickle

import numpy as np
import pytest

import estune
import plants
from estune.core import pidf
from estune.core.gains import Gains
from estune.errors import InvalidInput, PlantError
from plants.effects import CurrentSaturation
from plants.models.fmu.plant import fmu_plant
from plants.models.fmu.step import FmuStep
from plants.simulation.plant import TrialSetpoint
from tests.support_fmu import build


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    return str(build(tmp_path_factory.mktemp("fmu")))


def closed_loop(plant):
    """Columns of one trial on a setpoint of 3."""
    c = pidf.coefficients(plant.controller, Gains(2.0, 10.0, 0.01, 0.01))
    time_s = np.arange(100) / 100.0
    drive = TrialSetpoint(time_s, np.full(100, 3.0), 2.0, open_loop=False)
    return plant.respond(np.array([c, c]), drive, None, 1e9)


def reference(dead_time_s=0.0):
    def lag(x, effort, dt_s):
        x = effort + (x - effort) * np.exp(-dt_s / 0.1)
        return x, x

    return plants.python_plant(
        *(lag, 2.0),
        sampling_Hz=100.0,
        settling_time_s=0.3,
        initial_measurement_N=2.0,
        dead_time_s=dead_time_s,
    )


@pytest.mark.parametrize("version", [2, 3])
def test_fmu_responds_as_its_equation_trial_after_trial(tmp_path, version):
    file = str(build(tmp_path, version))
    settings = {"sampling_Hz": 100.0, "settling_time_s": 0.3, "dead_time_s": 0.014}
    plant = fmu_plant(file, input="u", output="F", **settings)
    one, other = closed_loop(plant), closed_loop(reference(0.014))
    np.testing.assert_allclose(one.tension_N, other.tension_N, rtol=1e-12)
    assert np.array_equal(one.tension_N[0], one.tension_N[1])


def test_simulinks_extra_step_is_taken_out_of_the_dead_time(tmp_path, caplog):
    file = str(build(tmp_path, tool="Simulink (R2025b)"))
    settings = {"sampling_Hz": 100.0, "settling_time_s": 0.3, "dead_time_s": 0.015}
    plant = fmu_plant(file, input="u", output="F", **settings)
    assert plant.dead_time_s == pytest.approx(0.005)
    assert "adds one step of delay" in caplog.text
    assert "one step late" in plant.summary()


def test_fmu_is_tuned_and_saved_as_a_model_file(tmp_path, fmu):
    model = f'[fmu]\nfile = "{fmu}"\ninput = "u"\noutput = "F"\nsampling_Hz = 100.0\n'
    (tmp_path / "lag.toml").write_text(model + "settling_time_s = 0.3\ninitial_effort_N = 2.0\n")
    plant = plants.load_model(tmp_path / "lag.toml")
    plants.save_model(plant, tmp_path / "saved.toml")
    assert plants.load_model(tmp_path / "saved.toml") == plant
    result = estune.tune(plant, trials=5, repeats=1, journal=False, watch=None)
    assert result.fun < 10.0


def test_crash_of_the_unit_is_an_error_and_the_next_trial_runs(fmu):
    step = pickle.loads(pickle.dumps(FmuStep(fmu, "u", "F")))  # noqa: S301  our own bytes
    with pytest.raises(PlantError, match="ended its process, exit code -6"):
        step(0.0, -999.0, 0.01)
    assert step(0.0, 0.0, 0.01)[1] == pytest.approx(2.0 * np.exp(-0.1))
    with pytest.raises(PlantError, match="check the model in its own tool"):
        step(0.01, 0.0, 6.0)


def test_effect_on_an_fmu_is_refused(fmu):
    plant = fmu_plant(fmu, input="u", output="F", sampling_Hz=100.0, settling_time_s=0.3)
    with pytest.raises(PlantError, match="takes no effects"):
        plant + CurrentSaturation(limit_A=3.0)


def test_file_that_cannot_be_used_is_refused_with_reason(tmp_path, fmu):
    with pytest.raises(InvalidInput, match="no variable T; it has u, F"):
        FmuStep(fmu, "u", "T").facts()
    foreign = str(build(tmp_path, platform="win64"))
    with pytest.raises(InvalidInput, match=r"no library for this machine .* \(it has win64\)"):
        FmuStep(foreign, "u", "F").facts()
    (tmp_path / "no.fmu").write_bytes(b"no FMU")
    with pytest.raises(InvalidInput, match="no FMU that can be loaded"):
        FmuStep(str(tmp_path / "no.fmu"), "u", "F").facts()
