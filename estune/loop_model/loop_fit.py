"""The identified loop: its model, noise and covariance, and what the records leave unexplained."""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.error_filters import whiten
from estune.loop_model.fit_signals import FitSignals, signals_of
from estune.loop_model.identification import PoleFit
from estune.loop_model.least_squares import Solution
from estune.loop_model.model import LoopModel
from estune.loop_model.noise_model import NoiseModel, shaping
from estune.loop_model.records import LoopRecord
from estune.loop_model.whiteness import is_white

T = TypeVar("T")

NORMAL_QUANTILE = 1.96
"""That of 95 % in the middle of a normal distribution."""

RESPONSE_MIN = 10.0
"""Least response in standard deviations of the noise: a trial below 40 is refused as ill-posed."""

NUISANCE = 4
"""Parameters of each record: the start state of two poles, offsets of effort and measurement."""


class LoopFit(NamedTuple):
    """An identified loop.

    Attributes:
        noise: Load and drift against the white noise.
        covariance: Of the model's n real parameters, shape (n, n): white residuals.
        clustered: The same from the scatter between records (sandwich estimate).
        noise_std: Standard deviation of the white noise of the measurement.
        residual_std: Standard deviation of the prediction error.
        misfits: rho of each record, the residual beyond the noise as a share of its span.
        response_peak: Largest deviation of the fitted measurement, as the residual through 1/H.
        unexplained: What the model leaves of the measurement of each record, load and drift in
            it, shape (its samples,); zero where it was not fitted. With poles outside the unit
            circle, through an all-pass.
        errors: Its prediction errors, shape (its samples,).
        left_out: Numbers of the records that the others contradict, and that are not fitted.
        settling_samples: Settling time asked for, which scales the noise model.
        near_error: Error of ln Ms where it is of the trials near some gains alone because no
            linear model explains all; zero of a fit of all.
        strengths: Gain of the plant in each record over the present one, where that is not the
            same in all; else empty.
    """

    model: LoopModel
    noise: NoiseModel
    covariance: FloatArray
    clustered: FloatArray
    noise_std: float
    residual_std: float
    misfits: tuple[float, ...]
    response_peak: float
    unexplained: tuple[FloatArray, ...]
    errors: tuple[FloatArray, ...]
    is_white: bool
    left_out: tuple[int, ...]
    settling_samples: float
    near_error: float = 0.0
    strengths: tuple[float, ...] = ()

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.model.order

    @property
    def responds(self) -> bool:
        """Whether the measurement follows the effort, beyond the noise."""
        return self.response_peak > RESPONSE_MIN * self.error_std

    @property
    def error_std(self) -> float:
        """Standard deviation of the white errors: of the noise, or of what drives its model."""
        return self.noise_std if self.noise.is_white else self.residual_std

    @property
    def is_output_error(self) -> bool:
        """Whether errors are those of the output: not with friction, a load or growing poles."""
        return self.noise.is_white and not (self.model.friction or self.model.grows)

    def fitted(self, of_records: Sequence[T]) -> list[T]:
        """Of one value for each record those of the records that were fitted."""
        return [one for i, one in enumerate(of_records) if i not in self.left_out]

    def signals(self, records: Sequence[LoopRecord]) -> FitSignals:
        """Records as deviations, with as much of the past as the model needs."""
        return signals_of(records, self.settling_samples, self.model.dead_samples)

    def solution(self, signals: FitSignals) -> Solution:
        """The prediction errors of the model, without its friction, on signals."""
        model = self.model
        x, numerator = np.array(model.coordinates), np.array(model.numerator)
        return Solution.at(signals, x, model.dead_samples, self.noise, numerator)

    @property
    def poles(self) -> PoleFit:
        """Its poles, dead time and noise, as a start of another search."""
        model = self.model
        return PoleFit(0.0, np.array(model.coordinates), model.dead_samples, self.noise)

    @property
    def misfit(self) -> float:
        """Root mean square of rho over the records that were fitted."""
        kept = self.fitted(self.misfits)
        return math.sqrt(math.fsum(rho * rho for rho in kept) / len(kept))

    @property
    def model_misfit(self) -> float:
        """Misfit that load and drift do not explain: none where the errors are white."""
        return 0.0 if self.is_white else self.misfit

    @property
    def is_loaded(self) -> bool:
        """Whether a load or a drift explains what the plant does not."""
        return self.is_white and not self.noise.is_white

    def disturbance(self, errors: FloatArray) -> FloatArray:
        """What prediction errors make of noise, load and drift at the output, shape (samples,)."""
        if self.noise.is_white:
            return errors
        H = shaping(self.model.coordinates, self.noise, self.settling_samples)
        return np.asarray(whiten(errors[np.newaxis], H.mirrored, H.zeros)[0] / H.growth)

    @property
    def is_incomplete(self) -> bool:
        """Whether the model leaves more of the records unexplained than their white noise."""
        powers = [float(np.mean(left**2)) for left in self.unexplained if left.size]
        return float(np.mean(powers)) > 2.0 * self.noise_std**2

    @property
    def quantile(self) -> float:
        """Quantile of Student's t for a 95 % interval from the scatter between records."""
        from scipy.special import stdtrit  # noqa: PLC0415  slow to import

        count = len(self.fitted(self.misfits))
        return float(stdtrit(max(count - 1, 1), 0.975))


def model_of(at: Solution, friction: float = 0.0) -> LoopModel:
    """The model of a solution."""
    poles, numerator = tuple(at.coordinates.tolist()), tuple(at.numerator.tolist())
    return LoopModel(poles, numerator, at.dead, friction)


def summarise(
    records: Sequence[LoopRecord],
    signals: FitSignals,
    at: Solution,
    slopes: FloatArray,
    friction: float = 0.0,
) -> LoopFit:
    """The fit of a solution with its covariances and its misfit.

    The slopes are of its residual along the model's real parameters and further ones that all
    records share, shape (residuals of all, parameters).
    """
    model, noise, errors = model_of(at, friction), at.noise, at.residual
    J, n = slopes, model.parameters.size
    weight = np.linalg.norm(J, axis=0)
    # Slopes along logarithms, which alone can be compared, may be nothing but rounding.
    poles = slice(0, model.order)
    weight[poles] = np.maximum(weight[poles], 1e-12 * weight[poles].max())
    weight = np.where(weight > 0.0, weight, 1.0)
    inverse = np.linalg.pinv((J / weight).T @ (J / weight), rcond=1e-12) / np.outer(weight, weight)
    count = max(errors.size - J.shape[1] - NUISANCE * signals.records, 1)
    variance = float(errors @ errors) / count
    scores, unexplained = [], [np.zeros(record.samples) for record in records]
    for number, own in signals.rows():
        left = errors[own]
        scores.append(J[own].T @ left)
        unexplained[number][-left.size :] = left
    meat = np.array(scores)
    # An all-pass apart, which no power shows: with poles outside the unit circle it is not finite.
    growth = math.prod(section.growth for section in model.sections)
    outputs, white_std = [e / growth for e in unexplained], _noise_of(unexplained) / growth
    if not noise.is_white:
        H = shaping(model.coordinates, noise, signals.settling_samples)
        outputs = [whiten(e[np.newaxis], H.mirrored, H.zeros)[0] / H.growth for e in unexplained]
        white_std = math.sqrt(variance / H.gain)
    spans = [record.span for record in records]
    beyond = [
        float(np.mean(left[left.size - _used(left) :] ** 2))
        - _noise_ceiling(white_std**2, _used(left))
        for left in outputs
    ]
    return LoopFit(
        model=model,
        noise=noise,
        covariance=(variance * inverse)[:n, :n],
        clustered=(inverse @ (meat.T @ meat) @ inverse)[:n, :n],
        noise_std=white_std,
        residual_std=math.sqrt(variance),
        response_peak=float(np.abs(at.regressors @ at.numerator).max()),
        misfits=tuple(
            math.sqrt(max(power, 0.0)) / max(abs(span), 1e-300)
            for power, span in zip(beyond, spans, strict=True)
        ),
        unexplained=tuple(outputs),
        errors=tuple(unexplained),
        is_white=is_white(signals, errors),
        left_out=(),
        settling_samples=signals.settling_samples,
    )


def _used(errors: FloatArray) -> int:
    """Samples behind the history, which is zero."""
    return int(errors.size - np.argmax(errors != 0.0))


def _noise_of(unexplained: Sequence[FloatArray]) -> float:
    """Standard deviation of the white noise, from first differences of what is unexplained.

    The response is explained, so all samples of all records serve, and few before a step do not
    matter.
    """
    moves = np.concatenate([np.diff(e[e.size - _used(e) :]) for e in unexplained])
    return float(np.sqrt(np.mean(moves**2) / 2.0)) if moves.size else 0.0


def _noise_ceiling(variance: float, samples: int) -> float:
    """Mean square of noise of this variance that one record exceeds in 2 % of cases."""
    return variance * (1.0 + 2.0 * math.sqrt(2.0 / samples))
