"""The trial board: its program in C on a pseudo-terminal, its rig, and the loop it closes."""

import copy
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
import tty
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import estune
from estune.cli import run
from estune.conformance.rig import RigConformance
from estune.core import pidf
from estune.core.gains import Gains
from estune.errors import RigError
from estune.hardware.compensation.plan import KnownMotion
from estune.hardware.compensation.runtime import PlainCompensation
from estune.hardware.config import config_from
from estune.hardware.trial_board.export import board_files
from estune.hardware.trial_board.rig import BoardRig
from estune.remote.zenoh import connect, serve
from estune.trial import Outcome, TrialRecord, TrialRequest
from estune.trial.loop_records import recomputed_effort
from plants.emulator import RIG_FILE
from tests.support_hardware import config

# Powers of two: effort and current then convert exactly.
BOARD = {
    "driver": {"use": "trial-board", "settings": {"port": "", "answer_within_s": 1.0}},
    "reel__drum_radius_m": 0.03125,
    "limits__duration_max_s": 2.0,
    "motion": {
        "hold_N": 16.0,
        "rate_N_s": 2000.0,
        "settle_s": 3.0,  # until the last bit is at rest
        "settle_N": 0.5,
        "settle_within_s": 10.0,
        "take_up_A": 1.0,
        "taut_N": 15.9375,
    },
    "gains": {"P": 0.2, "I": 20.0, "D": 0.0005, "setpoint_filter_s": 0.01},
    "guard__tension_max_N": 45.0,
    "step__preload_N": 16.0,
    "step__step_N": 8.0,
    "step__duration_s": 0.5,
    "settling_time_s": 0.1,
    "guard__heartbeat_s": 30.0,  # of the board's samples, which pass faster than time
}
PERIOD_us = 20


def rig_file(**changes):
    return config(**{**copy.deepcopy(BOARD), **changes})


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("board"), rig_file())


def compiled(folder, rig, *more):
    for name, text in board_files(rig).items():
        (folder / name).write_text(text)
    source = Path(__file__).with_name("trial_board_main.c")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-O2"]
    command = ["cc", *strict, *more, f"-I{folder}", "-o", folder / "board", source, "-lm"]
    subprocess.run(command, check=True)
    return folder / "board"


@contextmanager
def running(program, period_us=PERIOD_us):
    """A board; yields the path of its port and its process."""
    ours, theirs = os.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    command = [program, str(ours), str(period_us)]
    with subprocess.Popen(command, pass_fds=(ours,)) as process:
        try:
            yield os.ttyname(theirs), process
        finally:
            process.kill()
            os.close(ours)
            os.close(theirs)


@contextmanager
def board_rig(program, **changes):
    with running(program) as (port, process):
        settings = {"port": port, "answer_within_s": 1.0}
        with BoardRig(rig_file(driver__settings=settings, **changes)) as rig:
            yield rig, process


class TestBoard(RigConformance):
    @pytest.fixture(scope="class")
    @classmethod
    def endpoint(cls, tmp_path_factory):
        folder = tmp_path_factory.mktemp("board")
        ledger, quick = folder / "ledger", {"motion__settle_s": 0.02}
        # In wall-clock time, so that a trial can be stopped.
        with running(compiled(folder, rig_file(**quick)), 1500) as (port, _):
            settings = {"port": port, "answer_within_s": 1.0}
            with (
                BoardRig(rig_file(driver__settings=settings, **quick)) as rig,
                serve(rig, "tcp/127.0.0.1:0", ledger=ledger) as server,
            ):
                yield server.endpoint


class Reference:
    """The board's sequence in Python, on `estune.core.pidf`: the same samples, bit for bit."""

    def __init__(self, file):
        self.file, self.about = file, file.describe()
        self.y = self.effort = 0.0
        self.live = pidf.coefficients(self.about.controller, self.about.gains)
        self.state = None

    def measure(self):
        self.y = 0.5 * self.y + 0.5 * self.effort
        return self.y

    def step(self, c, setpoint, y):
        self.state, effort, _ = pidf.step(c, self.state, setpoint, y)
        self.effort = float(effort)

    def move(self, setpoint, target, y=None):
        """Moves and settles; the tension measured last, at which the trial begins."""
        motion, settled = self.file.motion, 0
        rate, needed = motion.rate_N_s / 632.0, int(np.ceil(motion.settle_s * 632.0))
        while True:
            y = self.measure() if y is None else y
            setpoint += min(max(target - setpoint, -rate), rate)
            self.step(self.live, setpoint, y)
            settled = settled + 1 if abs(y - target) < motion.settle_N else 0
            if settled > needed:
                return setpoint, y
            y = None

    def swap(self, c, setpoint, y):
        self.state = pidf.bumpless(c, self.state, setpoint, y, self.effort)

    def run(self, request):
        profile, y = request.profile, None
        if self.state is None:  # take the slack up
            self.effort = self.file.motion.take_up_A * self.file.newtons_per_ampere
            while (y := self.measure()) < self.file.motion.taut_N:
                pass
            self.state, self.setpoint = pidf.state_at_rest(y, self.effort), y
        self.setpoint, y = self.move(self.setpoint, profile.preload_N, y)
        c = pidf.coefficients(self.about.controller, request.gains)
        self.swap(c, self.setpoint, y)
        setpoint = profile.setpoint(632.0)
        tension, efforts = np.empty(setpoint.size), np.empty(setpoint.size)
        for k, r in enumerate(setpoint.tolist()):
            y = self.measure() if k else y
            self.step(c, r, y)
            tension[k], efforts[k] = y, self.effort
        self.swap(self.live, r, y)
        self.setpoint, _ = self.move(r, self.file.hold_N)
        zeros = np.zeros(setpoint.size)
        return TrialRecord(
            *(request.trial_id, "reel", 632.0, self.about.cable_length_m, profile.preload_N),
            *(request.gains, Outcome.DONE, "", "2026-01-01T00:00:00+00:00", "reference"),
            time_s=zeros,
            setpoint_N=setpoint,
            tension_N=tension,
            current_A=efforts / 16.0,
            angle_rad=zeros,
            flags=zeros.astype(np.uint8),
        )


def test_trials_of_a_tuning_on_the_board_are_those_of_the_simulated_loop_bit_for_bit(
    program, tmp_path
):
    with board_rig(program) as (rig, _):
        options = {"trials": 4, "repeats": 1, "folder": tmp_path, "watch": None}
        result = estune.tune(rig, tuner="least_squares_gradient", **options)
    reference = Reference(rig_file())
    records = [result.record(entry.number) for entry in result.entries]
    assert len({record.gains for record in records}) > 3
    for record in records:
        simulated = reference.run(TrialRequest("r", 0, record.gains, result.plan.step))
        assert np.array_equal(record.tension_N, simulated.tension_N)
        assert np.array_equal(record.current_A, simulated.current_A)


def test_compensations_on_the_board_are_those_of_the_computer(tmp_path):
    compensation = {
        "friction": {
            "coulomb_Nm": 0.002,
            "static_Nm": 0.003,
            "stribeck_rad_s": 0.5,
            "tension_per_rad_N": 190.0,
        },
        "inertia": {"inertia_kgm2": 1e-5},
        "gravity": {"weight_N_m": 0.5, "rise_m": 0.4, "length_min_m": 0.5, "length_max_m": 1.4},
        "angle_map": {
            "zero": "absolute",
            "orders": [1, 7],
            "torque_Nm": [0.001, 0.002],
            "phase_rad": [0.5, 1.0],
            "lead_s": 0.001,
        },
        "mode": {"frequency_Hz": 100.0, "width_Hz": 30.0, "depth": 0.3},
        "eyelet": {"attenuation": 0.95, "memory_rad": 0.004, "tension_per_rad_N": 190.0},
        "current_limit": {"limit_A": 1.8},
    }
    changes = {"compensation": compensation, "motion": BOARD["motion"] | {"taut_N": 15.0}}
    with board_rig(compiled(tmp_path, rig_file(**changes)), **changes) as (rig, _):
        record = rig.run(request(rig, 1))
        about = rig.describe()
    assert record.outcome is Outcome.DONE
    plain = PlainCompensation(rig_file(**changes).compensations())
    gauge = record.tension_N + record.gravity_N + record.notch_N + record.eyelet_N
    c = pidf.coefficients(about.controller, record.gains)
    filtered = filter_setpoint(c.setpoint_pole, record.setpoint_N)
    sampled = zip(record.time_s, gauge, record.angle_rad, map(KnownMotion, filtered), strict=True)
    # From the step on: before it, friction keeps the direction of the way to the preload.
    moved = slice(round(about.step.step_at_s * record.sampling_Hz) + 20, None)
    terms = np.array([plain.sample(*row) for row in sampled])[moved]
    recorded = (
        record.drum_velocity_rad_s,
        record.gravity_N,
        16.0 * record.friction_A,
        16.0 * record.inertia_A,
        16.0 * record.angle_map_A,
        record.notch_N,
        record.eyelet_N,
        16.0 * record.current_limit_A,
    )
    assert np.abs(terms).max(axis=0).min() > 0.0
    # The board counts time from its start: another rounding may choose another window.
    np.testing.assert_allclose(np.transpose(recorded)[moved], terms, rtol=1e-6, atol=1e-4)
    own = 16.0 * record.controller_A
    np.testing.assert_allclose(recomputed_effort(record, about, own[0]), own, atol=1e-3)


def filter_setpoint(pole, setpoint):
    """The filtered setpoint of the sample before each."""
    steps = setpoint - setpoint[0]
    filtered = setpoint[0] + lfilter([1.0 - pole], [1.0, -pole], steps)
    return np.concatenate(([setpoint[0]], filtered[:-1])).tolist()


def request(rig, number, gains=None, **changes):
    about = rig.describe()
    step = replace(about.step, **changes)
    return TrialRequest("board", number, gains or about.gains, step)


def test_unstable_gains_trip_the_boards_guard_and_the_next_trial_runs(program):
    with board_rig(program) as (rig, _):
        record = rig.run(request(rig, 1, Gains(50.0, 0.0, 0.0, 0.0)))
        assert record.outcome is Outcome.GUARD
        assert "tension crossed the board's limit" in record.reason
        assert 0 < record.tension_N.size < 316
        assert rig.run(request(rig, 2)).outcome is Outcome.DONE


def test_gauge_that_fails_is_a_fault_of_the_rig_and_not_of_the_gains(program):
    with board_rig(program) as (rig, process):
        threading.Timer(0.1, process.send_signal, (signal.SIGUSR1,)).start()
        record = rig.run(request(rig, 1, step_at_s=1.9, duration_s=2.0))
        assert record.outcome is Outcome.INTERRUPTED
        assert "fault of the board's sensors" in record.reason
        with pytest.raises(RigError, match="could not be measured"):
            rig.run(request(rig, 2))
        process.send_signal(signal.SIGUSR1)
        rig.clear()
        assert rig.run(request(rig, 3)).outcome is Outcome.DONE


@pytest.mark.slow
def test_served_board_ends_cleanly_when_it_is_told_to(tmp_path):
    text = RIG_FILE.read_text().replace(
        'use = "plants.emulator:EmulatedDriver"', 'use = "trial-board"'
    )
    quick = compiled(tmp_path, config_from(tomllib.loads(text), "rig.toml"))
    for _ in range(3):
        with running(quick, 1500) as (port, _):
            lines = text.splitlines()
            (at,) = (k for k, line in enumerate(lines) if line.startswith("settings = { reel"))
            lines[at] = f'settings = {{ port = "{port}", answer_within_s = 1.0 }}'
            (tmp_path / "rig.toml").write_text("\n".join(lines))
            command = [sys.executable, "-m", "estune", "serve-hardware", tmp_path / "rig.toml"]
            with subprocess.Popen(command, stdout=-1, stderr=-1, text=True) as served:
                endpoint = served.stdout.readline().split()[-1]
                with connect(endpoint) as rig:
                    rig.status()
                served.send_signal(signal.SIGTERM)
                assert (served.wait(30), served.stderr.read()) == (0, "")


def test_board_comes_to_rest_by_itself_when_the_computer_falls_silent(tmp_path):
    quick = compiled(tmp_path, rig_file(guard__heartbeat_s=1.0))
    with running(quick) as (port, _):
        settings = {"port": port, "answer_within_s": 1.0}
        with BoardRig(rig_file(driver__settings=settings)) as rig:
            rig.run(request(rig, 1))
            link = rig._link
            with link._lock:  # no sign of life
                time.sleep(1.0)
            assert link.status(b"s").state.name == "OFF"


def test_dead_board_fails_the_trial_and_the_rig(program):
    with running(program, 10_000) as (port, process):
        settings = {"port": port, "answer_within_s": 0.05}
        with BoardRig(rig_file(driver__settings=settings)) as rig:
            asked = request(rig, 1, step_at_s=1.9, duration_s=2.0)
            threading.Timer(0.05, process.kill).start()
            with pytest.raises(RigError, match="has not answered 5 requests"):
                rig.run(asked)
            rig.wait()
            with pytest.raises(RigError, match="start it anew"):
                rig.describe()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RigError])
def test_trial_that_the_computer_no_longer_waits_for_is_stopped(error, program, monkeypatch):
    def fail(_):
        raise error

    with board_rig(program) as (rig, _):
        monkeypatch.setattr(rig, "_until_ended", fail)
        with pytest.raises(error):
            rig.run(request(rig, 1, step_at_s=1.9, duration_s=2.0))
        monkeypatch.undo()
        assert not rig._link.status(b"s").pending
        assert rig.run(request(rig, 2)).outcome is Outcome.DONE


def test_trial_under_way_is_not_given_the_setpoints_of_the_next(program):
    """The board drops them, and would run the next trial by those of the one before."""
    with board_rig(program) as (rig, _):
        under_way = request(rig, 1, step_at_s=1.9, duration_s=2.0)
        setpoint = under_way.profile.setpoint(rig._config.sampling_Hz)
        rig._send_setpoint(setpoint)
        rig._begin(under_way, len(setpoint))
        with pytest.raises(RigError, match="still runs"):
            rig.run(request(rig, 2))
        rig.abort()
        assert rig.run(request(rig, 3)).outcome is Outcome.DONE


def test_stop_is_latched_until_cleared(program):
    with board_rig(program) as (rig, _):
        rig.run(request(rig, 1))
        rig.estop("test")
        with pytest.raises(RigError, match="emergency stop"):
            rig.run(request(rig, 2))
        with pytest.raises(RigError, match="emergency stop"):
            rig.apply(Gains(1.0, 2.0, 0.0, 0.0))
        rig.clear()
        assert rig.run(request(rig, 3)).outcome is Outcome.DONE


def test_board_keeps_its_record_in_half_the_memory_as_single_numbers(tmp_path, program):
    records = []
    for binary in (program, compiled(tmp_path, rig_file(), "-Destune_stored=float")):
        with board_rig(binary) as (rig, _):
            records.append(rig.run(request(rig, 1)))
    whole, half = (record.tension_N for record in records)
    np.testing.assert_allclose(half, whole, rtol=1e-6)
    assert not np.array_equal(half, whole)
    text = board_files(rig_file())["estune_board.h"]
    assert f"{1e-3 * rig_file().capacity * 40:.0f} kB of memory, 40 bytes" in text


def test_board_program_is_exported_with_the_limits_of_the_rigs_file(tmp_path, capsys):
    (tmp_path / "rig.toml").write_text(RIG_FILE.read_text())
    out = str(tmp_path / "estune_pidf.c")
    assert (
        run(["export-controller", str(tmp_path / "rig.toml"), "--c", "--board", "--out", out]) == 0
    )
    assert {path.name for path in tmp_path.iterdir()} == {
        *("rig.toml", "estune_pidf.c", "estune_board.h", "estune_trial_board.c")
    }
    assert "#define ESTUNE_TENSION_GUARD 60.0" in (tmp_path / "estune_board.h").read_text()
    assert "estune_trial_board.c" in capsys.readouterr().out
