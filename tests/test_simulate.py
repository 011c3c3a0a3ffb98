import logging
import os
import subprocess
import sys
import threading

import control
import numpy as np
import pytest

import plants
from estune.core.cost import StepCost
from estune.core.gains import Gains
from estune.core.response import StepShape
from estune.errors import InvalidInput, PlantError
from estune.support import c_compiler
from estune.trial import SATURATED
from estune.trial.profiles import StepProfile
from plants.simulation.noise import NoiseSource
from plants.simulation.trial_loop import CasadiLoop, CompiledLoop, loop_functions, trial_loop

GAINS = Gains(1.2, 50.0, 0.02, 0.004)
FRICTION = plants.reference_reel() + plants.CoulombFriction(torque_Nm=0.03)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Empty cache for this test."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("ESTUNE_CACHE", str(folder))
    return folder


def libraries(folder):
    return sorted(folder.glob("*/*.so"))


PLANTS = {
    "reel": FRICTION,
    "fraction": plants.reference_reel(dead_time_s=2.4 / 632.0) + plants.CoulombFriction(),
    "slow gauge": plants.reference_reel(gauge_Hz=40.0, sampling_Hz=100.0, dead_time_s=0.0),
    "linear": plants.linear_plant(control.tf([1.0], [0.2, 1.0]), 0.31, 50.0),
    "saturated": plants.linear_plant(control.tf([1.0], [0.2, 1.0]), 0.0, 50.0, output_max_N=0.9),
}


@pytest.mark.parametrize("name", PLANTS)
def test_virtual_machine_matches_the_compiled_trial(name, monkeypatch):
    plant = PLANTS[name]
    profile = StepProfile(15.0, 10.0, 0.1, 0.6)
    samples = profile.samples(plant.controller.sampling_Hz)
    noise = np.random.default_rng(4).normal(0.0, 0.05, samples)
    compiled = plants.simulate(plant, GAINS, profile, noise_N=noise)
    virtual_loop = CasadiLoop(loop_functions(plant.structure.equations()))
    monkeypatch.setattr("plants.models.plant_model.trial_loop", lambda _: virtual_loop)
    virtual = plants.simulate(plant, GAINS, profile, noise_N=noise)
    for column in ("tension_N", "effort_N", "angle_rad"):
        assert getattr(virtual, column) == pytest.approx(
            getattr(compiled, column), rel=1e-10, abs=1e-10
        )
    assert np.array_equal(virtual.flags, compiled.flags)
    assert virtual.diverged_at == compiled.diverged_at


def test_structure_is_compiled_once(cache):
    a = trial_loop.__wrapped__(plants.reference_reel(0.5, 8.0).structure)
    b = trial_loop.__wrapped__(plants.reference_reel(1.4, 30.0, gauge_Hz=250.0).structure)
    assert isinstance(a, CompiledLoop)
    assert isinstance(b, CompiledLoop)
    assert len(libraries(cache)) == 1


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], lambda _: b"", lambda b: b[:-9] + b"corrupted"]
)
def test_corrupt_library_is_compiled_again(cache, damage):
    source = "int estune_spoilt(void) { return 41; }"
    source = source.replace("int", '__attribute__((visibility("default"))) int', 1)
    assert c_compiler.load(source).estune_spoilt() == 41
    (library,) = libraries(cache)
    whole = library.read_bytes()
    library.unlink()  # a new file, for this process still has the old one in memory
    library.write_bytes(damage(whole))
    assert c_compiler.load(source).estune_spoilt() == 41
    (again,) = libraries(cache)
    assert again.read_bytes() == whole


def no_equations(_):
    raise AssertionError("the equations were written")


@pytest.mark.usefixtures("cache")
def test_known_library_is_loaded_without_its_equations(monkeypatch):
    structure = plants.reference_reel().structure
    trial_loop.__wrapped__(structure)
    monkeypatch.setattr(type(structure), "equations", no_equations)
    assert isinstance(trial_loop.__wrapped__(structure), CompiledLoop)
    other = (plants.reference_reel() + plants.CoulombFriction()).structure
    with pytest.raises(AssertionError, match="were written"):
        trial_loop.__wrapped__(other)


@pytest.mark.usefixtures("cache")
def test_equations_of_a_users_effect_are_written_in_every_process(monkeypatch):
    class Own(plants.CoulombFriction):
        """Might have another text in the next process."""

    structure = (plants.reference_reel() + Own()).structure
    trial_loop.__wrapped__(structure)
    monkeypatch.setattr(type(structure), "equations", no_equations)
    with pytest.raises(AssertionError, match="were written"):
        trial_loop.__wrapped__(structure)


@pytest.mark.parametrize("damage", ["", "*", "0" * 32])
def test_note_of_a_library_that_is_not_there_is_written_again(cache, damage):
    structure = plants.reference_reel().structure
    trial_loop.__wrapped__(structure)
    (note,) = cache.glob("*.key")
    whole = note.read_text()
    note.write_text(damage)
    assert isinstance(trial_loop.__wrapped__(structure), CompiledLoop)
    assert note.read_text() == whole


@pytest.mark.slow
def test_concurrent_processes_compile_the_same_structure(cache):
    code = (
        "import plants; from estune.core.gains import Gains;"
        "r = plants.simulate(plants.reference_reel(), Gains(1.0, 30.0, 0.01, 0.01));"
        "print(repr(float(r.tension_N.sum())))"
    )
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for _ in range(4)
    ]
    answers = [process.communicate(timeout=120) for process in started]
    assert {error for _, error in answers} == {""}
    assert len({out for out, _ in answers}) == 1
    # No partial file remains.
    assert {path.suffix for path in cache.rglob("*") if path.is_file()} == {".so", ".key"}


def run_elsewhere(**environment):
    """Kind of loop, total cost and standard error of a trial in a new process."""
    code = (
        "import plants; from estune.core.gains import Gains;"
        "from plants.simulation import trial_loop;"
        "a = plants.reference_reel(); b = a + plants.CoulombFriction();"
        "g = Gains(1.2, 50.0, 0.02, 0.004);"
        "n = [float(plants.simulate(r, g).tension_N.sum()) for r in (a, b, a)];"
        "print(type(trial_loop.trial_loop(a.structure)).__name__, n[0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, timeout=120, check=True, env={**os.environ, **environment},
    )  # fmt: skip
    kind, total = done.stdout.split()
    return kind, float(total), done.stderr


TOTAL = float(plants.simulate(plants.reference_reel(), GAINS).tension_N.sum())


def test_missing_compiler_selects_the_virtual_machine_with_one_notice(cache):
    kind, total, stderr = run_elsewhere(PATH=str(cache), CC="")
    assert kind == "CasadiLoop"
    assert total == pytest.approx(TOTAL, rel=1e-12)
    assert stderr.count("virtual machine") == 1
    assert "no C compiler found" in stderr


def test_failing_compiler_is_named(tmp_path, cache):
    broken = tmp_path / "broken-cc"
    broken.write_text("#!/bin/sh\necho 'out of ideas' >&2\nexit 3\n")
    broken.chmod(0o755)
    kind, total, stderr = run_elsewhere(CC=str(broken))
    assert (kind, total) == ("CasadiLoop", pytest.approx(TOTAL, rel=1e-12))
    assert "broken-cc failed: out of ideas" in stderr
    assert libraries(cache) == []


@pytest.mark.slow
def test_unwritable_cache_falls_back_to_a_temporary_folder(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    kind, total, stderr = run_elsewhere(ESTUNE_CACHE=str(blocked / "cache"))
    assert (kind, total, stderr) == ("CompiledLoop", TOTAL, "")


def test_notice_is_given_once(caplog, monkeypatch):
    monkeypatch.setattr(c_compiler, "_noticed", threading.Event())
    with caplog.at_level(logging.WARNING):
        c_compiler.notice("first")
        c_compiler.notice("second")
    (record,) = caplog.records
    assert record.getMessage().endswith("first")


@pytest.mark.parametrize("plant", [FRICTION, PLANTS["linear"]])
def test_batch_costs_equal_those_of_single_trials(plant):
    step = StepProfile(15.0, 5.0, 0.1, 1.5)
    cost = StepCost(0.5, move_weight=0.2)
    rate = plant.controller.sampling_Hz
    table = np.exp(np.random.default_rng(2).normal(0.0, 0.3, (150, 4))) * GAINS.as_tuple()
    expected = []
    for row in table:
        trial = plants.simulate(plant, Gains(*row), step)
        finished = trial.diverged_at is None
        expected.append(
            cost.evaluate(
                rate, step.shape(rate), trial.setpoint_N, trial.tension_N, trial.effort_N
            )
            if finished
            else np.nan
        )
    for workers in (1, 2, None):
        costs = plants.batch_costs(plant, table, step, cost, workers=workers)
        assert costs == pytest.approx(np.array(expected), rel=1e-12, nan_ok=True)


def test_batch_noise_equals_that_of_the_rig():
    reel, step, cost = plants.reference_reel(), StepProfile(15.0, 10.0, 0.2, 1.0), StepCost(0.13)
    costs = plants.batch_costs(reel, [GAINS.as_tuple()] * 70, step, cost, seed=9)
    noise = NoiseSource(9).draw(66, 632, reel.gauge_noise_N)
    trial = plants.simulate(reel, GAINS, step, noise_N=noise)
    alone = cost.evaluate(
        632.0, StepShape(126, 10.0), trial.setpoint_N, trial.tension_N, trial.effort_N
    )
    assert costs[66] == pytest.approx(alone, rel=1e-12)
    assert np.ptp(costs) > 0.0


def test_empty_batch_has_no_costs():
    assert plants.batch_costs(FRICTION, np.empty((0, 4)), None, StepCost(0.1)).shape == (0,)


UNSTABLE = plants.linear_plant(control.tf([1.0], [1.0, -1.0]), 0.0, 20.0)


def test_divergence_ends_the_trial_and_reports_the_sample():
    step = StepProfile(0.0, 1.0, 0.5, 40.0)
    trial = plants.simulate(UNSTABLE, Gains(0.1, 0.0, 0.0, 0.0), step)
    assert trial.diverged_at is not None
    columns = (trial.time_s, trial.setpoint_N, trial.tension_N, trial.effort_N, trial.angle_rad)
    assert {len(column) for column in (*columns, trial.flags)} == {trial.diverged_at}
    assert np.abs(trial.tension_N).max() <= 100.0  # a hundred times the step
    further = plants.simulate(UNSTABLE, Gains(0.1, 0.0, 0.0, 0.0), step, bound_N=1e3)
    assert further.diverged_at > trial.diverged_at
    assert np.abs(further.tension_N[trial.diverged_at]) > 100.0
    stable = plants.simulate(UNSTABLE, Gains(3.0, 1.0, 0.0, 0.0), step)
    assert stable.diverged_at is None


def test_response_that_is_not_finite_has_diverged_for_any_bound():
    step = StepProfile(0.0, 1.0, 0.5, 2000.0)
    trial = plants.simulate(UNSTABLE, Gains(0.1, 0.0, 0.0, 0.0), step, bound_N=float("inf"))
    assert trial.diverged_at is not None
    assert np.isfinite(trial.tension_N).all()


def test_diverged_trial_of_a_batch_costs_nan():
    step = StepProfile(0.0, 1.0, 0.5, 40.0)
    costs = plants.batch_costs(
        UNSTABLE, [(0.1, 0.0, 0.0, 0.0), (3.0, 1.0, 0.0, 0.0)], step, StepCost(5.0)
    )
    assert np.isnan(costs[0])
    assert np.isfinite(costs[1])


def test_saturation_is_flagged_where_the_limits_act():
    trial = plants.simulate(
        PLANTS["saturated"], Gains(3.0, 5.0, 0.0, 0.0), StepProfile(0.0, 0.8, 0.1, 3.0)
    )
    assert set(np.unique(trial.flags)) == {0, SATURATED}
    assert np.all(trial.effort_N[trial.flags == SATURATED] == 0.9)


def cost_of(gains, settling_time_s=0.1):
    return plants.batch_costs(FRICTION, gains, None, StepCost(settling_time_s))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cost_of([[1.0, 2.0]]), r"shape \(1, 2\)"),
        (lambda: cost_of([(1, 1, 0, 0), (1, np.nan, 0, 0)]), "gain I is nan"),
        (lambda: cost_of([(-1, 1, 0, 0)]), "gain P is -1"),
        (lambda: cost_of([(1, 1, 0, 0)], 9.0), "settling time 9 s"),
        (lambda: plants.simulate(FRICTION, GAINS, noise_N=np.zeros(3)), "632 samples"),
        (lambda: plants.simulate(FRICTION, GAINS, StepProfile(15, 1, 1e-4, 2e-4)), "longer"),
        (lambda: NoiseSource(-1), "seed is -1"),
        (lambda: NoiseSource(1.5), "seed is 1.5"),
    ],
)
def test_simulate_rejects_bad_input_in_one_line(call, message):
    with pytest.raises(InvalidInput, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_exception_in_a_batch_thread_reaches_the_caller():
    plant = plants.python_plant(lambda *_: None, 0.0, sampling_Hz=20.0, settling_time_s=1.0)
    with pytest.raises(PlantError, match="NoneType"):
        plants.batch_costs(plant, [(1, 1, 0, 0)] * 200, None, StepCost(1.0), workers=2)


def test_noise_is_white_and_depends_only_on_seed_and_number():
    source = NoiseSource(5)
    first = source.draw(3, 4000, 0.04)
    source.draw(8, 10, 1.0)
    assert np.array_equal(source.draw(3, 4000, 0.04), first)
    assert np.array_equal(NoiseSource(5).draw(3, 632, 0.04), first[:632])
    others = (NoiseSource(5).draw(4, 4000, 0.04), NoiseSource(6).draw(3, 4000, 0.04))
    for other in (*others, np.roll(first, 1)):
        assert abs(np.corrcoef(first, other)[0, 1]) < 0.06
    assert np.std(first) == pytest.approx(0.04, rel=0.05)
