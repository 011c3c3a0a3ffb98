"""A linear model of python-control with a dead time, as a plant."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from estune.core.gains import Gains
from estune.core.margins import SampledPlant, loop_margins, sample_plant
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray, check_not_negative, check_positive
from estune.errors import InvalidInput, PlantError, UnsafeStart
from estune.interop import as_control, check_siso, linear_model
from estune.loop_model.cautious_gains import cautious_gains
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.description import UNLIMITED_N
from estune.trial.profiles import StepProfile
from plants.models.effect_applicability import unavailable
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.mounting import MountedModel, Mounting, unit_step, wide_limits
from plants.models.path_structure import squarings_for
from plants.models.pole_zero_form import PoleZeroForm, factorise
from plants.models.sampled_structure import SampledStructure
from plants.simulation.plant import TrialSetpoint, split_dead_time

if TYPE_CHECKING:  # python-control takes more than a second to import
    from control import StateSpace, TransferFunction

SAMPLES_PER_SETTLING_TIME = 200

DELAY = -100.0
"""Logarithm of a discrete pole below which it is a delay, whose pole is zero."""


@dataclass(frozen=True, repr=False)
class LinearPlant(MountedModel):
    """A linear plant, sampled exactly; made by `linear_plant`.

    Effects are added as in `plants.models.linear_with_effects`.

    Attributes:
        mounting: Controller, suggested step, limits and noise.
        sampled: The plant under zero-order hold.
        model: The continuous model, or None where it was given in discrete time.
        torque_unit: Input that is one newton metre of the effects.
        angle_unit: Output that is one radian of the effects.

    Raises:
        PlantError: an effect cannot be added to the plant.
    """

    mounting: Mounting
    sampled: SampledPlant
    model: LinearModel | None
    torque_unit: float = 1.0
    angle_unit: float = 1.0

    diagnosed_by = "plants.diagnosis.models.linear_plant:DiagnosedLinear"

    def __post_init__(self) -> None:
        for effect in self.effects:
            if self.model is None:
                raise PlantError(
                    "effects need a plant in continuous time; give the model in continuous time"
                )
            reason = unavailable(self._factorised[0], type(effect))
            if reason:
                raise PlantError(f"{effect.name} cannot be added to the linear plant: {reason}")

    @cached_property
    def _factorised(self) -> tuple[PoleZeroForm, dict[str, float]]:
        if self.model is None:
            raise PlantError("the plant is given in discrete time; give it in continuous time")
        return factorise(self.model)

    @property
    def own_numbers(self) -> dict[str, float]:
        """Gain, modes and time constants by name.

        Raises:
            PlantError: the model is discrete, or its poles and zeros do not reproduce it.
        """
        return self._factorised[1] | {
            "current_limit_A": UNLIMITED_N,
            "encoder_counts": 1.0,
            "sampling_Hz": self.controller.sampling_Hz,
            "dead_time_s": self.model.dead_time_s if self.model else 0.0,
            "torque_unit": self.torque_unit,
            "angle_unit": self.angle_unit,
        }

    @property
    def base(self) -> PoleZeroForm:
        """Kinds of the poles and zeros; raises as `own_numbers`."""
        return self._factorised[0]

    def summary(self) -> str:
        """Order, dead time and sampling rate."""
        rate = self.controller.sampling_Hz
        dead_time_s = self.model.dead_time_s if self.model else self.sampled.delay / rate
        return f"order {self.sampled.C.size}, dead time {dead_time_s:g} s, {rate:g} Hz"

    @cached_property
    def structure(self) -> SampledStructure | LinearEffectStructure:
        if not self.effects:
            return SampledStructure(max(1, self.sampled.C.size), bool(self.sampled.before.any()))
        rate = self.controller.sampling_Hz
        fastest = float(np.abs(self.sampled.modes).max(initial=0.0)) * rate
        squarings = squarings_for(max(2.0 * fastest, 1e-9), rate)
        return LinearEffectStructure(self.base, self.kinds, fractional=True, squarings=squarings)

    @property
    def delay_samples(self) -> int:
        return super().delay_samples if self.effects else self.sampled.delay

    @cached_property
    def _rest(self) -> FloatArray | None:
        """State and effort at rest at one: 0 = (Phi - 1) x + Gamma u, 1 = C x + E u."""
        s, n = self.sampled, self.sampled.C.size
        gamma = s.now + s.before
        equations = np.block([[s.Phi - np.eye(n), gamma[:, None]], [s.C, np.array([s.E])]])
        target = np.append(np.zeros(n), 1.0)
        rest: FloatArray = np.linalg.lstsq(equations, target, rcond=None)[0]
        return rest if np.allclose(equations @ rest, target, atol=1e-6) else None

    @cached_property
    def parameter_values(self) -> FloatArray:
        """Values of the equations' parameters: matrices column by column, then the rest."""
        if self.effects:
            return super().parameter_values
        s, padding = self.sampled, 1 if self.sampled.C.size == 0 else 0
        rest = np.zeros(s.C.size + 1) if self._rest is None else self._rest
        return np.concatenate(
            [
                np.pad(s.Phi, (0, padding)).ravel(order="F"),
                *(np.pad(vector, (0, padding)) for vector in (s.before, s.now, s.C)),
                [s.E],
                np.pad(rest[:-1], (0, padding)),
                rest[-1:],
            ]
        )

    def admissible(self, drive: TrialSetpoint) -> TrialSetpoint:
        """A trial at a preload that the plant can be held at."""
        if drive.preload_N != 0.0 and self._rest is None:
            raise PlantError(
                f"the linear plant cannot be held at a preload of {drive.preload_N:g} N, for it "
                "has no gain at rest; choose a preload of 0"
            )
        return drive

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        safe = gains or self.mounting.gains or self._safe_gains()
        if safe is None and self._lowers():
            raise UnsafeStart(
                f"more effort lowers the measurement of {name}, and no gains, which are above "
                "zero, hold that; turn the sign of the plant, and of the effort on the machine"
            )
        return self.mounting.describe(name, safe, self.model)

    def _lowers(self) -> bool:
        """Whether a stable plant ends lower with more effort."""
        stable = bool((np.abs(np.linalg.eigvals(self.sampled.Phi)) < 1.0).all())
        return stable and self._rest is not None and self._rest[-1] < 0.0

    def _safe_gains(self) -> Gains | None:
        """A slow PI with a gain margin of 3 and a phase margin of 60 degrees, or None."""
        h = 1.0 / self.controller.sampling_Hz
        slow = 2.0 * math.pi / self.mounting.settling_time_s  # rad/s
        gain = float(np.abs(self.sampled.response(np.array([min(slow * h, 3.0)])))[0])

        def safe(gains: Gains) -> bool:
            m = loop_margins(self.sampled, gains, self.controller)
            return m.stable and m.gain_margin >= 3.0 and m.phase_margin_deg >= 60.0

        return cautious_gains(gain, self.mounting.settling_time_s, safe)


def linear_plant(
    system: "TransferFunction | StateSpace",
    dead_time_s: float = 0.0,
    sampling_Hz: float | None = None,
    *,
    output_min_N: float = -UNLIMITED_N,
    output_max_N: float = UNLIMITED_N,
    derivative_filter_s: float = 0.0,
    noise_rms_N: float = 0.0,
    settling_time_s: float | None = None,
    profile: StepProfile | None = None,
    limits: RigLimits | None = None,
    gains: Gains | None = None,
    newtons_per_ampere: float = 1.0,
    measurement: str = "measurement",
    command: str = "control effort",
) -> LinearPlant:
    """A plant from a model of python-control or SciPy, sampled exactly under zero-order hold.

    The measurement is taken just before the effort changes, so a direct feed-through responds to
    the previous effort. An unstable model is allowed.

    Args:
        system: From effort to measurement, one input and one output, proper; continuous, or
            discrete at the controller's rate and without direct feed-through.
        dead_time_s: Delay of the effort, any number of samples or fraction; whole samples for a
            discrete model.
        sampling_Hz: Rate of the controller; None is that of a discrete model, and 200 samples in
            a settling time for a continuous one.
        output_min_N: Lower limit of the controller's effort.
        output_max_N: Upper limit.
        derivative_filter_s: Time constant of the controller's derivative filter, s.
        noise_rms_N: Measurement noise, rms.
        settling_time_s: Settling time a good tuning can reach; None is 2 pi over the slowest pole
            that is not zero, and the dead time; of integrators alone what dead time, rate and
            effort allow.
        profile: The suggested step; None is a unit step from zero, followed for five settling
            times.
        limits: Limits of its rig; None is practically none.
        gains: Safe live gains of its rig; None is a slow PI chosen by its margins.
        newtons_per_ampere: Effort per motor current, N/A: the records' current is effort over it.
        measurement: What is measured, with its unit: "speed, rad/s". Figures and tables use it.
        command: What the controller commands, likewise: "voltage, V".

    Raises:
        InvalidInput: the model is of another kind, or a value is out of its range.
        PlantError: a discrete model does not fit the controller's rate.
    """
    check_not_negative("dead time", dead_time_s, "s")
    if sampling_Hz is not None:
        check_positive("sampling rate", sampling_Hz, "Hz")
    system = as_control(system)
    most = max(abs(output_min_N), abs(output_max_N))
    if getattr(system, "dt", None):  # 0 and None are continuous time
        sampling_Hz = _rate(system, sampling_Hz)
        model, sampled = None, _as_sampled(system, dead_time_s, sampling_Hz)
        settling_time_s = settling_time_s or _discrete_settling_time(
            sampled, dead_time_s, sampling_Hz, most
        )
    else:
        model = linear_model(system, dead_time_s)
        A = np.reshape(np.array(model.A), (len(model.B), len(model.B)))
        moved = partial(_unit_time, A, np.array(model.B), np.array(model.C))
        settling_time_s = settling_time_s or settling_time(
            np.linalg.eigvals(A), dead_time_s, sampling_Hz, moved, most
        )
        check_positive("settling time", settling_time_s, "s")
        sampling_Hz = sampling_Hz or SAMPLES_PER_SETTLING_TIME / settling_time_s
        sampled = sample_plant(
            A,
            np.array(model.B),
            np.array(model.C),
            model.E,
            dead_time_s=dead_time_s,
            sample_s=1.0 / sampling_Hz,
        )
    settings = ControllerSettings(sampling_Hz, derivative_filter_s, output_min_N, output_max_N)
    mounting = Mounting(
        settings,
        profile or unit_step(0.0, settling_time_s),
        settling_time_s,
        limits or wide_limits(sampling_Hz),
        noise_rms_N,
        gains,
        newtons_per_ampere,
        measurement,
        command,
    )
    return LinearPlant(mounting, sampled, model)


def settling_time(
    poles: Any,
    dead_time_s: float,
    sampling_Hz: float | None,
    unit_time: Callable[[float], float],
    most: float = UNLIMITED_N,
) -> float:
    """2 pi over the slowest pole that is not zero, plus the dead time, s.

    A good tuning can reach it. Where all poles are zero, what limits the loop takes the place of
    the pole: the dead time and a sample, at twice which as time constant the gain margin is 3 and
    the phase margin 60 degrees; without dead time the rate, of 200 samples in a settling time as
    by default; without a rate an effort as large as the step. A step never takes less than the
    largest effort needs.

    Args:
        poles: In rad/s.
        dead_time_s: Dead time.
        sampling_Hz: Rate of the controller, where it is known.
        unit_time: The time in which an effort moves the measurement by one, s.
        most: The largest effort.
    """
    rates = np.abs(poles)
    slow = rates[rates > 1e-9 * rates.max(initial=0.0)]
    if slow.size:
        return float(2.0 * math.pi / slow.min() + dead_time_s)
    sample_s = 1.0 / sampling_Hz if sampling_Hz else 0.0
    if dead_time_s:
        reached_s = 4.0 * math.pi * (dead_time_s + sample_s)
    else:
        reached_s = SAMPLES_PER_SETTLING_TIME * sample_s or 2.0 * math.pi * unit_time(1.0)
    if most < UNLIMITED_N:
        reached_s = max(reached_s, 2.0 * math.pi * unit_time(most))
    return reached_s + dead_time_s


def _discrete_settling_time(
    sampled: SampledPlant, dead_time_s: float, rate: float, most: float
) -> float:
    """The settling time of a discrete model; a pole at zero is a sample of dead time.

    As the fastest pole beside integrators it would be their settling time, a thousandth of a
    sample.
    """
    late = sampled.modes.real < DELAY
    poles = sampled.modes[~late]
    if not poles.any():
        dead_time_s += float(late.sum()) / rate

    def unit_time(effort: float) -> float:
        theta, n = 1e-3, poles.size
        ramp = float(np.abs(sampled.response(np.array([theta])))[0]) * (theta * rate) ** n
        return float((math.factorial(n) / (effort * ramp)) ** (1.0 / n)) if n else 0.0

    return settling_time(poles * rate, dead_time_s, rate, unit_time, most)


def _unit_time(A: FloatArray, B: FloatArray, C: FloatArray, effort: float) -> float:
    """Time in which an effort moves integrators alone by one, s: their slowest term alone."""
    terms = [float(C @ np.linalg.matrix_power(A, n) @ B) for n in range(B.size)]
    moving = [n for n, term in enumerate(terms, 1) if abs(term) > 1e-12 * np.abs(terms).max()]
    if not moving:
        return 1.0  # no effort moves it: no gains are found safe for it, whatever its time
    n = moving[-1]
    return float((math.factorial(n) / (effort * abs(terms[n - 1]))) ** (1.0 / n))


def _rate(system: Any, sampling_Hz: float | None) -> float:
    """Sampling rate of a discrete model, which must be the controller's."""
    if system.dt is True:  # an unspecified interval in python-control
        if sampling_Hz is None:
            raise InvalidInput("the discrete model has no sampling rate; give sampling_Hz")
        return sampling_Hz
    rate = 1.0 / float(system.dt)
    if sampling_Hz is not None and not math.isclose(rate, sampling_Hz, rel_tol=1e-9):
        raise PlantError(
            f"the discrete model runs at {rate:g} Hz and the controller at {sampling_Hz:g} Hz; "
            "resample the model, or give it in continuous time"
        )
    return rate


def _as_sampled(system: Any, dead_time_s: float, sampling_Hz: float) -> SampledPlant:
    from control import ss  # noqa: PLC0415  slow to import

    check_siso(system)
    delay, fraction = split_dead_time(dead_time_s, sampling_Hz)
    if fraction:
        raise PlantError(
            f"a dead time of {dead_time_s:g} s is not a whole number of samples at "
            f"{sampling_Hz:g} Hz, which a discrete model cannot have; give it in continuous time"
        )
    states = ss(system)
    Phi, gamma, C = (np.asarray(part, dtype=np.float64) for part in (states.A, states.B, states.C))
    if not all(np.isfinite(part).all() for part in (Phi, gamma, C, states.D)):
        raise InvalidInput("the plant has a coefficient that is not finite")
    if np.any(states.D):
        raise PlantError(
            "the discrete model has a direct feed-through, which a sampled controller cannot "
            "close a loop around; delay it by one sample"
        )
    poles = np.linalg.eigvals(Phi).astype(np.complex128)
    modes = np.log(np.where(poles == 0.0, 1e-300, poles))
    return SampledPlant(
        Phi, gamma.ravel(), np.zeros(gamma.size), C.ravel(), 0.0, delay, np.asarray(modes)
    )
