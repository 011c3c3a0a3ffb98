"""The effort of a log, computed again from setpoint, measurement and gains.

The effort of a controller without limits is linear in P, I and D. Within a stretch only the state
it begins with is unknown: the integral, a constant, and the two filters, which decay by their
poles. So the gains that did run follow from the logged effort by least squares, and those stated
are confirmed or refused by it before anything is concluded from them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estune.core.controller_equation import controller_polynomials, unlimited_effort
from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.service_records.stretches import Stretch

FITS = 0.005
"""Residual, over the range of the effort, up to which the effort is explained. Eleven logs of a
heated chamber leave 0.01 to 0.10 % with the gains that ran, 4.7 % with a P stated as 4 that was 3,
and 6 to 12 % with a time scale of the integral that is wrong."""

APART = 0.02
"""Relative difference from which a stated gain is said to be another than the one that ran."""

TIME_FACTORS = (60.0, 1e3, 6e4, 1e6)
"""Ratios of units of time: min, s, ms and us."""

RAN_OTHERWISE = "the stated gains are not what ran: "
"""Beginning of the sentence on gains that were stated and did not run."""

AS_WELL = 2.0
"""Ratio of two residuals up to which both explain the effort."""

TERMS = ([0], [0, 1], [0, 2], [0, 1, 2])
"""Terms of P, I and D that may have run; the fewest that explain the effort did."""

FILTERS = 25
"""Time constants of the setpoint filter that are tried, evenly in the logarithm."""

FORMS = tuple(
    ControllerForm(integral=integral, derivative=derivative, derivative_on=on)
    for integral in ("forward", "backward", "tustin")
    for derivative in ("backward", "tustin", "exponential")
    for on in ("measurement", "error")
)
"""Forms that are tried where the stated one explains the effort with no gains."""

INTEGRALS = tuple(form for form in FORMS if form == ControllerForm(integral=form.integral))
"""Those that differ in the integral alone."""


class Replay(NamedTuple):
    """Comparison of the logged effort with that of the stated gains.

    Attributes:
        stated: The gains stated, or None.
        stated_error: Root mean square of what they leave, over the range of the effort.
        ran: The gains that fit the logged effort best; None where P would not be above zero.
        ran_error: What those leave.
        form: The form of the controller with which they do; None is the one stated.
        range: Range of the logged effort.
    """

    stated: Gains | None
    stated_error: float
    ran: Gains | None
    ran_error: float
    form: ControllerForm | None
    range: float

    @property
    def agrees(self) -> bool:
        """Whether the stated gains are those that ran."""
        if self.stated is None or self.form is not None or not self.stated_error <= FITS:
            return False
        near = self.ran is None or not apart(self.stated, self.ran)
        return near or self.stated_error <= AS_WELL * self.ran_error

    @property
    def contradicts(self) -> bool:
        """Whether other gains ran than those stated, or none that are known."""
        return not (self.agrees or (self.stated is None and self.explained))

    @property
    def explained(self) -> bool:
        """Whether some gains explain the effort."""
        return self.ran is not None and self.ran_error <= FITS

    def sentence(self) -> str:
        """What the comparison shows, one sentence without full stop."""
        if self.agrees:
            return (
                "the logged effort is that of the stated gains to "
                f"{self.stated_error:.2%} of its range"
            )
        if not self.explained:
            return (
                f"no gains explain the logged effort: the best leave {self.ran_error:.1%} of its "
                "range; state the form of the controller, or map the signals that it sees"
            )
        form = f" in the form {self.form}" if self.form else ""
        if self.ran == self.stated:
            return (
                f"the stated gains explain the logged effort{form} to {self.ran_error:.2%} of its "
                f"range, in the form stated they leave {self.stated_error:.2%}"
            )
        ran = f"{self.ran}{form} explain it to {self.ran_error:.2%} of its range"
        if self.stated is None:
            return f"the gains that ran follow from the logged effort: {ran}"
        return (
            f"{RAN_OTHERWISE}with {self.stated} the logged effort is off by "
            f"{self.stated_error:.1%} of its range; {ran}{self._unit_of_time()}"
        )

    def _unit_of_time(self) -> str:
        """A remark where the gains that ran are the stated ones in another unit of time."""
        stated, ran = self.stated, self.ran
        if stated is None or ran is None or not stated.I or not ran.I:
            return ""
        if abs(ran.P / stated.P - 1.0) > APART:
            return ""
        ratio = max(ran.I / stated.I, stated.I / ran.I)
        for factor in TIME_FACTORS:
            if abs(ratio / factor - 1.0) < APART:
                return f": I by a factor of {factor:g}, so check the unit of the time"
        return ""


def apart(one: Gains, other: Gains) -> bool:
    """Whether any of the gains differ by more than a replay may leave."""
    pairs = zip(one.as_tuple(), other.as_tuple(), strict=True)
    return any(abs(a - b) > APART * max(abs(a), abs(b)) for a, b in pairs)


def replay(
    stretches: Sequence[Stretch], settings: ControllerSettings, stated: Gains | None
) -> Replay:
    """Compares the logged effort with that of the stated gains, and finds the gains that ran.

    Args:
        stretches: At least one, all with effort.
        settings: The fixed part of the controller, and its form.
        stated: The gains stated; None finds those that ran alone.
    """
    logged = np.concatenate([_effort(s) for s in stretches])
    span = float(np.ptp(logged)) or 1.0
    scale = 1.0 / (span * math.sqrt(logged.size))

    def in_form(form: ControllerForm | None) -> ControllerSettings:
        return settings if form is None else replace(settings, form=form)

    def error_of(gains: Gains, form: ControllerForm | None = None) -> float:
        own = in_form(form)
        left = [_freed(_left(s, own, gains), s, own, gains) for s in stretches]
        return float(np.linalg.norm(np.concatenate(left))) * scale

    def best(tau: float, form: ControllerForm | None) -> tuple[float, FloatArray]:
        units = [_unit_efforts(s, in_form(form), tau) for s in stretches]
        values, norm = _least_squares(units)
        return norm * scale, values

    stated_error = error_of(stated) if stated is not None else math.inf

    tau = stated.setpoint_filter_s if stated is not None else 0.0
    form, (ran_error, values) = None, best(tau, None)
    if ran_error > FITS:
        ran_error, values, tau = _with_filter(best, None, stretches, settings)
    if ran_error > FITS:
        error, other = min(((best(tau, f)[0], f) for f in FORMS), key=lambda one: one[0])
        if error < ran_error:
            form, (ran_error, values, tau) = other, _with_filter(best, other, stretches, settings)
    ran = (
        Gains(float(values[0]), float(values[1]), float(values[2]), tau)
        if values[0] > 0.0
        else None
    )
    found = Replay(stated, stated_error, ran, ran_error, form, span)
    if stated is not None and not found.agrees:
        # Another rule of integration acts as another P does: the stated gains come first.
        forms = FORMS if stated.D else INTEGRALS  # without D all derivatives are one
        error, form = min(((error_of(stated, f), f) for f in forms), key=lambda one: one[0])
        if error <= min(FITS, AS_WELL * ran_error):
            return Replay(stated, stated_error, stated, error, form, span)
    return found


Best = Callable[[float, ControllerForm | None], tuple[float, FloatArray]]
"""Error and gains for one time constant of the setpoint filter and one form."""


def _with_filter(
    best: Best,
    form: ControllerForm | None,
    stretches: Sequence[Stretch],
    settings: ControllerSettings,
) -> tuple[float, FloatArray, float]:
    """Error, gains and time constant of the setpoint filter that fit best."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415  slow to import

    longest_s = max(s.samples for s in stretches) / settings.sampling_Hz
    grid = np.geomspace(0.5 / settings.sampling_Hz, 0.1 * longest_s, FILTERS)
    none = best(0.0, form)
    error, at = min((best(tau, form)[0], n) for n, tau in enumerate(grid.tolist()))
    if none[0] <= error:
        return (*none, 0.0)
    logs, ratio = np.log(grid), math.log(grid[1] / grid[0])
    inner = minimize_scalar(
        lambda x: best(math.exp(x), form)[0],
        bounds=(logs[at] - ratio, logs[at] + ratio),
        method="bounded",
        options={"xatol": 1e-4},
    )
    tau = math.exp(float(inner.x))
    return (*best(tau, form), tau)


def _unit_efforts(stretch: Stretch, settings: ControllerSettings, tau: float) -> FloatArray:
    """Efforts of P, I and D of one and the logged effort, freed of the start, (samples, 4)."""

    def effort(P: float, I: float, D: float) -> FloatArray:
        return _unlimited(stretch, settings, Gains(P, I, D, tau))

    P = effort(1.0, 0.0, 0.0)
    terms = [P, effort(1.0, 1.0, 0.0) - P, effort(1.0, 0.0, 1.0) - P, _effort(stretch)]
    return _freed(np.array(terms), stretch, settings, Gains(1.0, 1.0, 1.0, tau)).T


def _least_squares(units: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """P, I and D of least squares, each zero or above, shape (3,), and the norm of the rest.

    I and D are zero where the effort is explained as well without them: rounded signals give any
    term some gain.
    """
    from scipy.optimize import nnls  # noqa: PLC0415  slow to import

    columns = np.vstack(units)
    size = np.linalg.norm(columns, axis=0)
    # A term that never moves keeps a gain of zero.
    size[size == 0.0] = 1.0
    _, factor = np.linalg.qr(columns / size)

    def of(terms: list[int]) -> tuple[FloatArray, float]:
        values, (found, norm) = np.zeros(3), nnls(factor[:, terms], factor[:, 3])
        values[terms] = found
        return values, norm

    fits = [of(terms) for terms in TERMS]
    least = max(fits[-1][1], np.finfo(float).eps * math.sqrt(len(columns)))
    values, norm = next(fit for fit in fits if fit[1] <= AS_WELL * least)
    return np.asarray(values * size[3] / size[:3]), float(norm * size[3])


def _left(stretch: Stretch, settings: ControllerSettings, gains: Gains) -> FloatArray:
    return _effort(stretch) - _unlimited(stretch, settings, gains)


def _unlimited(stretch: Stretch, settings: ControllerSettings, gains: Gains) -> FloatArray:
    signals = stretch.setpoint, stretch.measurement
    return unlimited_effort(settings, gains, *signals, first_effort=0.0)


def _freed(
    signals: FloatArray, stretch: Stretch, settings: ControllerSettings, gains: Gains
) -> FloatArray:
    """Signals without what unknown states before the stretch may add, shape (..., samples)."""
    c, k = controller_polynomials(settings, gains), np.arange(stretch.samples)
    # Without a filter the derivative knows one sample before: 0^k is one at the first alone.
    poles = {c.derivative_pole, -float(c.filter_denominator[1])}
    with np.errstate(under="ignore"):
        columns = [np.ones(k.size), *(pole**k for pole in sorted(poles))]
    basis, _ = np.linalg.qr(np.array(columns).T)
    return np.asarray(signals - (signals @ basis) @ basis.T)


def _effort(stretch: Stretch) -> FloatArray:
    assert stretch.effort is not None  # noqa: S101  a replay is of logged efforts
    return stretch.effort
