"""Derivatives of sampled signals under one common smoothing, which preserves linear equations.

If a x'' + b x' + c x = u, then for the signals convolved with any kernel g
a (g'' * x) + b (g' * x) + c (g * x) = g * u. A Gaussian g smooths terms of all orders alike, as
modulating functions do (Shinbrot 1957), unlike local polynomials (Savitzky & Golay 1964).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.polynomial import hermite_e

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS


class Smoother(NamedTuple):
    """A Gaussian kernel on a sampling grid.

    Attributes:
        width_s: Its standard deviation, s; one sample or more, so that the sum is the integral.
    """

    width_s: float
    sampling_Hz: float

    @classmethod
    def slow(cls, duration_s: float, sampling_Hz: float) -> "Smoother":
        """The kernel through which signs and units of a record are compared."""
        return cls(max(0.01 * duration_s, 1.0 / sampling_Hz), sampling_Hz)

    @property
    def reach(self) -> int:
        """Samples on either side that a smoothed value depends on."""
        # Beyond five widths a Gaussian is below exp(-12.5), 4e-6 of its peak.
        return int(np.ceil(5.0 * self.width_s * self.sampling_Hz))

    def sampled(self, signal: FloatArray, *coefficients: float) -> FloatArray:
        """`c0 x + c1 x' + c2 x'' + ...` smoothed, of a signal known at the sampling instants.

        Args:
            signal: Shape (samples,).
            *coefficients: Of the derivatives, from order zero.

        Returns:
            Shape (samples,); nan at both ends, where the kernel reaches beyond the record.
        """
        reach = self.reach
        if signal.size <= 2 * reach:
            return _unknown(signal)
        t = np.arange(-reach, reach + 1) / self.sampling_Hz
        kernel = sum(c * self._derivative(t, order) for order, c in enumerate(coefficients))
        return _convolved(signal, np.asarray(kernel) / self.sampling_Hz, reach)

    def held(self, signal: FloatArray, delay_s: float, *coefficients: float) -> FloatArray:
        """`c0 x + c1 x' + ...` smoothed, of a delayed signal with zero-order hold.

        Args:
            signal: Shape (samples,).
            *coefficients: Of the derivatives, from order zero.
        """
        reach = self.reach + int(np.ceil(delay_s * self.sampling_Hz)) + 1
        if signal.size <= 2 * reach:
            return _unknown(signal)
        t = np.arange(-reach, reach + 1) / self.sampling_Hz - delay_s
        kernel = sum(
            c * (self._integral(t, order) - self._integral(t - 1.0 / self.sampling_Hz, order))
            for order, c in enumerate(coefficients)
        )
        return _convolved(signal, np.asarray(kernel), reach)

    def _derivative(self, t: FloatArray, order: int) -> FloatArray:
        """g^(n)(t) = (-1/s)^n He_n(t/s) g(t)."""
        x = t / self.width_s
        bell = np.exp(-0.5 * x**2) / (self.width_s * np.sqrt(2.0 * np.pi))
        polynomial = hermite_e.hermeval(x, np.eye(order + 1)[order])
        return np.asarray((-1.0 / self.width_s) ** order * polynomial * bell)

    def _integral(self, t: FloatArray, order: int) -> FloatArray:
        if order > 0:
            return self._derivative(t, order - 1)
        from scipy.special import ndtr  # noqa: PLC0415  slow to import

        return np.asarray(ndtr(t / self.width_s))


def proportion(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Slope of y by x, and the share of its variance that x explains; zeros where either rests.

    Samples at which one of them is not known are left out.
    """
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return 0.0, 0.0
    x, y = x[known] - x[known].mean(), y[known] - y[known].mean()
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    return (xy / xx, xy**2 / (xx * yy)) if xx > 0.0 and yy > 0.0 else (0.0, 0.0)


def _unknown(signal: FloatArray) -> FloatArray:
    """A signal shorter than its kernel, of which nothing is known.

    No kernel is made: beside records a thousand times slower it took minutes.
    """
    return np.full(signal.size, np.nan)


def _convolved(signal: FloatArray, kernel: FloatArray, reach: int) -> FloatArray:
    from scipy.signal import oaconvolve  # noqa: PLC0415  slow to import

    # Without the mean, rounding in the fast convolution stays below the derivative.
    mean = float(signal.mean())
    smooth = oaconvolve(signal - mean, kernel, mode="same") + mean * kernel.sum()
    smooth[:reach] = smooth[smooth.size - reach :] = np.nan
    return np.asarray(smooth)


def least_width(wanted: Callable[[float], bool], shortest_s: float, longest_s: float) -> float:
    """The least sufficient width by bisection; the longest where none is, s."""
    low, high = shortest_s, max(shortest_s, longest_s)
    if wanted(low):
        return low
    while high / low > 1.0 + CONSTANTS.small:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if wanted(middle) else (middle, high)
    return high
