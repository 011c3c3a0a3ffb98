"""The real-time loop and the emulated reel in virtual time, for experiments and tests.

The state machine, the controller and the compensations are those of the loop on hardware; process,
clock and driver are left out. Time passes only while a request is under way.
"""

import os
from typing import TypeVar

from estune.errors import RigError
from estune.hardware.compensation.runtime import make_compensation
from estune.hardware.config import RigConfig
from estune.hardware.controller import make_controller
from estune.hardware.driver import Reading
from estune.hardware.hybrid_control import make_hybrid
from estune.hardware.loop_messages import (
    BeginTrial,
    Done,
    LoopPlan,
    Refused,
    ResetEstop,
    SetCompensation,
    SetLiveGains,
)
from estune.hardware.reel_machine.machine import ReelStateMachine
from estune.hardware.rig import HardwareRig
from estune.hardware.shared_memory import Memory, MotionPhase, make_file
from plants.emulator.settings import make_board

_Answer = TypeVar("_Answer")

LOOKED_AT_s = 1.0
"""Time that passes before somebody clears a stop: the ramp ends, and the cable goes slack."""


class VirtualLoop:
    """In place of `estune.hardware.process.LoopProcess`.

    Attributes:
        memory: Memory shared with the rig.
        notes: Nothing is requested of the system.
        board: The emulated hardware.
        late: Number of samples from now on that come late.
    """

    notes: tuple[str, ...] = ()

    def __init__(self, name: str, plan: LoopPlan) -> None:
        """Makes the loop and the hardware of the driver's settings.

        Raises:
            InvalidInput: a setting of the emulated hardware is unknown or out of its range.
        """
        self._name, self._plan = name, plan
        file = make_file(plan.capacity)
        try:
            self.memory = Memory(file, plan.capacity)
        finally:
            os.close(file)
        controller, _ = make_controller(plan.controller)
        compensation = make_compensation(plan.compensation, plan.compensation_source)
        hybrid = make_hybrid(plan.hybrid, controller, plan.controller)
        self.machine = ReelStateMachine(plan, self.memory, controller, compensation, hybrid)
        self.board = make_board(plan.driver_settings, 0.0)
        self.late = self._samples = 0
        self._powered = False

    def check(self) -> None:
        """Nothing can have ended."""

    def wait(self) -> None:
        """Nothing to wait for."""

    def request(self, command: object, kind: type[_Answer], within_s: float) -> _Answer:
        """Executes a command; a trial runs to its end.

        Raises:
            RigError: the trial is refused.
        """
        del within_s
        answer: object = Done()
        match command:
            case BeginTrial():
                self.machine.begin(command)
                while self.machine.answer is None:
                    self.sample()
                answer, self.machine.answer = self.machine.answer, None
            case SetLiveGains(live):
                self.machine.set_live_gains(live)
            case SetCompensation():
                self.machine.set_compensation(command)
            case ResetEstop():
                if self.machine.phase in (MotionPhase.RAMP, MotionPhase.STOPPED):
                    for _ in range(round(LOOKED_AT_s * self._plan.sampling_Hz)):
                        self.sample()
                self.machine.reset()
        if isinstance(answer, Refused):
            raise RigError(f"rig {self._name} takes no trial: {answer.reason}")
        assert isinstance(answer, kind)  # noqa: S101  each command has one kind of answer
        return answer

    def end(self, within_s: float) -> None:
        """Leaves the reel where it is."""

    def sample(self) -> None:
        """One sample."""
        self._samples += 1
        now = self._samples / self._plan.sampling_Hz  # from zero: two runs are equal to the bit
        reading = Reading(now, *self.board.read(now))
        self.board.write(now, self.machine.sample(reading, 0.0, late=self.late > 0))
        self.late = max(0, self.late - 1)
        if self.machine.powered is not self._powered:
            self._powered = self.machine.powered
            self.board.power(now, on=self._powered)


def virtual_rig(config: RigConfig) -> HardwareRig:
    """The rig of an emulated reel in virtual time; its driver is that of the emulator.

    Raises:
        InvalidInput: a calibration or a setting cannot be used.
    """
    return HardwareRig(config, VirtualLoop)
