"""Weighted least squares of the sampled second-order model on a measured frequency response."""

import math
from dataclasses import dataclass, replace

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from experiments.paper.identify.frequency_response import FrequencyResponse
from experiments.paper.identify.spectra import ComplexArray
from experiments.paper.second_order import GaugeMode, SecondOrder, held_response

COHERENCE_MIN = 0.8
"""Minimum median coherence of the five lines about the peak."""
DEAD_TIMES_TRIED = np.arange(0.25, 20.0, 0.5)
"""Trial dead times in samples; a start with the wrong phase winding does not converge."""
GAUGE_RATIO_MIN = 4.0
"""Lowest frequency of a gauge mode relative to the resonance."""


@dataclass(frozen=True, slots=True, eq=False)
class SecondOrderProblem:
    """Least-squares problem in (ln w h, ln zeta, gain, dead time/h, ln w_g h, ln zeta_g)."""

    sampling_Hz: float
    frequency_Hz: FloatArray
    theta: FloatArray
    response: ComplexArray
    error: FloatArray
    coherence: FloatArray
    known_gauge: GaugeMode | None

    @classmethod
    def of(
        cls, response: FrequencyResponse, known_gauge: GaugeMode | None
    ) -> "SecondOrderProblem":
        """The problem of a measured response, with the gauge mode if it is known.

        Raises:
            InvalidInput: the response holds a value that is not finite.
        """
        error = np.sqrt(response.variance)
        if not (np.isfinite(response.response).all() and np.isfinite(error).all()):
            raise InvalidInput(
                "the frequency response holds a value that is not finite: an excited line had no "
                "input; give the excitation that was run"
            )
        # Corrects the bias of one over an estimated variance.
        error = error * np.sqrt(response.degrees / (response.degrees - 2.0))
        # Without noise all lines have equal weight.
        floor = 1e-9 * np.abs(response.response).max()
        return cls(
            response.sampling_Hz,
            response.frequency_Hz,
            2.0 * np.pi * response.frequency_Hz / response.sampling_Hz,
            response.response,
            np.maximum(error, floor),
            response.coherence,
            known_gauge,
        )

    def below(self, frequency_Hz: float) -> "SecondOrderProblem":
        """The problem on the lines up to a frequency."""
        used = self.frequency_Hz <= frequency_Hz
        names = ("frequency_Hz", "theta", "response", "error", "coherence")
        return replace(self, **{name: getattr(self, name)[used] for name in names})

    def model(self, x: FloatArray) -> SecondOrder:
        """The model of these unknowns."""
        fs = self.sampling_Hz
        gauge = GaugeMode(math.exp(x[4]) * fs, math.exp(x[5])) if x.size > 4 else self.known_gauge
        return SecondOrder(float(x[2]), math.exp(x[0]) * fs, math.exp(x[1]), x[3] / fs, gauge)

    def residual(self, x: FloatArray) -> ComplexArray:
        """Measured less modelled response, over its standard error."""
        modes = [(x[0], x[1])]
        if x.size > 4:
            modes.append((x[4], x[5]))
        poles = [_pole(math.exp(w), math.exp(zeta)) for w, zeta in modes]
        if x.size == 4 and self.known_gauge is not None:
            poles.append(self.known_gauge.pole_rad_s / self.sampling_Hz)
        modelled = held_response(self.theta, np.array(poles), float(x[2]), float(x[3]))
        return np.asarray((self.response - modelled) / self.error)

    def start(self) -> FloatArray:
        """Initial unknowns from the peak's position and height, with the best of many dead times.

        Raises:
            InvalidInput: there is no peak inside the band, or it is hidden by noise.
        """
        size, band = np.abs(self.response), self.frequency_Hz
        # The tallest peak significantly above the noise.
        peak = int(np.argmax(np.where(size > 3.0 * self.error, size, 0.0)))
        about = slice(max(0, peak - 2), peak + 3)
        coherence = float(np.median(self.coherence[about]))
        if coherence < COHERENCE_MIN:
            raise InvalidInput(
                f"coherence is {coherence:.2f} about the peak at {band[peak]:.3g} Hz, below "
                f"{COHERENCE_MIN}; raise the excitation's peak, or measure more periods"
            )
        if peak in (0, band.size - 1):
            raise InvalidInput(
                f"no resonance inside the excited band of {band[0]:.3g} to {band[-1]:.3g} Hz: the "
                f"response is largest at its {'lower' if peak == 0 else 'upper'} end; widen the "
                "band there, unless the plant has no resonance"
            )
        at_rest = self.response[0] * (1.0 - (band[0] / band[peak]) ** 2)
        gain = math.copysign(abs(at_rest), at_rest.real)
        zeta = min(max(abs(at_rest) / (2.0 * size[peak]), 0.005), 0.6)
        around = self.below(GAUGE_RATIO_MIN * band[peak])
        x = np.array([math.log(self.theta[peak]), math.log(zeta), gain, 0.0])
        starts = [np.array([*x[:3], dead_time]) for dead_time in DEAD_TIMES_TRIED]
        misfits = [np.sum(np.abs(around.residual(start)) ** 2) for start in starts]
        return starts[int(np.argmin(misfits))]

    def with_gauge(self, start: FloatArray) -> FloatArray:
        """The start with a gauge mode at the frequency of the best fit.

        Raises:
            InvalidInput: the band has too few lines for a gauge mode.
        """
        resonance_Hz = math.exp(start[0]) * self.sampling_Hz / (2.0 * math.pi)
        begin_Hz = GAUGE_RATIO_MIN * resonance_Hz
        above = self.frequency_Hz > begin_Hz
        if np.count_nonzero(above) < 4:
            raise InvalidInput(
                f"the excited band ends at {self.frequency_Hz[-1]:.3g} Hz, too low to see a gauge "
                f"mode above {begin_Hz:.3g} Hz; widen the band, give the known mode, or none"
            )
        low, _ = self.below(begin_Hz).solve(start)
        candidates = []
        for theta in np.linspace(self.theta[above][0], self.theta[-1], 24):
            x = np.concatenate([low, [math.log(theta), math.log(0.05)]])
            candidates.append((float(np.sum(np.abs(self.residual(x)) ** 2)), x))
        return min(candidates, key=lambda candidate: candidate[0])[1]

    def solve(self, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Best unknowns, and the covariance of (w, zeta, gain, dead time, w_g, zeta_g).

        Raises:
            InvalidInput: the fit does not converge, or the data do not determine the unknowns.
        """
        from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

        def residual(x: FloatArray) -> FloatArray:
            return self.residual(x).view(np.float64)

        # Damping up to 0.99, dead time not negative, frequency below Nyquist.
        high = np.array([math.log(math.pi), -0.01, np.inf, np.inf, math.log(math.pi), -0.01])
        low = np.array([-np.inf, math.log(1e-4), -np.inf, 0.0, -np.inf, math.log(1e-4)])
        n = start.size
        fit = least_squares(
            residual,
            np.clip(start, low[:n] + 1e-9, high[:n] - 1e-9),
            bounds=(low[:n], high[:n]),
            x_scale="jac",
            jac="3-point",
            xtol=1e-10,
            ftol=1e-12,
            gtol=1e-12,
            max_nfev=400,
        )
        x, J = fit.x, fit.jac
        # The variance of a complex response is split over two real parts.
        normal = 2.0 * J.T @ J
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal * np.outer(scale, scale)
        if not fit.success or np.linalg.cond(scaled) > 1e12:
            raise InvalidInput(
                f"the fit did not converge to one model ({fit.message.rstrip('.')}); widen the "
                "band, raise the excitation's peak, or leave out the gauge mode"
            )
        covariance = np.linalg.inv(scaled) * np.outer(scale, scale)
        fs = self.sampling_Hz
        units = np.array([fs * math.exp(x[0]), math.exp(x[1]), 1.0, 1.0 / fs])
        if n > 4:
            units = np.append(units, [fs * math.exp(x[4]), math.exp(x[5])])
        return x, covariance * np.outer(units, units)


def _pole(angle: float, damping: float) -> complex:
    return angle * complex(-damping, math.sqrt(max(0.0, 1.0 - damping**2)))
