"""An emulated rig: its configuration, and its loop in virtual time without any process."""

import copy
import os
import tomllib
from types import SimpleNamespace

import plants
from estune.core import pidf
from estune.hardware.compensation.runtime import NoCompensation, PlainCompensation
from estune.hardware.config import RigConfig, config_from
from estune.hardware.controller import PlainController
from estune.hardware.driver import Reading
from estune.hardware.loop_messages import BeginTrial
from estune.hardware.reel_machine.machine import ReelStateMachine
from estune.hardware.shared_memory import Memory, MotionPhase, SensorLevels, Word, make_file
from plants.emulator import RIG_FILE
from plants.emulator.board import Electronics, EmulatedBoard

_TABLES = tomllib.loads(RIG_FILE.read_text())


def tables(**changes) -> dict:
    """Tables of plants/emulator/rig.toml with changes such as `guard__slack_N=2.0`."""
    tables_copy = copy.deepcopy(_TABLES)
    for name, value in changes.items():
        *path, key = name.split("__")
        place = tables_copy
        for part in path:
            place = place[part]
        place[key] = value
    return tables_copy


def config(**changes) -> RigConfig:
    return config_from(tables(**changes), "rig.toml")


def quick(**changes) -> RigConfig:
    """Tables of `tables` with short trials and moves, for tests in wall-clock time."""
    short = {
        "settling_time_s": 0.05,
        "motion__settle_s": 0.02,
        "motion__rate_N_s": 400.0,
        "motion__settle_N": 1.0,
        "guard__late_in_a_row": 1000,  # the test machine may be busy
        "guard__gap_s": 0.5,
        "real_time__priority": 50,
        "driver__settings": {"electronics": {"watchdog_s": 0.2}, "seed": 1},
        "step__step_N": 5.0,
        "step__step_at_s": 0.05,
        "step__duration_s": 0.15,
    }
    return config(**(short | changes))


def loop_state(rig) -> SimpleNamespace:
    """What the loop of a rig on hardware does now, and its latest readings."""
    words, levels = rig._memory.words, rig._memory.levels
    return SimpleNamespace(
        phase=MotionPhase(words[Word.PHASE]).name.lower(),
        latched=bool(words[Word.LATCHED] or words[Word.ESTOP]),
        in_position=bool(words[Word.IN_POSITION]),
        tension_N=levels[SensorLevels.TENSION_N],
        current_A=levels[SensorLevels.CURRENT_A],
        angle_rad=levels[SensorLevels.ANGLE_rad],
    )


class VirtualLoop:
    """The loop of `estune.hardware.loop` without its clock and its pipe.

    Attributes:
        current_A: What was commanded at each sample.
        tension_N: What was read.
        turned: Counts by which something else has turned the drum.
    """

    def __init__(self, rig: RigConfig, *, noise_N: float = 0.0) -> None:
        self.plan = rig.plan()
        file = make_file(self.plan.capacity)
        self.memory = Memory(file, self.plan.capacity)
        os.close(file)
        compensation = (
            PlainCompensation(self.plan.compensation)
            if self.plan.compensation
            else NoCompensation()
        )
        self.machine = ReelStateMachine(self.plan, self.memory, PlainController(), compensation)
        reel = plants.reference_reel(gauge_noise_N=noise_N or 1e-4)
        self.board = EmulatedBoard(reel, Electronics(watchdog_s=10.0), 0, 0.0)
        self.rig = rig
        self.columns = self.memory.columns
        self.time_s = 0.0
        self.current_A: list[float] = []
        self.tension_N: list[float] = []
        self._powered = False
        self.turned = 0

    def ask(self, gains, profile, number: int = 1, cost_max=float("inf")) -> None:
        settings = self.rig.settings()
        setpoint = profile.setpoint(settings.sampling_Hz)
        self.memory.setpoint_N[: len(setpoint)] = setpoint.data
        begin = BeginTrial(
            number,
            pidf.coefficients(settings, gains),
            len(setpoint),
            profile.loop == "open",
            cost_max,
            2.0 * profile.duration_s,
        )
        self.machine.begin(begin)

    def step(self, reading: Reading | None = None, silence_s: float = 0.0, *, late=False) -> None:
        """Runs one sample; `reading` replaces the true sensor values."""
        self.time_s += 1.0 / self.plan.sampling_Hz
        gauge, encoder = self.board.read(self.time_s)
        measured = (
            Reading(self.time_s, gauge, encoder + self.turned) if reading is None else reading
        )
        command = self.machine.sample(measured, silence_s, late=late)
        self.board.write(self.time_s, command)
        self.current_A.append(Electronics().current_A(command))
        self.tension_N.append(self.plan.gauge.force_N(measured.gauge_counts))
        if self.machine.powered is not self._powered:
            self._powered = self.machine.powered
            self.board.power(self.time_s, on=self._powered)

    def until(self, holds, within_s: float = 20.0) -> None:
        """Runs until a condition holds."""
        end = self.time_s + within_s
        while not holds():
            assert self.time_s < end, self.machine.phase
            self.step()

    def answer(self):
        """Runs until the requested trial has ended."""
        self.until(lambda: self.machine.answer is not None)
        answer, self.machine.answer = self.machine.answer, None
        return answer

    def estop(self, *, on: bool) -> None:
        self.memory.words[Word.ESTOP] = on
