"""The base model's equations as balances of measured signals, one per block of the plant.

Each is linear in the base-model parameters (input gain, inertia, friction, stiffness, offsets),
which are fitted by least squares. The force block is

    r_F = K_t u + u_0 - J a - b v - R T,

with every signal smoothed alike (`plants.diagnosis.data.smoothing`) and T the tension that the
gauge filtered; the gauge block is r_K = y - y_0 - G(s) k R theta, the gauge's own dynamics G on
the smoothed angle.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial import LinearModel
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother, least_width
from plants.diagnosis.models.base import BaseNumbers

Signals = Mapping[str, FloatArray]
"""Signals of one record, or simulated noise of them, shape (samples,) each: `effort_N` (command
times newtons per ampere) and, where measured, `angle_rad`, `tension_N` (the output of a plant that
is no reel), `reference_N`, `current_A`."""


class Record(NamedTuple):
    """One measurement with the model's numbers, its signals, and simulated noise of each.

    `run` has the signals as the model with its effects gives them; None for one without.
    """

    measurement: MeasuredRecord
    numbers: BaseNumbers
    signals: Signals
    noise: Signals
    run: Signals | None = None


class Terms(NamedTuple):
    """A balance before its fit: `known = columns @ parameters + residual`.

    Attributes:
        known: Shape (samples,), in the block's unit; nan where undefined.
        columns: Shape (samples, parameters).
    """

    known: FloatArray
    columns: FloatArray


Balance = Callable[[BaseNumbers, Signals, Smoother], Terms]


@dataclass(frozen=True, slots=True)
class Equation:
    """One balance.

    Attributes:
        unit: Unit of the residual.
        own_offset: Whether each record has an offset of its own, such as an encoder's zero.
        smooth: Whether it has derivatives, which need smoothing.
    """

    name: str
    title: str
    unit: str
    balance: Balance
    own_offset: bool
    smooth: bool


def _force(b: BaseNumbers, s: Signals, smoother: Smoother) -> Terms:
    """K_t u + u_0 = J a + b v + R T; with one sensor by the cable's law, T = k R theta."""
    encoder, gauge = "angle_rad" in s, "tension_N" in s and b.stiffness_N_m is not None
    angle = s["angle_rad"] if encoder else s["tension_N"] / b.tension_per_angle_N_rad
    effort = b.drum_radius_m * smoother.held(s["effort_N"], b.dead_time_s, 1.0)
    inertia = b.drum_inertia_kg_m2 * smoother.sampled(angle, 0.0, 0.0, 1.0)
    # A torque like the others, of which the noise is added up: of no friction a small share of
    # what inertia takes over the kernel.
    least = CONSTANTS.small * b.drum_inertia_kg_m2 / smoother.width_s
    friction = smoother.sampled(angle, 0.0, max(b.viscous_friction_Nms, least))
    if gauge and encoder:  # the gauge's own dynamics undone
        w = 2.0 * math.pi * b.gauge_Hz if b.gauge_Hz else math.inf
        pull = smoother.sampled(s["tension_N"], 1.0, 2.0 * b.gauge_damping / w, 1.0 / w**2)
        return Terms(-b.drum_radius_m * pull, np.column_stack([-effort, inertia, friction]))
    columns = [inertia, friction]
    if b.stiffness_N_m is not None:
        torque = b.tension_per_angle_N_rad * b.drum_radius_m
        columns.append(torque * smoother.sampled(angle, 1.0))
    return Terms(effort, np.column_stack(columns))


def _gauge(b: BaseNumbers, s: Signals, smoother: Smoother) -> Terms:
    """Gauge: y = G(s) k R theta + y_0."""
    smooth = smoother.sampled(s["angle_rad"], 1.0)
    inside = np.isfinite(smooth)
    followed = np.full(smooth.size, np.nan)
    pulled = b.tension_per_angle_N_rad * smooth[inside]
    followed[inside] = _through_gauge(b, pulled)
    return Terms(s["tension_N"], followed[:, None])


def _eyelet(_b: BaseNumbers, s: Signals, _smoother: Smoother) -> Terms:
    """Eyelet: y = c T_outside + y_0."""
    return Terms(s["tension_N"], s["reference_N"][:, None])


def _actuator(b: BaseNumbers, s: Signals, _smoother: Smoother) -> Terms:
    """Actuator: i = c i_command + d i_command later + i_0, up to the model's dead time late."""
    command = s["effort_N"] / b.newtons_per_ampere
    late = math.ceil(b.dead_time_s * b.sampling_Hz - 1e-6)
    columns = [
        np.concatenate([np.full(n, command[0]), command])[: command.size] for n in (0, late)
    ]
    return Terms(s["current_A"], np.column_stack(columns[: 1 + (late > 0)]))


def _plant(b: BaseNumbers, s: Signals, smoother: Smoother) -> Terms:
    """b(d/dt) u = a(d/dt) y, both divided by the first coefficient of b: an effort."""
    numerator, denominator = transfer(_linear(b))
    known = smoother.held(s["effort_N"], b.dead_time_s, *numerator)
    output = s["tension_N"] if "tension_N" in s else s["angle_rad"]
    orders = np.eye(denominator.size) * np.where(denominator == 0.0, 1.0, denominator)
    return Terms(known, np.column_stack([smoother.sampled(output, *row) for row in orders]))


def _plant_of_smooth_input(b: BaseNumbers, s: Signals, smoother: Smoother) -> Terms:
    """The same of an input that was sampled, not held: half a sample earlier."""
    terms = _plant(b, s, smoother)
    known = smoother.sampled(s["effort_N"], *transfer(_linear(b))[0])
    late = b.dead_time_s * b.sampling_Hz
    index = np.arange(known.size)
    return terms._replace(known=np.interp(index - late, index, known) if late > 0.0 else known)


def _linear(b: BaseNumbers) -> LinearModel:
    if b.linear is None:
        raise InvalidInput("the balance of a linear plant needs its model; give `linear`")
    return b.linear


FORCE = Equation("force", "balance of forces", "N m", _force, own_offset=False, smooth=True)
GAUGE = Equation("gauge", "cable and gauge", "N", _gauge, own_offset=True, smooth=False)
EYELET = replace(GAUGE, name="eyelet", title="eyelet", balance=_eyelet)
ACTUATOR = Equation("actuator", "actuator", "A", _actuator, own_offset=False, smooth=False)
PLANT = Equation("plant", "balance of the plant", "N", _plant, own_offset=True, smooth=True)
PLANT_OF_SMOOTH_INPUT = replace(PLANT, balance=_plant_of_smooth_input)


def equations(b: BaseNumbers, channels: frozenset[str]) -> tuple[Equation, ...]:
    """The balances that the base model and the channels of all records allow.

    Of two with one name, the one with the smaller residual applies.
    """
    balances: list[Equation] = [ACTUATOR] if "current_A" in channels else []
    gauge, encoder = "tension_N" in channels, "angle_rad" in channels
    if b.linear is not None:
        return (*balances, PLANT, PLANT_OF_SMOOTH_INPUT)
    cable = b.stiffness_N_m is not None
    if encoder or (cable and gauge):
        # Without a gauge the angle at which the cable is taut is each record's own.
        balances.append(replace(FORCE, own_offset=not gauge or not cable))
    if cable and gauge and encoder:
        balances.append(GAUGE)
    if gauge and "reference_N" in channels:
        balances += [EYELET]
    return tuple(balances)


def transfer(model: LinearModel) -> tuple[FloatArray, FloatArray]:
    """Coefficients of b(s) and a(s) from order zero, scaled for the balance to be an effort."""
    from scipy.signal import ss2tf  # noqa: PLC0415  slow to import

    n = len(model.B)
    numerator, denominator = ss2tf(
        np.reshape(model.A, (n, n)), np.reshape(model.B, (n, 1)), [model.C], [[model.E]]
    )
    b_s, a_s = np.asarray(numerator[0][::-1]), np.asarray(denominator[::-1])
    b_s = np.where(np.abs(b_s) > 1e-9 * np.abs(b_s).max(), b_s, 0.0)
    b_s = np.trim_zeros(b_s, "b")
    lead = b_s[np.flatnonzero(b_s)[0]]
    return b_s / lead, a_s / lead


def smoother_for(
    equation: Equation,
    records: Sequence[Record],
    sampling_Hz: float,
    longest_s: float,
) -> Smoother:
    """The least smoothing that keeps a balance's noise small relative to its terms."""
    shortest_s = 1.0 / sampling_Hz
    if not equation.smooth:
        return Smoother(shortest_s, sampling_Hz)
    most = max(records, key=lambda r: float(r.signals["effort_N"].std()))

    def quiet(width_s: float) -> bool:
        smoother = Smoother(width_s, sampling_Hz)
        terms, by_noise = (
            equation.balance(most.numbers, s, smoother) for s in (most.signals, most.noise)
        )
        noise_rms = np.nanstd(by_noise.known) + np.nanstd(by_noise.columns.sum(axis=1))
        return bool(noise_rms <= CONSTANTS.quiet * np.nanstd(terms.known))

    return Smoother(least_width(quiet, shortest_s, longest_s), sampling_Hz)


def _through_gauge(b: BaseNumbers, tension_N: FloatArray) -> FloatArray:
    """The gauge's reading of a tension that is straight between samples, from rest."""
    if b.gauge_Hz is None:
        return tension_N
    from scipy.signal import cont2discrete, lfilter  # noqa: PLC0415  slow to import

    w = 2.0 * math.pi * b.gauge_Hz
    system = ([w**2], [1.0, 2.0 * b.gauge_damping * w, w**2])
    above, below, _ = cont2discrete(system, 1.0 / b.sampling_Hz, method="foh")
    start = tension_N[0]
    return np.asarray(start + lfilter(np.ravel(above), below, tension_N - start))
