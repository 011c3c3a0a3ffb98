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
from plants.diagnosis.data.smoothing import Smoother, least_width
from plants.diagnosis.models.base import BaseNumbers

NOISE_MAX = 0.02
"""Noise of the smoothed balance, as a share of its terms, that the smoothing aims at."""
ORDER_MAX = 6
"""Higher derivatives are noise on any record."""


Signals = Mapping[str, FloatArray]
"""Signals of one record, or simulated noise of them, shape (samples,) each: `effort_N` (command
times newtons per ampere) and, where measured, `angle_rad`, `tension_N` (the output of a plant that
is no reel), `reference_N`, `current_A`."""


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
        name: Of the block.
        title: In plain words.
        unit: Unit of the residual.
        balance: The terms.
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
    """R T = K_t u - J a - b v + u_0."""
    w = 2.0 * math.pi * b.gauge_Hz if b.gauge_Hz else math.inf
    known = b.drum_radius_m * smoother.sampled(
        s["tension_N"], 1.0, 2.0 * b.gauge_damping / w, 1.0 / w**2
    )
    columns = [
        b.drum_radius_m * smoother.held(s["effort_N"], b.dead_time_s, 1.0),
        -b.drum_inertia_kg_m2 * smoother.sampled(s["angle_rad"], 0.0, 0.0, 1.0),
        -smoother.sampled(s["angle_rad"], 0.0, 1.0),
    ]
    return Terms(-known, -np.column_stack(columns))


def _force_by_angle(b: BaseNumbers, s: Signals, smoother: Smoother) -> Terms:
    """K_t u = J a + b v + k R^2 theta - u_0, without a gauge."""
    known = b.drum_radius_m * smoother.held(s["effort_N"], b.dead_time_s, 1.0)
    columns = [
        b.drum_inertia_kg_m2 * smoother.sampled(s["angle_rad"], 0.0, 0.0, 1.0),
        smoother.sampled(s["angle_rad"], 0.0, 1.0),
    ]
    if b.stiffness_N_m is not None:
        k = b.stiffness_N_m * b.drum_radius_m**2
        columns.append(k * smoother.sampled(s["angle_rad"], 1.0))
    return Terms(known, np.column_stack(columns))


def _force_by_tension(b: BaseNumbers, s: Signals, smoother: Smoother) -> Terms:
    """K_t u = J a + b v + k R^2 theta - u_0 with theta = T/(k R), without an encoder."""
    known = b.drum_radius_m * smoother.held(s["effort_N"], b.dead_time_s, 1.0)
    radian_per_N = 1.0 / b.tension_per_angle_N_rad
    columns = [
        b.drum_inertia_kg_m2 * radian_per_N * smoother.sampled(s["tension_N"], 0.0, 0.0, 1.0),
        radian_per_N * smoother.sampled(s["tension_N"], 0.0, 1.0),
        b.drum_radius_m * smoother.sampled(s["tension_N"], 1.0),
    ]
    return Terms(known, np.column_stack(columns))


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
    return Terms(known, _derivatives(denominator, s, smoother))


def _plant_of_smooth_input(b: BaseNumbers, s: Signals, smoother: Smoother) -> Terms:
    """b(d/dt) u = a(d/dt) y of an input that was sampled, not held: half a sample earlier."""
    numerator, denominator = transfer(_linear(b))
    known = smoother.sampled(s["effort_N"], *numerator)
    late = b.dead_time_s * b.sampling_Hz
    index = np.arange(known.size) - late
    delayed = np.interp(index, np.arange(known.size), known) if late > 0.0 else known
    return Terms(delayed, _derivatives(denominator, s, smoother))


def _derivatives(denominator: FloatArray, s: Signals, smoother: Smoother) -> FloatArray:
    output = s["tension_N"] if "tension_N" in s else s["angle_rad"]
    orders = np.eye(denominator.size) * np.where(denominator == 0.0, 1.0, denominator)
    return np.column_stack([smoother.sampled(output, *row) for row in orders])


def _linear(b: BaseNumbers) -> LinearModel:
    if b.linear is None:
        raise InvalidInput("the balance of a linear plant needs its model; give `linear`")
    return b.linear


FORCE = Equation("force", "force block", "N m", _force, own_offset=False, smooth=True)
FORCE_BY_ANGLE = replace(FORCE, balance=_force_by_angle, own_offset=True)
FORCE_BY_TENSION = replace(FORCE, balance=_force_by_tension)
GAUGE = Equation("gauge", "cable and gauge block", "N", _gauge, own_offset=True, smooth=False)
EYELET = replace(GAUGE, name="eyelet", title="eyelet", balance=_eyelet)
ACTUATOR = Equation("actuator", "actuator", "A", _actuator, own_offset=False, smooth=False)
PLANT = Equation("plant", "balance of the plant", "N", _plant, own_offset=True, smooth=True)
PLANT_OF_SMOOTH_INPUT = replace(PLANT, balance=_plant_of_smooth_input)


def equations(b: BaseNumbers, channels: frozenset[str]) -> tuple[Equation, ...]:
    """The balances that the base model and the channels of all records allow.

    Of two with one name, the one with the smaller residual applies.
    """
    found: list[Equation] = [ACTUATOR] if "current_A" in channels else []
    gauge, encoder = "tension_N" in channels, "angle_rad" in channels
    if b.linear is not None:
        _, denominator = transfer(b.linear)
        if denominator.size - 1 > ORDER_MAX:
            return tuple(found)
        return (*found, PLANT, PLANT_OF_SMOOTH_INPUT)
    cable = b.stiffness_N_m is not None
    if cable and gauge and encoder:
        found += [FORCE, GAUGE]
    elif encoder:
        found += [FORCE_BY_ANGLE]
    elif cable and gauge:
        found += [FORCE_BY_TENSION]
    if gauge and "reference_N" in channels:
        found += [EYELET]
    return tuple(found)


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
    records: Sequence[tuple[BaseNumbers, Signals, Signals]],
    sampling_Hz: float,
    longest_s: float,
) -> Smoother:
    """The least smoothing that keeps a balance's noise small relative to its terms."""
    shortest_s = 1.0 / sampling_Hz
    if not equation.smooth:
        return Smoother(shortest_s, sampling_Hz)
    b, s, noise = max(records, key=lambda r: float(r[1]["effort_N"].std()))

    def quiet(width_s: float) -> bool:
        smoother = Smoother(width_s, sampling_Hz)
        terms, by_noise = (equation.balance(b, each, smoother) for each in (s, noise))
        noise_rms = np.nanstd(by_noise.known) + np.nanstd(by_noise.columns.sum(axis=1))
        return bool(noise_rms <= NOISE_MAX * np.nanstd(terms.known))

    return Smoother(least_width(quiet, shortest_s, longest_s), sampling_Hz)


def _through_gauge(b: BaseNumbers, tension_N: FloatArray) -> FloatArray:
    """The gauge's reading of a tension that is straight between samples, from rest."""
    if b.gauge_Hz is None:
        return tension_N
    from scipy.signal import cont2discrete, lfilter, lfilter_zi  # noqa: PLC0415  slow to import

    w = 2.0 * math.pi * b.gauge_Hz
    system = ([w**2], [1.0, 2.0 * b.gauge_damping * w, w**2])
    numerator, denominator, _ = cont2discrete(system, 1.0 / b.sampling_Hz, method="foh")
    numerator = np.ravel(numerator)
    start = lfilter_zi(numerator, denominator) * tension_N[0]
    return np.asarray(lfilter(numerator, denominator, tension_N, zi=start)[0])
