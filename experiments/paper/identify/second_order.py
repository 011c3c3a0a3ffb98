"""Resonance, damping, gain, dead time and gauge mode fitted to a measured frequency response.

The sampled model of `experiments.paper.second_order` is exact under zero-order hold, so that
neither the hold nor aliasing biases the fit. Weighted by the variances from repeated periods,
least squares is the maximum likelihood estimate, and the inverse of the normal matrix its
covariance (Pintelon & Schoukens, System Identification, 2nd ed., chapters 8 and 9).
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from experiments.paper.identify.estimate import Estimate
from experiments.paper.identify.frequency_response import FrequencyResponse, check_probability
from experiments.paper.identify.second_order_problem import GAUGE_RATIO_MIN, SecondOrderProblem
from experiments.paper.identify.spectra import ComplexArray
from experiments.paper.second_order import GaugeMode, SecondOrder, hooke_constant

MISFIT_P_VALUE = 0.01
"""P-value of the misfit below which the covariance is scaled by the misfit."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SecondOrderFit:
    """A fitted second-order model with confidence intervals."""

    model: SecondOrder  # the fitted model; its gain is in N per unit of the input
    # Of (natural frequency, rad/s; damping; gain; dead time, s), then, if fitted, (gauge natural
    # frequency, rad/s; gauge damping), shape (n, n).
    covariance: FloatArray
    probability: float  # confidence level of the intervals
    quantile: float  # half width of an interval in standard errors
    misfit: float  # reduced chi-square; near one where the model explains the data
    misfit_p_value: float  # p-value of the misfit. Below 1 % the covariance includes the misfit
    frequency_Hz: FloatArray  # fitted lines, shape (lines,)
    # Measured less fitted response, over its standard error, shape (lines,).
    residual: ComplexArray

    def __repr__(self) -> str:
        w, damping = self.natural_frequency_Hz, self.damping
        return f"SecondOrderFit({w}, damping {damping}, misfit {self.misfit:.3g})"

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
        """Estimate of a quantity from its gradient in the fitted quantities."""
        g = np.zeros(len(self.covariance))
        g[: len(slope)] = slope
        error = math.sqrt(float(g @ self.covariance @ g))
        return Estimate.normal(value, error, self.quantile, unit)


def fit_second_order(
    response: FrequencyResponse,
    gauge: GaugeMode | Literal["fit"] | None = "fit",
    probability: float = 0.95,
) -> SecondOrderFit:
    """Fits an underdamped second-order model with dead time to a frequency response.

    Args:
        response: Measured response; its band must hold the resonance with room on both sides.
        gauge: `fit` also fits the gauge mode, which must lie inside the band; a known mode is
            held fixed; None is for a band that ends well below it.
        probability: Confidence level of the intervals.

    Raises:
        InvalidInput: the coherence at the peak is too low, the resonance or the gauge mode lies
            outside the excited band, there are too few lines, or the fit does not converge.
    """
    from scipy.special import chdtrc, ndtri  # noqa: PLC0415  slow to import

    check_probability(probability)
    fitted = gauge == "fit"
    unknowns = 6 if fitted else 4
    lines = response.frequency_Hz.size
    if 2 * lines < 3 * unknowns:
        raise InvalidInput(
            f"{lines} lines are too few for {unknowns} unknowns; excite "
            f"{math.ceil(1.5 * unknowns)} or more: a longer period, a wider band or more points"
        )
    problem = SecondOrderProblem.of(response, gauge if isinstance(gauge, GaugeMode) else None)
    start = problem.start()
    if fitted:
        start = problem.with_gauge(start)
    solution, covariance = problem.solve(start)
    model = problem.model(solution)
    _check_inside(model, response, covariance, fitted=fitted)
    residual = problem.residual(solution)
    squares, freedom = 2.0 * float(np.sum(np.abs(residual) ** 2)), 2 * lines - unknowns
    chance = float(chdtrc(freedom, squares))
    misfit = squares / freedom
    if chance < MISFIT_P_VALUE:
        covariance = covariance * misfit
    return SecondOrderFit(
        model=model,
        covariance=covariance,
        probability=probability,
        quantile=float(ndtri(0.5 + probability / 2.0)),
        misfit=misfit,
        misfit_p_value=chance,
        frequency_Hz=response.frequency_Hz,
        residual=residual,
    )


def _check_inside(
    model: SecondOrder, response: FrequencyResponse, covariance: FloatArray, *, fitted: bool
) -> None:
    """Checks that the band shows the resonance and the gauge mode."""
    first, last = response.frequency_Hz[[0, -1]]
    resonance_Hz = model.natural_frequency_rad_s / (2.0 * math.pi)
    if not first < resonance_Hz < last:
        raise InvalidInput(
            f"the fitted resonance of {resonance_Hz:.4g} Hz lies outside the excited band of "
            f"{first:.3g} to {last:.3g} Hz; move the band so that it holds the resonance"
        )
    if math.sqrt(covariance[1, 1]) > 0.5 * model.damping:
        raise InvalidInput(
            f"the damping ratio is {model.damping:.3g} +- {math.sqrt(covariance[1, 1]):.3g}: not "
            "determined; raise the excitation's peak, measure more periods, or put lines on the "
            "peak"
        )
    if fitted and model.gauge is not None:
        gauge_Hz = model.gauge.natural_frequency_rad_s / (2.0 * math.pi)
        error_Hz = math.sqrt(covariance[4, 4]) / (2.0 * math.pi)
        visible = error_Hz < 0.1 * gauge_Hz and math.sqrt(covariance[5, 5]) < model.gauge.damping
        if not (visible and first < gauge_Hz <= last):
            raise InvalidInput(
                f"no gauge mode is visible between {GAUGE_RATIO_MIN * resonance_Hz:.3g} and "
                f"{last:.3g} Hz (the fit says {gauge_Hz:.3g} +- {error_Hz:.2g} Hz); widen the "
                "band, raise the peak there, give the known mode, or none"
            )
