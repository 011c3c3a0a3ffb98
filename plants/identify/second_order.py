"""Resonance, damping, gain, dead time and gauge mode fitted to a measured frequency response.

The model is the sampled one, `estune.core.second_order`, exact under zero-order hold, so that the
hold is not mistaken for dead time nor the folding near half the sampling rate for a gauge mode.
The fit minimises the squared distance to the measured responses, each over its own variance: with
the variances from repeated periods it is the maximum likelihood estimate, and the inverse of its
normal matrix the estimates' covariance (Pintelon & Schoukens, System Identification, 2nd ed.,
chapters 8 and 9).
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.core.second_order import GaugeMode, SecondOrder, held_response, hooke_constant
from estune.errors import InvalidInput
from plants.identify.frequency_response import FrequencyResponse, check_probability

ComplexArray = NDArray[np.complex128]

LEAST_COHERENCE = 0.8
"""Median over the five lines about the peak: below it the peak may be noise."""
DEAD_TIMES_TRIED = np.arange(0.25, 20.0, 0.5)
"""Samples; the fit starts from the best of them, for a dead time far off winds the phase wrong."""
MISFIT_CHANCE = 0.01
"""Chance of the residuals below which the model is said not to fit, and the intervals widened."""
GAUGE_ABOVE = 4.0
"""A gauge mode is looked for from this many times the resonance on."""


class Estimate(NamedTuple):
    """A number found from data: `value`, its standard error, and the interval `low` to `high`."""

    value: float
    standard_error: float
    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"{self.value:.5g} {self.unit} ({self.low:.5g} to {self.high:.5g})".replace(
            "  ", " "
        )


@dataclass(frozen=True, slots=True, eq=False)
class SecondOrderFit:
    """A second-order model and how well it is known. Intervals hold the truth with `probability`.

    Attributes:
        model: The fitted model; its gain is in N per unit of the input.
        covariance: Of (natural frequency, rad/s; damping; gain; dead time, s), then, if fitted,
            (gauge natural frequency, rad/s; gauge damping), shape (n, n).
        probability: Of the intervals.
        quantile: Half width of an interval in standard errors.
        misfit: Squared residuals over what their variances promise: near one where the model
            explains the data.
        misfit_chance: How likely the noise alone would give as much. Below 1 % the covariance has
            been multiplied by the misfit.
        frequency_Hz: Lines fitted, shape (lines,).
        residual: Measured less fitted response, over its standard error, shape (lines,).
    """

    model: SecondOrder
    covariance: FloatArray
    probability: float
    quantile: float
    misfit: float
    misfit_chance: float
    frequency_Hz: FloatArray
    residual: ComplexArray

    @property
    def natural_frequency_Hz(self) -> Estimate:
        """Undamped natural frequency, Hz."""
        w = self.model.natural_frequency_rad_s
        return self._estimate(w / (2.0 * math.pi), [1.0 / (2.0 * math.pi)], "Hz")

    @property
    def resonance_Hz(self) -> Estimate:
        """Frequency of the response's peak, Hz.

        Raises:
            InvalidInput: the damping is too high for a peak.
        """
        w, zeta = self.model.natural_frequency_rad_s, self.model.damping
        peak = self.model.resonance_rad_s
        slope = [peak / w, -2.0 * zeta * w**2 / peak]
        return self._estimate(
            peak / (2.0 * math.pi), [part / (2.0 * math.pi) for part in slope], "Hz"
        )

    @property
    def damping(self) -> Estimate:
        """Damping ratio."""
        return self._estimate(self.model.damping, [0.0, 1.0], "")

    @property
    def gain(self) -> Estimate:
        """Gain at rest, in N per unit of the input."""
        return self._estimate(self.model.gain, [0.0, 0.0, 1.0], "N/unit")

    @property
    def dead_time_s(self) -> Estimate:
        """Dead time, s; any fraction of a sample."""
        return self._estimate(self.model.dead_time_s, [0.0, 0.0, 0.0, 1.0], "s")

    @property
    def gauge_Hz(self) -> Estimate | None:
        """Natural frequency of the gauge mode, Hz; None where it was not fitted."""
        if self.model.gauge is None or len(self.covariance) < 6:
            return None
        w = self.model.gauge.natural_frequency_rad_s
        return self._estimate(w / (2.0 * math.pi), [*[0.0] * 4, 1.0 / (2.0 * math.pi)], "Hz")

    @property
    def gauge_damping(self) -> Estimate | None:
        """Damping ratio of the gauge mode; None where it was not fitted."""
        if self.model.gauge is None or len(self.covariance) < 6:
            return None
        return self._estimate(self.model.gauge.damping, [*[0.0] * 5, 1.0], "")

    def viscous_friction_Nms(self, inertia_kg_m2: float) -> Estimate:
        """b_m = 2 zeta w J_m for a known inertia, N m s/rad."""
        w, zeta, J = self.model.natural_frequency_rad_s, self.model.damping, inertia_kg_m2
        return self._estimate(2.0 * zeta * w * J, [2.0 * zeta * J, 2.0 * w * J], "N m s/rad")

    def hooke_constant_Nm_rad(self, inertia_kg_m2: float) -> Estimate:
        """k_m by (30) from the resonance and the friction, for a known inertia, N m/rad.

        Raises:
            InvalidInput: the inertia is out of its range, or the damping too high for a peak.
        """
        w = self.model.natural_frequency_rad_s
        friction = self.viscous_friction_Nms(inertia_kg_m2).value
        k = hooke_constant(self.model.resonance_rad_s, inertia_kg_m2, friction)
        # The damping drops out: (30) takes the peak back to J w^2.
        return self._estimate(k, [2.0 * inertia_kg_m2 * w], "N m/rad")

    def _estimate(self, value: float, slope: list[float], unit: str) -> Estimate:
        """The interval of a quantity with this gradient in the fitted ones."""
        g = np.zeros(len(self.covariance))
        g[: len(slope)] = slope
        error = math.sqrt(float(g @ self.covariance @ g))
        half = self.quantile * error
        return Estimate(value, error, value - half, value + half, unit)


def fit_second_order(
    response: FrequencyResponse,
    gauge: GaugeMode | Literal["fit"] | None = "fit",
    probability: float = 0.95,
) -> SecondOrderFit:
    """Fits an underdamped second-order model with dead time to a frequency response.

    Args:
        response: Measured response; its band has to hold the resonance with room on both sides.
        gauge: `fit` finds the gauge mode too, which has to lie inside the band; a known mode is
            held fixed; None leaves it out, for a band that ends well below it.
        probability: Of the confidence intervals.

    Raises:
        InvalidInput: the coherence at the peak is too low, the resonance or the gauge mode lies
            outside the excited band, there are too few lines, or the fit does not converge.
    """
    from scipy.stats import chi2, norm  # noqa: PLC0415  slow to import

    check_probability(probability)
    fitted = gauge == "fit"
    unknowns = 6 if fitted else 4
    lines = response.frequency_Hz.size
    if 2 * lines < 3 * unknowns:
        raise InvalidInput(
            f"{lines} lines are too few for {unknowns} unknowns; excite "
            f"{math.ceil(1.5 * unknowns)} or more: a longer period, a wider band or more points"
        )
    problem = _Problem.of(response, gauge if isinstance(gauge, GaugeMode) else None)
    start = problem.start()
    if fitted:
        start = problem.with_gauge(start)
    solution, covariance = problem.solve(start)
    model = problem.model(solution)
    _check_inside(model, response, covariance, fitted=fitted)
    residual = problem.residual(solution)
    squares, freedom = 2.0 * float(np.sum(np.abs(residual) ** 2)), 2 * lines - unknowns
    chance = float(chi2.sf(squares, freedom))
    misfit = squares / freedom
    if chance < MISFIT_CHANCE:
        covariance = covariance * misfit
    return SecondOrderFit(
        model=model,
        covariance=covariance,
        probability=probability,
        quantile=float(norm.ppf(0.5 + probability / 2.0)),
        misfit=misfit,
        misfit_chance=chance,
        frequency_Hz=response.frequency_Hz,
        residual=residual,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The least-squares problem in (ln w h, ln zeta, gain, dead time/h, ln w_g h, ln zeta_g)."""

    sampling_Hz: float
    frequency_Hz: FloatArray
    theta: FloatArray
    response: ComplexArray
    error: FloatArray
    coherence: FloatArray
    known_gauge: GaugeMode | None

    @classmethod
    def of(cls, response: FrequencyResponse, known_gauge: GaugeMode | None) -> "_Problem":
        error = np.sqrt(response.variance)
        if not (np.isfinite(response.response).all() and np.isfinite(error).all()):
            raise InvalidInput(
                "the frequency response holds a value that is not finite: an excited line had no "
                "input; give the excitation that was run"
            )
        # The mean of one over an estimated variance is too large by this; the weights must not be.
        error = error * np.sqrt(response.degrees / (response.degrees - 2.0))
        # A simulation without noise has no variance; then all lines weigh alike.
        least = 1e-9 * np.abs(response.response).max()
        return cls(
            response.sampling_Hz,
            response.frequency_Hz,
            2.0 * np.pi * response.frequency_Hz / response.sampling_Hz,
            response.response,
            np.maximum(error, least),
            response.coherence,
            known_gauge,
        )

    def below(self, frequency_Hz: float) -> "_Problem":
        """The same on the lines up to a frequency."""
        kept = self.frequency_Hz <= frequency_Hz
        names = ("frequency_Hz", "theta", "response", "error", "coherence")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})

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
        """Unknowns to begin with: the peak's place and height, and the best of many dead times.

        Raises:
            InvalidInput: there is no peak inside the band, or noise hides it.
        """
        size, band = np.abs(self.response), self.frequency_Hz
        # The tallest peak of what stands out of the noise.
        peak = int(np.argmax(np.where(size > 3.0 * self.error, size, 0.0)))
        about = slice(max(0, peak - 2), peak + 3)
        coherence = float(np.median(self.coherence[about]))
        if coherence < LEAST_COHERENCE:
            raise InvalidInput(
                f"coherence is {coherence:.2f} about the peak at {band[peak]:.3g} Hz, below "
                f"{LEAST_COHERENCE}; raise the excitation's peak, or measure more periods"
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
        around = self.below(GAUGE_ABOVE * band[peak])
        x = np.array([math.log(self.theta[peak]), math.log(zeta), gain, 0.0])
        tried = [_with(x, 3, dead_time) for dead_time in DEAD_TIMES_TRIED]
        misfits = [np.sum(np.abs(around.residual(trial)) ** 2) for trial in tried]
        return tried[int(np.argmin(misfits))]

    def with_gauge(self, start: FloatArray) -> FloatArray:
        """The start with a gauge mode, where the response stands highest over the one without.

        Raises:
            InvalidInput: there are no lines where a gauge mode could be.
        """
        resonance_Hz = math.exp(start[0]) * self.sampling_Hz / (2.0 * math.pi)
        begin_Hz = GAUGE_ABOVE * resonance_Hz
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
        """The best unknowns, and the covariance of (w, zeta, gain, dead time, w_g, zeta_g).

        Raises:
            InvalidInput: the fit does not converge, or the data do not fix the unknowns.
        """
        from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

        def residual(x: FloatArray) -> FloatArray:
            return self.residual(x).view(np.float64)

        # Damping up to 0.99; a dead time may not be negative; a frequency stays under folding.
        high = np.array([math.log(math.pi), -0.01, np.inf, np.inf, math.log(math.pi), -0.01])
        low = np.array([-np.inf, math.log(1e-4), -np.inf, 0.0, -np.inf, math.log(1e-4)])
        n = start.size
        found = least_squares(
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
        x, J = found.x, found.jac
        # Each complex response has its variance split over two real parts.
        normal = 2.0 * J.T @ J
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal * np.outer(scale, scale)
        if not found.success or np.linalg.cond(scaled) > 1e12:
            raise InvalidInput(
                f"the fit did not settle on one model ({found.message.rstrip('.')}); widen the "
                "band, raise the excitation's peak, or leave out the gauge mode"
            )
        covariance = np.linalg.inv(scaled) * np.outer(scale, scale)
        fs = self.sampling_Hz
        units = np.array([fs * math.exp(x[0]), math.exp(x[1]), 1.0, 1.0 / fs])
        if n > 4:
            units = np.append(units, [fs * math.exp(x[4]), math.exp(x[5])])
        return x, covariance * np.outer(units, units)


def _check_inside(
    model: SecondOrder, response: FrequencyResponse, covariance: FloatArray, *, fitted: bool
) -> None:
    """Refuses what the band cannot have shown.

    Raises:
        InvalidInput: the resonance or the gauge mode lies outside it, or is not known at all.
    """
    first, last = response.frequency_Hz[[0, -1]]
    found_Hz = model.natural_frequency_rad_s / (2.0 * math.pi)
    if not first < found_Hz < last:
        raise InvalidInput(
            f"the fitted resonance of {found_Hz:.4g} Hz lies outside the excited band of "
            f"{first:.3g} to {last:.3g} Hz; move the band so that it holds the resonance"
        )
    if math.sqrt(covariance[1, 1]) > 0.5 * model.damping:
        raise InvalidInput(
            f"the damping ratio is {model.damping:.3g} +- {math.sqrt(covariance[1, 1]):.3g}: not "
            "known; raise the excitation's peak, measure more periods, or put lines on the peak"
        )
    if fitted and model.gauge is not None:
        gauge_Hz = model.gauge.natural_frequency_rad_s / (2.0 * math.pi)
        error_Hz = math.sqrt(covariance[4, 4]) / (2.0 * math.pi)
        seen = error_Hz < 0.1 * gauge_Hz and math.sqrt(covariance[5, 5]) < model.gauge.damping
        if not (seen and first < gauge_Hz <= last):
            raise InvalidInput(
                f"no gauge mode is seen between {GAUGE_ABOVE * found_Hz:.3g} and {last:.3g} Hz "
                f"(the fit says {gauge_Hz:.3g} +- {error_Hz:.2g} Hz); widen the band, raise the "
                "peak there, give the known mode, or none"
            )


def _pole(angle: float, damping: float) -> complex:
    return angle * complex(-damping, math.sqrt(max(0.0, 1.0 - damping**2)))


def _with(x: FloatArray, index: int, value: float) -> FloatArray:
    changed = x.copy()
    changed[index] = value
    return changed
