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
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estune.core.controller_equation import controller_polynomials, unlimited_effort
from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.service_records.controller_search import AS_WELL, FITS, least_changed
from estune.service_records.stretches import Stretch

APART = 0.02
"""Relative difference from which a stated gain is said to be another than the one that ran."""

TIME_FACTORS = (60.0, 1e3, 6e4, 1e6)
"""Ratios of units of time: min, s, ms and us."""

RAN_OTHERWISE = "the stated gains are not what ran: "
"""Beginning of the sentence on gains that were stated and did not run."""

TERMS = ([0], [0, 1], [0, 2], [0, 1, 2])
"""Terms of P, I and D that may have run; the fewest that explain the effort did."""

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
                "range; state the form of the controller, or map the signals that it sees"
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
    units = [_unit_efforts(s, settings, 0.0) for s in stretches]
    values = _least_squares(units)
    left = np.concatenate([unit[:, 3] - unit[:, :3] @ values for unit in units])
    return float(np.sqrt(np.mean(left**2)))


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
    scale = 1.0 / (span * math.sqrt(logged.size))

    def error_of(gains: Gains, own: ControllerSettings) -> float:
        left = [_freed(_left(s, own, gains), s, own, gains) for s in stretches]
        return float(np.linalg.norm(np.concatenate(left))) * scale

    def best(own: ControllerSettings, tau: float) -> tuple[float, FloatArray]:
        units = [_unit_efforts(s, own, tau) for s in stretches]
        values = _least_squares(units)
        left = [unit[:, 3] - unit[:, :3] @ values for unit in units]
        return float(np.linalg.norm(np.concatenate(left))) * scale, values

    stated_error = error_of(stated, settings) if stated is not None else math.inf
    tau = stated.setpoint_filter_s if stated is not None else 0.0
    longest_s = max(s.samples for s in stretches) / settings.sampling_Hz
    moves = any(np.ptp(s.setpoint) for s in stretches)
    ran_error, values, own, tau = least_changed(best, settings, tau, longest_s, moves=moves)
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
        error, other = min(((error_of(stated, o), o) for o in others), key=lambda one: one[0])
        if error <= min(FITS, AS_WELL * ran_error):
            return Replay(stated, stated_error, stated, error, other, span)
    return found


def _unit_efforts(stretch: Stretch, settings: ControllerSettings, tau: float) -> FloatArray:
    """Efforts of P, I and D of one and the logged effort, freed of the start, (samples, 4)."""

    def effort(P: float, I: float, D: float) -> FloatArray:
        return _unlimited(stretch, settings, Gains(P, I, D, tau))

    P = effort(1.0, 0.0, 0.0)
    terms = [P, effort(1.0, 1.0, 0.0) - P, effort(1.0, 0.0, 1.0) - P, _effort(stretch)]
    return _freed(np.array(terms), stretch, settings, Gains(1.0, 1.0, 1.0, tau)).T


def _least_squares(units: Sequence[FloatArray]) -> FloatArray:
    """P, I and D of least squares, each zero or above, shape (3,).

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
    values, _ = next(fit for fit in fits if fit[1] <= AS_WELL * least)
    return np.asarray(values * size[3] / size[:3])


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
