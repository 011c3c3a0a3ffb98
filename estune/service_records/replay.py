"""The effort of a log, computed again from setpoint, measurement and gains.

The effort of a controller without limits is linear in P, I and D. Within a stretch only the state
it begins with is unknown: the integral, a constant, and the two filters, which decay by their
poles. So the gains that did run follow from the logged effort by least squares, and those stated
are confirmed or refused by it before anything is concluded from them.

What is not linear is decided among few: the pole of the derivative filter, that of the setpoint's,
and the signal that the derivative is of. All rules of the derivative filter are one with a pole of
its own, and all rules of integration one with a P of its own: where gains are stated, they tell
the rules apart.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.controller_equation import (
    controller_polynomials,
    setpoint_filter,
    unlimited_effort,
)
from estune.core.controller_form import OWN_FORM, ControllerForm
from estune.core.filtering import lfilter
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.loop_model.error_filters import delayed
from estune.service_records.controller_search import AS_WELL, FITS, least_changed
from estune.service_records.stretches import Stretch, moving_part

APART = 0.02
"""Relative difference from which a stated gain is said to be another than the one that ran."""

TIME_FACTORS = (60.0, 1e3, 6e4, 1e6)
"""Ratios of units of time: min, s, ms and us."""

RAN_OTHERWISE = "the stated gains are not what ran: "
"""Beginning of the sentence on gains that were stated and did not run."""

TERMS = ([0], [0, 1], [0, 2], [0, 1, 2])
"""Terms of P, I and D that may have run; the fewest that explain the effort did."""

SEARCHED = 1 << 18
"""Samples of a stretch by which filters are sought; all of it judges those that are found."""

MEMORY = 32
FORGOTTEN = 0.35
"""Rows, and the share of what is left that means of so many keep, up to which it was forgotten
within a few rows: white noise keeps 0.18. A heater of 3.3 Hz logged at every third sample leaves
2.1 % of its effort, which the derivative made of measurements between the rows; in means 0.27 of
it. What other gains or another form left stays."""

THIN_APART = 0.1
"""Relative difference from which a stated P or I is another than the one that ran, in a thin log:
of that heater they are found to 5 %. D is not, for its filter acted between the rows."""

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
        stated_error: Root mean square of what they leave, over the range of the effort.
        ran: The gains that fit the logged effort best; None where P would not be above zero.
        ran_error: What those leave.
        controller: The fixed part of the controller with which they do; None is the one stated.
        is_thin: Whether the log lacks measurements that the controller saw between its rows.
    """

    stated: Gains | None
    stated_error: float
    ran: Gains | None
    ran_error: float
    controller: ControllerSettings | None
    range: float
    is_thin: bool = False

    @property
    def agrees(self) -> bool:
        """Whether the stated gains are those that ran."""
        if self.stated is not None and self.ran is not None and self.is_thin:
            near = not apart(self.stated, replace(self.ran, D=self.stated.D), THIN_APART)
            return near and self.stated_error <= AS_WELL * self.ran_error
        if self.stated is None or self.controller is not None or not self.stated_error <= FITS:
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
        return self.ran is not None and (self.is_thin or self.ran_error <= FITS)

    @property
    def thin(self) -> str:
        """A remark on a log that lacks what the controller saw between its rows, or nothing."""
        if not self.is_thin:
            return ""
        return (
            ", and the rest is noise of a few rows: the log is thinner than the loop, whose "
            "controller saw measurements between the rows"
        )

    def sentence(self) -> str:
        """What the comparison shows, one sentence without full stop."""
        if self.agrees:
            return (
                "the logged effort is that of the stated gains to "
                f"{self.stated_error:.2%} of its range{self.thin}"
            )
        if not self.explained:
            return (
                f"no gains explain the logged effort: the best leave {self.ran_error:.1%} of its "
                "range; state the form of the controller, --reverse where more effort lowers the "
                "measurement, or map the signals that it sees"
            )
        form = self._controller_text()
        if self.ran == self.stated:
            return (
                f"the stated gains explain the logged effort{form} to {self.ran_error:.2%} of its "
                f"range, in the form stated they leave {self.stated_error:.2%}{self.thin}"
            )
        ran = f"{self.ran}{form} explain it to {self.ran_error:.2%} of its range{self.thin}"
        if self.stated is None:
            return f"the gains that ran follow from the logged effort: {ran}"
        return (
            f"{RAN_OTHERWISE}with {self.stated} the logged effort is off by "
            f"{self.stated_error:.1%} of its range; {ran}{self._unit_of_time()}"
        )

    def _controller_text(self) -> str:
        """What of the controller is found instead of stated; nothing where it is as stated."""
        if self.controller is None:
            return ""
        lag, rate = self.controller.derivative_filter_s, self.controller.sampling_Hz
        new = 1.0 / (1.0 + lag * rate)
        form = f"in the form {self.controller.form}, " if self.controller.form else ""
        return (
            f" {form}with a derivative filter of {lag:.3g} s (a share of {new:.2g} of the newest "
            "difference in each sample)"
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


def plain_error(stretches: Sequence[Stretch], settings: ControllerSettings) -> float:
    """Root mean square that the best P, I and D of one controller leave, in the effort's unit."""
    samples = sum(s.samples for s in stretches)
    return _least_squares(stretches, settings, 0.0)[1] / math.sqrt(samples)


def error_of(stretches: Sequence[Stretch], settings: ControllerSettings, gains: Gains) -> float:
    """Root mean square that some gains leave of the effort, in its unit."""
    left = [_freed(_left(s, settings, gains), s, settings, gains) for s in stretches]
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def apart(one: Gains, other: Gains, by: float = APART) -> bool:
    """Whether any of the gains differ by more than a replay may leave."""
    pairs = zip(one.as_tuple(), other.as_tuple(), strict=True)
    return any(abs(a - b) > by * max(abs(a), abs(b)) for a, b in pairs)


def replay(
    stretches: Sequence[Stretch], settings: ControllerSettings, stated: Gains | None
) -> Replay:
    """Compares the logged effort with that of the stated gains, and finds the gains that ran.

    Args:
        stretches: At least one, all with effort.
        settings: The fixed part of the controller, and its form.
        stated: The gains stated; None finds those that ran alone.
    """
    found = _compared(stretches, settings, stated)
    if found.agrees or found.explained:
        return found
    # Between the rows of a thin log the integral goes on after a step of the setpoint.
    apart_by_steps = [part for one in stretches for part in _between_steps(one)]
    if not apart_by_steps:
        return found
    thin = _compared(apart_by_steps, settings, stated)
    own = thin.controller or settings
    is_thin = thin.ran is not None and _is_thin(apart_by_steps, own, thin.ran)
    return thin._replace(is_thin=True) if is_thin else found


def _between_steps(stretch: Stretch) -> list[Stretch]:
    """The parts of a stretch with one setpoint that are long enough to tell noise of few rows."""
    ends = [0, *(np.flatnonzero(np.diff(stretch.setpoint)) + 2).tolist(), stretch.samples]
    return [
        stretch.part(slice(a, b))
        for a, b in pairwise(ends)
        if min(b, stretch.samples) - a >= 2 * MEMORY
    ]


def _is_thin(stretches: Sequence[Stretch], settings: ControllerSettings, ran: Gains) -> bool:
    """Whether what is left is what a derivative makes of measurements between the rows.

    It is noise of a few rows, no larger than what the derivative made of those in the log.
    """
    left = [_freed(_left(s, settings, ran), s, settings, ran) for s in stretches]
    slopes = [
        _freed(_left(s, settings, replace(ran, D=0.0)), s, settings, ran) - rest
        for s, rest in zip(stretches, left, strict=True)
    ]
    power = float(np.mean(np.concatenate(left) ** 2))
    means = [one[: one.size // MEMORY * MEMORY].reshape(-1, MEMORY).mean(axis=1) for one in left]
    kept = float(np.mean(np.concatenate(means) ** 2))
    fast = float(np.var(np.diff(np.concatenate(slopes)))) / 2.0
    return kept <= FORGOTTEN**2 * power and power <= fast


def _compared(
    stretches: Sequence[Stretch],
    settings: ControllerSettings,
    stated: Gains | None,
) -> Replay:
    """The comparison by what is left row by row."""
    logged = np.concatenate([_effort(s) for s in stretches])
    span = float(np.ptp(logged)) or 1.0

    def best(own: ControllerSettings, tau: float) -> tuple[float, FloatArray]:
        return _best_of(stretches, own, tau, span)

    moving = [moving_part(stretch, SEARCHED) for stretch in stretches]

    def by_part(own: ControllerSettings, tau: float) -> tuple[float, FloatArray]:
        return _best_of(moving, own, tau, span)

    stated_error = math.inf
    if stated is not None:
        stated_error = error_of(stretches, settings, stated) / span
    tau = stated.setpoint_filter_s if stated is not None else 0.0
    longest_s = max(s.samples for s in stretches) / settings.sampling_Hz
    moves = any(np.ptp(s.setpoint) for s in stretches)
    ran_error, values, own, tau = least_changed(
        best, by_part, settings, tau, longest_s, moves=moves
    )
    ran = (
        Gains(float(values[0]), float(values[1]), float(values[2]), tau)
        if values[0] > 0.0
        else None
    )
    changed = None if own == settings else own
    found = Replay(stated, stated_error, ran, ran_error, changed, span)
    if stated is not None and not found.agrees:
        # Another rule of integration acts as another P does: the stated gains come first.
        forms = FORMS if stated.D else INTEGRALS  # without D all derivatives are one
        others = [replace(one, form=form) for one in {settings, own} for form in forms]
        errors = [error_of(stretches, one, stated) / span for one in others]
        error, other = min(zip(errors, others, strict=True), key=lambda one: one[0])
        if error <= min(FITS, AS_WELL * ran_error):
            return Replay(stated, stated_error, stated, error, other, span)
    return found


def _best_of(
    stretches: Sequence[Stretch], settings: ControllerSettings, tau: float, span: float
) -> tuple[float, FloatArray]:
    """Error over a range, and gains, of least squares."""
    values, left = _least_squares(stretches, settings, tau)
    return left / (span * math.sqrt(sum(s.samples for s in stretches))), values


@lru_cache(maxsize=64)
def _unit_taps(settings: ControllerSettings) -> tuple[FloatArray, float]:
    """Taps of setpoint and measurement for P, I and D of one, shape (3, 2, 4), and the pole p."""
    forms = [
        controller_polynomials(settings, Gains(1.0, *gains, 0.0))
        for gains in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    ]
    taps = np.zeros((3, 2, 4))
    for unit, c in zip(taps, forms, strict=True):
        unit[0, : c.setpoint.size], unit[1, : c.measurement.size] = c.setpoint, -c.measurement
    taps[1:] -= taps[0]
    return taps, forms[0].derivative_pole


def _triangle(stretch: Stretch, settings: ControllerSettings, tau: float) -> FloatArray:
    """R of the efforts of P, I and D of one and the logged one, freed of the start, (4, 4)."""
    taps, pole = _unit_taps(settings)
    form, h = settings.form or OWN_FORM, 1.0 / settings.sampling_Hz
    above, below = setpoint_filter(form, h, tau)
    r, y = stretch.setpoint - stretch.setpoint[0], stretch.measurement - stretch.measurement[0]
    seen = lfilter([1.0], [1.0, -pole], np.array([lfilter(above, below, r), y]))
    k = np.arange(stretch.samples)
    late = np.stack([delayed(seen, lag) for lag in range(taps.shape[2])], axis=1)
    efforts = np.cumsum(taps.reshape(3, -1) @ late.reshape(-1, k.size), axis=1)
    # The error of the first sample is integrated from then on, as if it had always been there.
    efforts[1] += (stretch.setpoint[0] - stretch.measurement[0]) * h * k
    starts = _starts(k, {pole, -float(below[1])})
    columns = np.array([*starts, *efforts, _effort(stretch)]).T
    return np.asarray(np.linalg.qr(columns, mode="r"))[len(starts) :, len(starts) :]


def _least_squares(
    stretches: Sequence[Stretch], settings: ControllerSettings, tau: float
) -> tuple[FloatArray, float]:
    """P, I and D of least squares, each zero or above, shape (3,), and the norm of what is left.

    I and D are zero where the effort is explained as well without them: rounded signals give any
    term some gain.
    """
    from scipy.optimize import nnls  # noqa: PLC0415  slow to import

    factor = np.vstack([_triangle(s, settings, tau) for s in stretches])
    if len(stretches) > 1:
        factor = np.asarray(np.linalg.qr(factor, mode="r"))
    size = np.linalg.norm(factor, axis=0)
    # A term that never moves keeps a gain of zero.
    size[size == 0.0] = 1.0
    factor /= size

    def of(terms: list[int]) -> tuple[FloatArray, float]:
        values, (found, norm) = np.zeros(3), nnls(factor[:, terms], factor[:, 3])
        values[terms] = found
        return values, norm

    whole = of(TERMS[-1])
    samples = sum(s.samples for s in stretches)
    enough = AS_WELL * max(whole[1], np.finfo(float).eps * math.sqrt(samples))
    fits = (of(terms) for terms in TERMS[:-1])
    values, norm = next((fit for fit in fits if fit[1] <= enough), whole)
    return np.asarray(values * size[3] / size[:3]), norm * float(size[3])


def _left(stretch: Stretch, settings: ControllerSettings, gains: Gains) -> FloatArray:
    return _effort(stretch) - _unlimited(stretch, settings, gains)


def _unlimited(stretch: Stretch, settings: ControllerSettings, gains: Gains) -> FloatArray:
    signals = stretch.setpoint, stretch.measurement
    return unlimited_effort(settings, gains, *signals, first_effort=0.0)


def _freed(
    signals: FloatArray, stretch: Stretch, settings: ControllerSettings, gains: Gains
) -> FloatArray:
    """Signals without what unknown states before the stretch may add, shape (..., samples)."""
    c = controller_polynomials(settings, gains)
    poles = {c.derivative_pole, -float(c.filter_denominator[1])}
    basis, _ = np.linalg.qr(np.array(_starts(np.arange(stretch.samples), poles)).T)
    return np.asarray(signals - (signals @ basis) @ basis.T)


def _starts(k: NDArray[np.int64], poles: set[float]) -> list[FloatArray]:
    """What unknown states before the first of samples k may add, shape (samples,) each.

    Without a filter the derivative knows one sample before: 0^k is one at the first alone.
    """
    with np.errstate(under="ignore"):
        return [np.ones(k.size), *(np.asarray(pole**k) for pole in sorted(poles))]


def _effort(stretch: Stretch) -> FloatArray:
    assert stretch.effort is not None  # noqa: S101  a replay is of logged efforts
    return stretch.effort
