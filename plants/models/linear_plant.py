"""Any linear model of python-control, with a dead time beside it, as a plant."""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from estune.core.gains import Gains
from estune.core.margins import SampledPlant, loop_margins, sample_plant
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput, PlantError
from estune.interop import linear_model
from estune.trial import LinearModel, RigDescription, RigLimits
from estune.trial.profiles import StepProfile
from plants.models.effect_applicability import unavailable
from plants.models.effect_mixin import EffectMixin
from plants.models.linear_with_effects import LinearEffectStructure
from plants.models.mounting import Mounted, Mounting, ServesAsRig
from plants.models.pole_zero_form import Rational, factorised
from plants.simulation.equations import Equations, Expression, column_of, pack
from plants.simulation.plant import (
    Columns,
    Drive,
    check_above_zero,
    check_not_negative,
    whole_and_fraction,
)
from plants.simulation.trial_loop import Batch, trial_loop

if TYPE_CHECKING:  # python-control takes more than a second to import
    from control import StateSpace, TransferFunction

UNLIMITED_N = 1e9
"""What stands for no limit; an infinite one could not be written down as JSON."""

SAMPLES_PER_SETTLING_TIME = 200
SETTLING_TIMES_AFTER_STEP = 5.0
LONGEST_TRIAL_samples = 1_000_000


@dataclass(frozen=True)
class LinearPlant(EffectMixin, Mounted, ServesAsRig):
    """A linear plant, sampled exactly; made by `linear_plant`. Its effects: see `plants.models.linear_with_effects`.

    Attributes:
        mounting: Controller, suggested step, limits and noise.
        sampled: The plant under zero-order hold.
        model: The continuous model, or None where it was given in discrete time.
        torque_unit: Input that stands for a newton metre of the effects.
        angle_unit: Output that stands for a radian of the effects.

    Raises:
        PlantError: an effect has no place on the plant.
    """

    mounting: Mounting
    sampled: SampledPlant
    model: LinearModel | None
    torque_unit: float = 1.0
    angle_unit: float = 1.0

    def __post_init__(self) -> None:
        for effect in self.effects:
            if self.model is None:
                raise PlantError("effects need a plant in continuous time; give it so")
            reason = unavailable(self._factorised[0], type(effect))
            if reason:
                raise PlantError(f"{effect.name} cannot be added to the linear plant: {reason}")

    @cached_property
    def _factorised(self) -> tuple[Rational, dict[str, float]]:
        """Kinds of the poles and zeros, and their numbers."""
        if self.model is None:
            raise PlantError("the plant is given in discrete time; give it in continuous time")
        return factorised(self.model)

    @property
    def own_numbers(self) -> dict[str, float]:
        """Gain, modes and time constants by name, as `plants.models.linear_with_effects` takes them.

        Raises:
            PlantError: the plant is given in discrete time, or cannot be told by its poles.
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
    def base(self) -> Rational:
        """Kinds of the poles and zeros.

        Raises:
            PlantError: the plant is given in discrete time, or cannot be told by its poles.
        """
        return self._factorised[0]

    @cached_property
    def _ported(self) -> LinearEffectStructure:
        """The structure of the plant with its effects."""
        rate = self.controller.sampling_Hz
        fastest = float(np.abs(self.sampled.modes).max(initial=0.0)) * rate
        squarings = LinearEffectStructure.squarings_for(max(2.0 * fastest, 1e-9), rate)
        return LinearEffectStructure(self.base, self.kinds, fractional=True, squarings=squarings)

    @property
    def structure(self) -> "LinearStructure | LinearEffectStructure":
        """What the equations depend on besides numbers."""
        if self.effects:
            return self._ported
        return LinearStructure(max(1, self.sampled.C.size), bool(self.sampled.before.any()))

    @cached_property
    def _rest(self) -> FloatArray | None:
        """State and effort at a measurement of one: 0 = (Phi - 1) x + Gamma u, 1 = C x + E u."""
        s, n = self.sampled, self.sampled.C.size
        gamma = s.now + s.before
        equations = np.block([[s.Phi - np.eye(n), gamma[:, None]], [s.C, np.array([s.E])]])
        wanted = np.append(np.zeros(n), 1.0)
        rest: FloatArray = np.linalg.lstsq(equations, wanted, rcond=None)[0]
        return rest if np.allclose(equations @ rest, wanted, atol=1e-6) else None

    @cached_property
    def parameter_values(self) -> FloatArray:
        """The numbers the equations take: matrices column by column, then the rest."""
        if self.effects:
            own = self.own_numbers
            return self.numbers(own[name] for name in self._ported.own_names)
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

    def respond(
        self,
        coefficients: FloatArray,
        drive: Drive,
        noise_N: FloatArray | None,
        bound_N: float,
    ) -> Columns:
        """Runs a batch of trials; see `Plant.respond`."""
        if drive.preload_N != 0.0 and self._rest is None:
            raise PlantError(
                f"the linear plant cannot be held at a preload of {drive.preload_N:g} N, for it "
                "has no gain at rest; choose a preload of 0"
            )
        batch = Batch(
            parameters=self.parameter_values,
            coefficients=coefficients,
            preload_N=drive.preload_N,
            setpoint_N=drive.setpoint_N,
            noise_N=noise_N,
            delay=self.delay_samples if self.effects else self.sampled.delay,
            bound_N=bound_N,
            open_loop=drive.open_loop,
        )
        return trial_loop(self.structure).run(batch)

    def describe(self, name: str, gains: Gains | None) -> RigDescription:
        """What a rig that runs this plant says of itself."""
        safe = gains or self.mounting.gains or self._safe_gains()
        return self.mounting.describe(name, safe, self.model)

    def _safe_gains(self) -> Gains | None:
        """A slow PI with a gain margin of 3 and a phase margin of 60 degrees, if one is found."""
        h = 1.0 / self.controller.sampling_Hz
        slow = 2.0 * math.pi / self.mounting.settling_time_s  # rad/s
        gain = float(np.abs(self.sampled.response(np.array([min(slow * h, 3.0)])))[0])
        if not (math.isfinite(gain) and gain > 0.0):
            return None
        # A plant that integrates by itself bears little integral action, at any P.
        for P, share in itertools.product(0.5 / gain / 2.0 ** np.arange(20), (0.5, 0.125, 0.03)):
            gains = Gains(float(P), float(P) * slow * share, 0.0, 0.0)
            found = loop_margins(self.sampled, gains, self.controller)
            if found.stable and found.gain_margin >= 3.0 and found.phase_margin_deg >= 60.0:
                return gains
        return None


class _Constants(NamedTuple):
    Phi: Expression
    before: Expression
    now: Expression
    C: Expression
    E: Expression


@dataclass(frozen=True, slots=True)
class LinearStructure:
    """One compilation serves all linear plants of an order.

    Attributes:
        order: Number of states, at least one.
        fractional: Whether the dead time is not a whole number of samples.
    """

    order: int
    fractional: bool

    def equations(self) -> Equations:
        """The difference equation of `estune.core.margins.SampledPlant`."""
        n = self.order
        shapes = [(n, n), (n, 1), (n, 1), (1, n), (1, 1), (n, 1), (1, 1)]
        ends = np.cumsum([rows * columns for rows, columns in shapes]).tolist()
        parameters, preload = ca.SX.sym("parameters", ends[-1]), ca.SX.sym("preload")
        *shared, rest, rest_effort = (
            ca.reshape(part, *shape)
            for part, shape in zip(ca.vertsplit(parameters, [0, *ends]), shapes, strict=True)
        )
        values, c = pack(_Constants(*shared))
        constants = column_of(c)
        x, noise, effort = ca.SX.sym("x", n), ca.SX.sym("noise"), ca.SX.sym("effort")
        before, after = ca.SX.sym("before"), ca.SX.sym("after")
        moved = c.Phi @ x + c.now * after
        if self.fractional:
            moved += c.before * before
        return Equations(
            prepare=ca.Function(
                "prepare", [parameters, preload], [values, rest * preload, rest_effort * preload]
            ),
            observe=ca.Function(
                "observe", [constants, x, before, noise], [x, c.C @ x + c.E * before + noise, 0.0]
            ),
            drive=ca.Function("drive", [constants, x, effort], [x, effort]),
            substep=ca.Function("substep", [constants, x, before, after, ca.SX.sym("n")], [moved]),
            substeps=1,
        )


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
) -> LinearPlant:
    """A plant from a python-control model, sampled exactly under zero-order hold.

    The measurement is taken just before the effort changes, so a direct feed-through shows the
    effort that is still in force. An unstable model is allowed.

    Args:
        system: From effort to measurement, one input and one output, proper; continuous, or
            discrete at the controller's rate and without direct feed-through.
        dead_time_s: Delay of the effort, any number of samples or fraction; whole samples for a
            discrete model.
        sampling_Hz: Rate of the controller; None is that of a discrete model, and 200 samples in
            a settling time for a continuous one.
        output_min_N: Least effort of the controller.
        output_max_N: Greatest effort.
        derivative_filter_s: Time constant of the controller's derivative filter, s.
        noise_rms_N: Measurement noise, rms.
        settling_time_s: Settling time a good tuning can reach; None is 2 pi over the slowest pole
            that is not zero, and the dead time.
        profile: The step suggested; None is a unit step from zero, followed for five settling
            times.
        limits: What a rig of it accepts; None is practically everything.
        gains: Safe live gains of a rig of it; None is a slow PI found from the margins.

    Raises:
        InvalidInput: the model is of another kind, or a value is out of its range.
        PlantError: a discrete model that does not fit the controller's rate.
    """
    check_not_negative("dead time", dead_time_s, "s")
    if sampling_Hz is not None:
        check_above_zero("sampling rate", sampling_Hz, "Hz")
    if getattr(system, "dt", None):  # 0 and None are continuous time
        sampling_Hz = _rate(system, sampling_Hz)
        model, sampled = None, _as_sampled(system, dead_time_s, sampling_Hz)
        settling_time_s = settling_time_s or _settling_time(
            sampled.modes * sampling_Hz, dead_time_s
        )
    else:
        model = linear_model(system, dead_time_s)
        A = np.reshape(np.array(model.A), (len(model.B), len(model.B)))
        settling_time_s = settling_time_s or _settling_time(np.linalg.eigvals(A), dead_time_s)
        check_above_zero("settling time", settling_time_s, "s")
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
    start = 0.5 * settling_time_s
    mounting = Mounting(
        controller=settings,
        profile=profile
        or StepProfile(0.0, 1.0, start, start + SETTLING_TIMES_AFTER_STEP * settling_time_s),
        settling_time_s=settling_time_s,
        limits=limits or RigLimits(-UNLIMITED_N, UNLIMITED_N, LONGEST_TRIAL_samples / sampling_Hz),
        noise_rms_N=noise_rms_N,
        gains=gains,
    )
    return LinearPlant(mounting, sampled, model)


def _settling_time(poles: Any, dead_time_s: float) -> float:
    """2 pi over the slowest pole that is not zero, and the dead time, s."""
    rates = np.abs(poles)
    slow = rates[rates > 1e-9 * rates.max(initial=0.0)]
    return float(2.0 * math.pi / slow.min() + dead_time_s) if slow.size else 1.0 + dead_time_s


def _rate(system: Any, sampling_Hz: float | None) -> float:
    """The rate of a discrete model, which must be the controller's."""
    if system.dt is True:  # python-control's word for an unspecified interval
        if sampling_Hz is None:
            raise InvalidInput("the discrete model does not say its rate; give sampling_Hz")
        return sampling_Hz
    rate = 1.0 / float(system.dt)
    if sampling_Hz is not None and not math.isclose(rate, sampling_Hz, rel_tol=1e-9):
        raise PlantError(
            f"the discrete model runs at {rate:g} Hz and the controller at {sampling_Hz:g} Hz; "
            "resample the model, or give it in continuous time"
        )
    return rate


def _as_sampled(system: Any, dead_time_s: float, sampling_Hz: float) -> SampledPlant:
    """A discrete model as it is."""
    from control import ss  # noqa: PLC0415  slow to import

    if (system.ninputs, system.noutputs) != (1, 1):
        raise InvalidInput(
            f"the plant has {system.ninputs} inputs and {system.noutputs} outputs; choose one of "
            "each, as in system[0, 0]"
        )
    delay, fraction = whole_and_fraction(dead_time_s, sampling_Hz)
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
