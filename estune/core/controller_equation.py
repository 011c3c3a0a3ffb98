"""The difference equation of the PIDF in the forms in which controllers run it.

With q^-1 the backward shift and h the sampling interval, every form is, within its limits,

    R u = T F r - S y,      R = Ni Nf,      Ni = 1 - q^-1,      Nf = 1 - p q^-1

of setpoint r, measurement y and effort u. In the parallel structure

    T = W Nf,      S = W Nf + D g Ni^2,      W = P Ni + I h (i0 + i1 q^-1)

    integral         forward      i0, i1 = 0, 1;  backward 1, 0;  tustin 1/2, 1/2
    derivative       backward     p = tau/(tau + h),            g = 1/(tau + h)
                     tustin       p = (2 tau - h)/(2 tau + h),  g = 2/(2 tau + h)
                     exact        p = exp(-h/tau),              g = 1/tau
                     exponential  p = exp(-h/tau),              g = (1 - p)/h
    setpoint filter  exact        F = (1 - a)/(1 - a q^-1),     a = exp(-h/tau_F)
                     backward     the same with                 a = tau_F/(tau_F + h)
                     tustin       F = (1 - a)/2 (1 + q^-1)/(1 - a q^-1),
                                                                a = (2 tau_F - h)/(2 tau_F + h)

with tau the time constant of the derivative filter, tau_F that of the setpoint filter. In the
series structure S = W (Nf + D/P g Ni). A filter on the measurement instead of the derivative is
l/Nf, with l = 1 - p, or (1 - p)/2 (1 + q^-1) by Tustin; then S = l (W + D Ni^2/h), or in series
l W (1 + D/P Ni/h). A derivative on the error adds to T what it adds to S, of the filtered
setpoint. `estune.core.pidf` runs the form of all defaults.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from estune.core.controller_form import OWN_FORM, ControllerForm
from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput


class ControllerPolynomials(NamedTuple):
    """R u = T F r - S y in powers of q^-1; each begins with the present sample.

    Attributes:
        setpoint: T.
        measurement: S.
        denominator: R = Ni Nf; its first number is one.
        filter_numerator: Of F.
        filter_denominator: Of F; its first number is one.
        derivative_pole: p of Nf.
    """

    setpoint: FloatArray
    measurement: FloatArray
    denominator: FloatArray
    filter_numerator: FloatArray
    filter_denominator: FloatArray
    derivative_pole: float


_DIFFERENCE = np.array([1.0, -1.0])
_INTEGRAL = {"forward": (0.0, 1.0), "backward": (1.0, 0.0), "tustin": (0.5, 0.5)}


def controller_polynomials(
    settings: ControllerSettings, gains: Gains, form: ControllerForm | None = None
) -> ControllerPolynomials:
    """The difference equation of a controller with some gains, within its limits.

    Args:
        settings: The fixed part of the controller.
        gains: The gains, read as those of the form's structure.
        form: The form; that of the settings by default, and where these have none `OWN_FORM`.

    Raises:
        InvalidInput: the exact derivative has no filter.
    """
    form = form or settings.form or OWN_FORM
    h, lag = 1.0 / settings.sampling_Hz, settings.derivative_filter_s
    p, g = _derivative(form, h, lag)
    Nf = np.array([1.0, -p])
    W = gains.P * _DIFFERENCE + gains.I * h * np.array(_INTEGRAL[form.integral])
    if form.filter_on == "derivative":
        low_pass, slope = Nf, g * _DIFFERENCE
    else:
        low_pass = (1.0 - p) * np.array([0.5, 0.5] if form.derivative == "tustin" else [1.0])
        slope = np.convolve(low_pass, _DIFFERENCE) / h

    def with_derivative(passed: FloatArray, differentiated: FloatArray) -> FloatArray:
        if form.structure == "series":
            return np.convolve(W, _sum(passed, gains.D / gains.P * differentiated))
        return _sum(np.convolve(W, passed), gains.D * np.convolve(differentiated, _DIFFERENCE))

    S = with_derivative(low_pass, slope)
    T = np.convolve(W, Nf)
    if form.derivative_on == "error":  # the filter on the measurement leaves the setpoint alone
        unfiltered = np.convolve(Nf, _DIFFERENCE) / h
        T = with_derivative(Nf, slope if form.filter_on == "derivative" else unfiltered)
    return ControllerPolynomials(
        T, S, np.convolve(_DIFFERENCE, Nf), *setpoint_filter(form, h, gains.setpoint_filter_s), p
    )


def unlimited_effort(
    settings: ControllerSettings,
    gains: Gains,
    setpoint: FloatArray,
    measurement: FloatArray,
    *,
    first_effort: float,
    form: ControllerForm | None = None,
) -> FloatArray:
    """The efforts over a record in which no limit acts, shape (samples,).

    The controller's filters are at rest at the first sample; only its integral is unknown.

    Args:
        settings: The fixed part of the controller.
        setpoint: Setpoint before its filter, shape (samples,).
        measurement: Measurement, shape (samples,).
        form: As of `controller_polynomials`.
    """
    efforts = efforts_by_filter(
        settings, gains, setpoint, measurement, first_effort=first_effort, form=form
    )
    return efforts(gains.setpoint_filter_s)


def efforts_by_filter(
    settings: ControllerSettings,
    gains: Gains,
    setpoint: FloatArray,
    measurement: FloatArray,
    *,
    first_effort: float,
    form: ControllerForm | None = None,
) -> Callable[[float], FloatArray]:
    """The same as a function of the setpoint filter's time constant, s, that of the gains unread.

    What is the same for all of them is computed once: many are tried on one record.
    """
    form = form or settings.form or OWN_FORM
    h = 1.0 / settings.sampling_Hz
    c = controller_polynomials(settings, gains, form)
    r, measured = setpoint - setpoint[0], _filtered(c.measurement, measurement - measurement[0])
    # The error of the first sample is integrated from then on, as if it had always been there.
    constant = float(setpoint[0] - measurement[0]) * gains.I / settings.sampling_Hz
    integrated = constant * np.arange(setpoint.size)

    def efforts(filter_s: float) -> FloatArray:
        driven = _filtered(c.setpoint, lfilter(*setpoint_filter(form, h, filter_s), r)) - measured
        passed = lfilter([1.0], [1.0, -c.derivative_pole], driven)
        effort = first_effort + np.cumsum(passed) + integrated
        return np.asarray(effort + first_effort - effort[0])

    return efforts


def _derivative(form: ControllerForm, h: float, lag: float) -> tuple[float, float]:
    """Pole p and gain g of the derivative filter."""
    if form.derivative == "backward":
        return lag / (lag + h), 1.0 / (lag + h)
    if form.derivative == "tustin":
        return (2.0 * lag - h) / (2.0 * lag + h), 2.0 / (2.0 * lag + h)
    p = math.exp(-h / lag) if lag > 0.0 else 0.0
    if form.derivative == "exponential" or form.filter_on == "measurement":
        return p, (1.0 - p) / h
    if lag == 0.0:
        raise InvalidInput(
            "the exact derivative has no filter; give derivative_filter_s a value above zero, or "
            "declare the derivative as backward"
        )
    return p, 1.0 / lag


def setpoint_filter(form: ControllerForm, h: float, lag: float) -> tuple[FloatArray, FloatArray]:
    """Numerator and denominator of F with some time constant."""
    one, other, pole = filter_terms(form, h, lag)
    return np.array([one, other] if other else [one]), np.array([1.0, -pole])


def filter_terms(form: ControllerForm, h: float, lag: float) -> tuple[float, float, float]:
    """Both terms of the numerator of F with some time constant, and its pole."""
    if form.setpoint_filter == "exact" or lag == 0.0:
        a = math.exp(-h / max(lag, 1e-12))
    elif form.setpoint_filter == "backward":
        a = lag / (lag + h)
    else:
        a = (2.0 * lag - h) / (2.0 * lag + h)
        return 0.5 * (1.0 - a), 0.5 * (1.0 - a), a
    return 1.0 - a, 0.0, a


def _filtered(numerator: FloatArray, samples: FloatArray) -> FloatArray:
    return np.convolve(numerator, samples)[: samples.size]


def _sum(one: FloatArray, other: FloatArray) -> FloatArray:
    """Sum of two polynomials in q^-1."""
    total = np.zeros(max(one.size, other.size))
    total[: one.size] += one
    total[: other.size] += other
    return total
