"""Description of a rig: its limits and linear model."""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.core.setting import Setting, check_settings, documented
from estune.errors import InvalidInput
from estune.trial.gain_bounds import EXCESS_LIVE, EXCESS_TRIAL, GainBounds, bounds_by_effort
from estune.trial.profiles import AnyProfile, LoadStepProfile, StepProfile
from estune.trial.signals import EFFORT, TENSION, NamedSignals, Signals

GAIN_MAX = 1e12
"""Static gain from which on a plant counts as an integrator: what rounding leaves of one."""

UNLIMITED_N = 1e9
"""Value for "no limit" in files, where there is no infinity."""

_MOTION_LINES = {
    "speed": "speed_max_rad_s (of a stage speed_max_m_s)",
    "travel": "travel_max_rad (of a stage travel_max_m)",
}
MOTION_MARGIN = 0.25
"""Part of a predicted motion for what a drive's model leaves unexplained: inertias of owners are
up to a fifth off on the machines of `experiments.hidden_machines`."""


@dataclass(frozen=True, slots=True)
class LinearModel:
    """The plant at its operating point: `x' = A x + B v, y = C x + E v, v(t) = u(t - dead time)`.

    Attributes:
        A: State matrix as rows, shape (n, n), 1/s.
        B: Input vector, shape (n,).
        C: Output vector, shape (n,).
        E: Direct feed-through.
        dead_time_s: Delay of the input u, s.

    Raises:
        InvalidInput: a number is not finite.
    """

    A: tuple[tuple[float, ...], ...]
    B: tuple[float, ...]
    C: tuple[float, ...]
    E: float = 0.0
    dead_time_s: float = 0.0

    def __post_init__(self) -> None:
        numbers = (*(a for row in self.A for a in row), *self.B, *self.C, self.E, self.dead_time_s)
        if not all(map(math.isfinite, numbers)):
            raise InvalidInput("the linear model holds a number that is not finite")

    @property
    def static_gain(self) -> float:
        """Size of the output per input at rest, to nine digits; infinite for an integrator."""
        try:
            rest = np.linalg.solve(np.array(self.A), np.array(self.B)) if self.A else np.zeros(0)
        except np.linalg.LinAlgError:
            return math.inf
        gain = abs(self.E - float(np.array(self.C) @ rest))
        return float(f"{gain:.9g}") if gain < GAIN_MAX else math.inf

    def response(self, command: FloatArray, sampling_Hz: float) -> FloatArray:
        """Output to a command that is held between samples, from rest, without the delay."""
        from scipy.signal import lsim  # noqa: PLC0415  slow to import

        n = len(self.B)
        system = np.reshape(self.A, (n, n)), np.reshape(self.B, (n, 1)), [self.C], [[self.E]]
        time = np.arange(command.size) / sampling_Hz
        output = lsim(system, command, time, interp=False)[1]
        return np.asarray(output, dtype=np.float64)

    def gain_at(self, frequency_rad_s: float) -> float:
        """Size of the frequency response, to nine digits."""
        A, B, C = (np.array(matrix) for matrix in (self.A, self.B, self.C))
        states = np.linalg.solve(1j * frequency_rad_s * np.eye(len(A)) - A, B)
        return float(f"{abs(self.E + C @ states):.9g}")


def omitted_if(default: object) -> Any:
    """Leaves a value out of messages where it is the default: older clients know no such key."""
    return Field(exclude_if=lambda value: value == default)


@documented
@dataclass(frozen=True, slots=True)
class RigLimits:
    """Limits of a rig for requests.

    Raises:
        InvalidInput: the limits are in the wrong order, or NaN.
    """

    tension_min_N: Annotated[
        float, Setting("Lowest setpoint, of an open loop too", "N", infinite=True)
    ]
    tension_max_N: Annotated[
        float, Setting("Highest setpoint, of an open loop too", "N", infinite=True)
    ]
    duration_max_s: Annotated[float, Setting("Longest trial", "s", infinite=True, above=0.0)]
    load_max_N: Annotated[
        float,
        omitted_if(0.0),
        Setting(
            "Largest load step added to the effort; zero where it adds none",
            "N",
            least=0.0,
        ),
    ] = 0.0
    speed_max_rad_s: Annotated[
        float,
        omitted_if(math.inf),
        Setting("Greatest open-loop speed", "rad/s", infinite=True, above=0.0),
    ] = math.inf
    travel_max_rad: Annotated[
        float,
        omitted_if(math.inf),
        Setting("Longest open-loop way", "rad", infinite=True, above=0.0),
    ] = math.inf

    def __post_init__(self) -> None:
        check_settings(self)
        # Infinite limits satisfy both conditions, NaN neither.
        if not self.tension_min_N <= self.tension_max_N:
            raise InvalidInput(
                f"limits {self.tension_min_N:g} to {self.tension_max_N:g} and "
                f"{self.duration_max_s:g} s: give them in order, and a duration above zero"
            )

    def check_setpoint(self, setpoint: float) -> None:
        """Refuses a setpoint outside the limits.

        Raises:
            InvalidInput: it is.
        """
        if not self.tension_min_N <= setpoint <= self.tension_max_N:
            raise InvalidInput(
                f"setpoint {setpoint:g} is outside the rig's range {self.tension_min_N:g} to "
                f"{self.tension_max_N:g}; choose another preload or a smaller change"
            )

    def check_each(self, *profiles: AnyProfile) -> None:
        """Refuses profiles outside the limits; what is told of the duration suits them all.

        Raises:
            InvalidInput: a setpoint or the duration is outside the limits.
        """
        for profile in sorted(profiles, key=lambda one: one.duration_s, reverse=True):
            self.check(profile)

    def check(self, profile: AnyProfile) -> None:
        """Refuses a profile outside the limits.

        Raises:
            InvalidInput: a setpoint or the duration is outside the limits.
        """
        for setpoint in profile.extremes:
            self.check_setpoint(setpoint)
        load = abs(profile.load_N) if isinstance(profile, LoadStepProfile) else 0.0
        if load > self.load_max_N:
            can = f"at most {self.load_max_N:g}" if self.load_max_N else "none at all"
            raise InvalidInput(
                f"the trial has a load step of {load:g}, and the rig can make {can}; choose "
                "another load, or a cost without load rejection"
            )
        if profile.duration_s > self.duration_max_s:
            raise InvalidInput(
                f"a trial of {profile.duration_s:g} s is longer than the rig's limit of "
                f"{self.duration_max_s:g} s; choose a shorter one, or raise duration_max_s in the "
                f"limits of the rig's file to {math.ceil(profile.duration_s)}"
            )


@dataclass(frozen=True, slots=True)
class RigDescription(NamedSignals):
    """Description of a rig.

    Attributes:
        name: Its name, unique on the link.
        gains: Its live gains.
        controller: The fixed part of its controller.
        newtons_per_ampere: Tension at rest per motor current, N/A; converts current to effort.
        limits: Limits for requests.
        step: Suggested step trial.
        settling_time_s: Suggested settling time, s; t_s in (35).
        cable_length_m: Deployed cable length, m, or None.
        linear_model: The plant linearised about the suggested step, or None.
        software: Name and version of the rig's program.
        simulated: Whether nothing physical moves: an interrupted trial may then be repeated.
        measurement: What is measured, and its unit, "speed, rad/s"; fields in N have this unit.
        command: What the controller commands, as `measurement`: "voltage, V".
        compensation: Its own compensations, as in a request.
        live_bounds: Bounds of live gains; open ones end where one suggested step takes the effort
            100 times over its limit.
        trial_bounds: The same of a trial's gains; 10000 times.

    Raises:
        InvalidInput: a number is not finite, or not above zero.
    """

    name: str
    gains: Gains
    controller: ControllerSettings
    newtons_per_ampere: float
    limits: RigLimits
    step: StepProfile
    settling_time_s: float
    cable_length_m: float | None = None
    linear_model: LinearModel | None = None
    software: str = ""
    simulated: bool = False
    measurement: Annotated[str, omitted_if(TENSION)] = TENSION
    command: Annotated[str, omitted_if(EFFORT)] = EFFORT
    compensation: Annotated[str, omitted_if("")] = ""
    live_bounds: Annotated[GainBounds | None, omitted_if(None)] = None
    trial_bounds: Annotated[GainBounds | None, omitted_if(None)] = None

    def bounds_of(self, *, trial: bool) -> GainBounds:
        """Bounds of a trial's gains, or of live ones: those stated, else those by the effort."""
        stated = self.trial_bounds if trial else self.live_bounds
        default = bounds_by_effort(
            self.controller,
            self.step.step_N,
            self.settling_time_s,
            self.limits.duration_max_s,
            EXCESS_TRIAL if trial else EXCESS_LIVE,
        )
        return default if stated is None else stated.and_default(default)

    def check_limited(self) -> None:
        """Refuses a rig that has no limit: an experiment would ask for any.

        A servo or a stage needs limits of its speed and travel, too.

        Raises:
            InvalidInput: a limit is missing; the message names the lines to add.
        """
        sides = {
            self.command_name: (self.controller.output_min_N, self.controller.output_max_N),
            "setpoint": (self.limits.tension_min_N, self.limits.tension_max_N),
        }
        missing = [
            name for name, ends in sides.items() if not all(abs(end) < UNLIMITED_N for end in ends)
        ]
        motion = {"speed": self.limits.speed_max_rad_s, "travel": self.limits.travel_max_rad}
        missing += [name for name, most in motion.items() if UNLIMITED_N <= most < math.inf]
        if not missing:
            return
        lines = "output_min_N, output_max_N and limits to the table of the plant"
        if self.step.loop == "open":
            drive = ("current_limit_A, the greatest current or effort", *_MOTION_LINES.values())
            lines = f"{' and '.join(drive)} to the table of the drive"
        raise InvalidInput(
            f"rig {self.name} has no limit of its {' and its '.join(missing)}, and nothing is run "
            f"on it: add {lines} in its model file, or to a rig's file the limits of its loop, as "
            "in `current_limit_A = 2.0`, `output_max_N = 50.0` or `limits = { tension_min_N = "
            "0.0, tension_max_N = 40.0, duration_max_s = 60.0 }`"
        )

    def check_motion(self, profile: AnyProfile) -> None:
        """Refuses a trial in an open loop that moves a drive too fast or too far, by its model.

        Raises:
            InvalidInput: the motion predicted, and `MOTION_MARGIN` of it beside, is over a limit.
        """
        model, limits = self.linear_model, self.limits
        most = {"speed": limits.speed_max_rad_s, "travel": limits.travel_max_rad}
        if model is None or profile.loop != "open" or min(most.values()) == math.inf:
            return
        rate_Hz = self.controller.sampling_Hz
        angle = model.response(profile.setpoint(rate_Hz), rate_Hz)
        speed = np.diff(angle) * rate_Hz
        moved = {"speed": np.abs(speed).max(initial=0.0), "travel": np.abs(angle - angle[0]).max()}
        for name, reached in moved.items():
            if (1.0 + MOTION_MARGIN) * reached > most[name]:
                raise InvalidInput(
                    f"the trial would reach a {name} of {reached:.3g} by the model, and with a "
                    f"margin of {MOTION_MARGIN:.0%} more than the limit of {most[name]:.3g}; ask "
                    f"for less, or raise {_MOTION_LINES[name]} in the table of the drive"
                )

    def check_gains(self, gains: Gains, *, trial: bool = False) -> None:
        """Refuses gains outside the rig's bounds of a trial's gains, or of live ones.

        Raises:
            InvalidInput: one of them is outside.
        """
        self.bounds_of(trial=trial).check(gains, "a trial's" if trial else "live")

    @property
    def effort_scale(self) -> float | None:
        """N of measurement per N of effort, by which costs weigh the effort; None if unknown.

        At rest, or, of a plant that needs no effort at rest, at the frequency 1/settling_time_s.
        """
        model = self.linear_model
        if model is None:
            return None
        gain = model.static_gain
        if not 0.0 < gain < math.inf:
            gain = model.gain_at(2.0 * math.pi / self.settling_time_s)
        return gain if 0.0 < gain < math.inf else None

    @property
    def signals(self) -> Signals:
        """Its measured and commanded signals."""
        return Signals(self.measurement, self.command)

    def __post_init__(self) -> None:
        for name in ("newtons_per_ampere", "settling_time_s", "cable_length_m"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InvalidInput(f"rig {self.name}: {name} is {value}; it must be above zero")
