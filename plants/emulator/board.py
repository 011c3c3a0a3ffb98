"""The emulated hardware: a reel behind converters, an encoder, an amplifier and a watchdog.

It moves in wall-clock time: each request advances it to the present, in steps an eighth of a
sampling period long, with the equations of `plants.models.reel_equations`.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from estune.core.quantities import FloatArray, check_not_negative, check_positive
from estune.errors import InvalidInput
from plants.effects.effect import Port
from plants.effects.parameter import Role
from plants.emulator.wire import TrueState
from plants.models.reel import Reel
from plants.models.reel_signal_path import THETA
from plants.simulation.buffers import Buffers
from plants.simulation.equations import Equations
from plants.simulation.trial_loop import loop_functions

STEPS_PER_SAMPLE = 8
_NOISE_AT_ONCE = 4096
NEARLY_SLACK_N = 1.0
"""A slack cable has no state at rest. At 1 N the reference reel's drum stands 0.013 rad from its
zero, so that waves of up to 75 periods a turn follow it back there within a radian."""


@dataclass(frozen=True, slots=True)
class Electronics:
    """Electronics between the reel and the computer.

    Attributes:
        counts_of_force: Polynomial of the gauge's converter: counts at 0 N, per N, per N^2.
        gauge_bits: Width of the gauge's converter.
        amperes_of_command: Polynomial of the current controller: A at 0 counts, per count, ...
        current_bits: Width of the current's converter; commands are signed.
        watchdog_s: Time without a command after which the amplifier is cut off, s.

    Raises:
        InvalidInput: a value is out of its range.
    """

    counts_of_force: tuple[float, ...] = (1_000_000.0, 150_000.0, 60.0)
    gauge_bits: int = 24
    amperes_of_command: tuple[float, ...] = (0.0, 2.0e-4)
    current_bits: int = 16
    watchdog_s: float = 0.02

    def __post_init__(self) -> None:
        check_positive("watchdog", self.watchdog_s, "s")
        for name in ("counts_of_force", "amperes_of_command"):
            numbers = getattr(self, name)
            if len(numbers) < 2 or not np.isfinite(numbers).all():
                raise InvalidInput(f"{name} is {numbers}; give an offset, a slope, and so on")
        for name in ("gauge_bits", "current_bits"):
            if not 1 <= getattr(self, name) <= 32:
                raise InvalidInput(f"{name} is {getattr(self, name)}; it must be from 1 to 32")

    def gauge_counts(self, force_N: float) -> int:
        """Counts of the converter, within its width."""
        counts = round(_polynomial(self.counts_of_force, force_N))
        return int(min(max(counts, 0), 2**self.gauge_bits - 1))

    def current_A(self, command: int) -> float:
        """Current of the amplifier for a command."""
        end = 2 ** (self.current_bits - 1)
        return _polynomial(self.amperes_of_command, min(max(command, -end), end - 1))


@dataclass(frozen=True, slots=True)
class FarEnd:
    """Motion of the cable's far end: `amplitude sin(2 pi frequency (t - begin))`, away from it.

    Attributes:
        begin_s: Time from the emulator's start at which it begins to move, s.

    Raises:
        InvalidInput: a value is below zero.
    """

    amplitude_m: float = 0.0
    frequency_Hz: float = 0.0
    begin_s: float = 0.0

    def __post_init__(self) -> None:
        check_not_negative("far end's amplitude", self.amplitude_m, "m")
        check_not_negative("far end's frequency", self.frequency_Hz, "Hz")
        check_not_negative("far end's begin", self.begin_s, "s")

    def position_m(self, time_s: float) -> float:
        """Position at a time, m."""
        moved_s = max(0.0, time_s - self.begin_s)
        return self.amplitude_m * math.sin(2.0 * math.pi * self.frequency_Hz * moved_s)

    def velocity_m_s(self, time_s: float) -> float:
        """Velocity at a time, m/s."""
        if time_s < self.begin_s:
            return 0.0
        pace = 2.0 * math.pi * self.frequency_Hz
        return self.amplitude_m * pace * math.cos(pace * (time_s - self.begin_s))

    def check(self, reel: Reel) -> None:
        """Checks that the reel's effects allow a far end that moves.

        Raises:
            InvalidInput: an effect depends on the drum's angle or on the cable, which are those of
                a fixed end.
        """
        for effect in reel.effects if self.amplitude_m else ():
            if not (effect.resists and effect.ports() == (Port.DRUM,)):
                raise InvalidInput(
                    f"the emulated far end cannot move with {effect.name}: only friction at the "
                    "drum is independent of where the end is"
                )


class EmulatedBoard:
    """A reel and its electronics; begins slack, without power."""

    def __init__(
        self,
        reel: Reel,
        electronics: Electronics,
        seed: int,
        now_s: float,
        far_end: FarEnd | None = None,
    ) -> None:
        """See `plants.emulator.EmulatedDriver`.

        Raises:
            InvalidInput: the reel's dead time is no whole number of steps, or its far end cannot
                move.
        """
        self._far_end = far_end or FarEnd()
        self._far_end.check(reel)
        self._start_s = now_s
        rate = STEPS_PER_SAMPLE * reel.sampling_Hz
        self._reel = reel = replace(reel, sampling_Hz=rate)
        if reel.structure.fractional:
            raise InvalidInput(
                f"the emulated dead time must be a multiple of {1.0 / rate:.6g} s; it is "
                f"{reel.dead_time_s:g} s"
            )
        self._electronics = electronics
        self._period_s = 1.0 / rate
        self._motion = _Motion(reel)
        self._random = np.random.default_rng(seed)
        self._noise: list[float] = []
        self._time_s = now_s
        self._powered = False
        self._tripped = self._written = self._command = 0
        self._written_s = now_s

    def advance(self, now_s: float) -> None:
        """Advances the reel to the present by whole steps."""
        while self._time_s + self._period_s <= now_s:
            self._time_s += self._period_s
            if self._powered and self._time_s - self._written_s > self._electronics.watchdog_s:
                self._powered = False
                self._tripped += 1
            self._motion.step(self._current_A())
            self._motion.move_end(self._far_end.position_m(self._time_s - self._start_s))

    def read(self, now_s: float) -> tuple[int, int]:
        """Counts of the gauge and of the encoder."""
        self.advance(now_s)
        if not self._noise:
            self._noise = self._random.normal(
                0.0, self._reel.gauge_noise_N, _NOISE_AT_ONCE
            ).tolist()
        tension, angle = self._motion.observe(self._noise.pop())
        counts = round(angle * self._reel.encoder_counts / (2.0 * np.pi))
        return self._electronics.gauge_counts(tension), counts

    def write(self, now_s: float, command: int) -> None:
        """Commands a current."""
        self.advance(now_s)
        self._command, self._written_s = command, now_s
        self._written += 1

    def power(self, now_s: float, *, on: bool) -> None:
        """Switches the amplifier's power, and restarts the watchdog."""
        self.advance(now_s)
        self._powered, self._written_s = on, now_s

    def truth(self, now_s: float) -> TrueState:
        """True state."""
        self.advance(now_s)
        tension, _ = self._motion.observe(0.0)
        return TrueState(
            now_s,
            tension,
            self._current_A(),
            self._motion.angle_rad,
            self._powered,
            self._tripped,
            self._written,
        )

    @property
    def far_end_m_s(self) -> float:
        """Velocity of the far end at the present, m/s."""
        return self._far_end.velocity_m_s(self._time_s - self._start_s)

    def _current_A(self) -> float:
        return self._electronics.current_A(self._command) if self._powered else 0.0


class _Motion(Buffers):
    """The reel's equations, one step at a time, through CasADi's buffers."""

    def __init__(self, reel: Reel) -> None:
        # The board rounds the angle of the drum; the equations' own is that to a fixed end.
        equations = replace(reel.structure, rounded=False).equations()
        constants, _, _ = equations.prepare(reel.parameter_values, reel.tension_N)
        states = equations.drive.numel_out(0)
        rooms = {"constants": constants.numel(), "x": states, "driven": states, "observed": states}
        rooms |= dict.fromkeys(("effort", "drive", "before", "after", "noise", "y", "angle"), 1)
        super().__init__(rooms)
        self.memory["constants"][:] = np.asarray(constants).ravel().data
        self.memory["x"][:] = _slack(equations, reel).data
        self._effort_per_A = reel.newtons_per_ampere
        self._ring = [0.0] * reel.delay_samples
        self._drum_radius_m = reel.drum_radius_m
        self._end_rad = 0.0
        move = loop_functions(equations).move
        self._drive = self.bind(equations.drive, "constants x effort", "driven drive")
        self._move = self.bind(move, "constants driven before after", "x")
        self._observe = self.bind(equations.observe, "constants x after noise", "observed y angle")

    @property
    def angle_rad(self) -> float:
        """The drum's angle."""
        angle: float = self.memory["x"][THETA] - self._end_rad
        return angle

    def step(self, current_A: float) -> None:
        """Advances by one step with this current."""
        m = self.memory
        m["effort"][0] = current_A * self._effort_per_A
        self._drive()
        self._ring.append(m["drive"][0])
        m["before"][0] = m["after"][0]
        m["after"][0] = self._ring.pop(0)
        self._move()

    def move_end(self, position_m: float) -> None:
        """Moves the far end: it stretches the cable as a turn of the drum would."""
        end_rad = position_m / self._drum_radius_m
        self.memory["x"][THETA] += end_rad - self._end_rad
        self._end_rad = end_rad

    def observe(self, noise_N: float) -> tuple[float, float]:
        """Tension at the gauge in N, and angle in rad."""
        self.memory["noise"][0] = noise_N
        self._observe()
        return self.memory["y"][0], self.memory["angle"][0] - self._end_rad


def _slack(equations: Equations, reel: Reel) -> FloatArray:
    """State of a reel without tension: zero, but for waves, which begin at their phase."""
    state = np.zeros(equations.drive.numel_out(0))
    parameters = (p for effect in reel.effects for p in effect.parameters().values())
    if any(p.role is Role.PHASE for p in parameters):
        _, rest, _ = equations.prepare(reel.parameter_values, NEARLY_SLACK_N)
        own = replace(reel.structure, rounded=False, effects=()).equations().drive.numel_out(0)
        state[own:] = np.asarray(rest).ravel()[own:]
    return state


def _polynomial(coefficients: tuple[float, ...], x: float) -> float:
    value = 0.0
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value
