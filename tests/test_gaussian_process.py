"""The Gaussian process, its prior, the local fits of its search, each against its definition."""

import math

import numpy as np
import pytest

from estune.core.gains import Gains
from estune.tuners.acquisition import TrustRegion
from estune.tuners.gaussian_process import (
    cost_prior,
    fit_gaussian_process,
    likeliest_noise,
    prior_covariance,
)
from estune.tuners.local_cubic import curvature_matrix, fit_local_cubic, newton_step
from estune.tuners.low_discrepancy import normal_points, simplex, unit_ball_points
from estune.tuners.remaining_improvement import sample_quadratics
from estune.tuners.search_space import SearchSpace
from tests.test_safe_bayesian import CURVATURE, SPACE


def test_gaussian_process_is_the_posterior_of_its_prior():
    draws = np.random.default_rng(15)
    points, queries, values = (
        draws.normal(size=(8, 3)),
        draws.normal(size=(5, 3)),
        draws.normal(size=8),
    )

    prior = cost_prior(((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)))

    def k(a, b):  # independent implementation of the covariance, point by point
        slopes = (a @ prior.slope) @ (b @ prior.slope)
        quadratic = ((a @ prior.quadratic) @ (b @ prior.quadratic)) ** 2
        apart = np.sum(((a - b) @ prior.inverse_length) ** 2)
        return 4.0 + slopes + quadratic + prior.remainder_sd**2 * math.exp(-0.5 * apart)

    def K(rows, right):
        return np.array([[k(a, b) for b in right] for a in rows])

    def m(x):
        return np.array([0.5 * row @ prior.mean_rise @ row for row in x])

    gain = np.linalg.solve(K(points, points) + 0.01 * np.eye(8), K(points, queries)).T
    mean, spread = fit_gaussian_process(points, values[:, None], 0.1, prior).predict(queries)
    assert mean[:, 0] == pytest.approx(m(queries) + gain @ (values - m(points)))
    assert spread**2 == pytest.approx(np.diag(K(queries, queries) - gain @ K(points, queries)))


@pytest.mark.parametrize("noise", [0.015, 0.03, 0.085])
def test_likeliest_noise_is_near_that_of_costs_drawn_from_the_prior(noise):
    prior, random = cost_prior(SPACE.directions), np.random.default_rng(7)
    found = []
    for _ in range(8):
        points = 0.4 * random.normal(size=(24, 4))
        covariance = prior_covariance(prior, points, points) + 1e-9 * np.eye(24)
        smooth = np.linalg.cholesky(covariance) @ random.normal(size=24)
        mean = 0.5 * np.sum((points @ prior.mean_rise) * points, axis=1)
        values = (mean + smooth + noise * random.normal(size=24))[:, np.newaxis]
        found.append(likeliest_noise(points, values, prior))
    assert 0.5 < np.median(found) / noise < 2.0


def test_cost_prior_agrees_between_forms_and_parameter_subsets():
    gains = Gains(0.5, 10.0, 0.005, 0.02)
    parallel = cost_prior(SearchSpace.around(gains).directions)
    standard = cost_prior(SearchSpace.around(gains, form="standard").directions)
    draws = np.random.default_rng(18)
    a, b = draws.normal(size=(2, 6, 4))  # logarithms of K, Ti, Td and the time constant

    def in_parallel(x):
        return np.stack((x[:, 0], x[:, 0] - x[:, 1], x[:, 0] + x[:, 2], x[:, 3]), axis=1)

    same = prior_covariance(parallel, in_parallel(a), in_parallel(b))
    assert prior_covariance(standard, a, b) == pytest.approx(same)
    few = np.array([[0.3, 0.0, -0.2, 0.0], [0.1, 0.0, 0.4, 0.0]])
    names, start = ("P", "D"), (0.5, 0.005)
    space = SearchSpace(names, start, (0.1, 0.001), (5.0, 0.05), fixed=(("I", 10.0),))
    fewer = prior_covariance(cost_prior(space.directions), few[:, ::2], few[:, ::2])
    assert fewer == pytest.approx(prior_covariance(parallel, few, few))


def test_local_cubic_recovers_a_cubic_with_drift():
    draws = np.random.default_rng(16)
    points = 0.5 * draws.normal(size=(300, 2))
    x, y = points.T
    age = np.arange(299.0, -1.0, -1.0) / 100.0
    values = 0.2 + 0.1 * x - 0.3 * y + 0.5 * x * x + 0.2 * x * y + 0.1 * y**3 - 0.03 * age
    fit = fit_local_cubic(
        np.zeros(2), np.eye(2), points, values[:, None], noise=1e-3, prior_curvature=np.eye(2)
    )
    assert fit.log_cost == pytest.approx(0.2, abs=1e-3)
    assert fit.slope == pytest.approx([0.1, -0.3], abs=2e-3)
    curvature = curvature_matrix(fit.coefficients[3:6, 0], 2)
    assert curvature == pytest.approx(np.array([[1.0, 0.2], [0.2, 0.0]]), abs=1e-2)


def test_quadratic_samples_have_their_minima_at_zero_slope():
    draws = np.random.default_rng(17)
    points = 0.4 * draws.normal(size=(200, 2))
    values = 0.5 * np.sum((points - (0.1, -0.2)) ** 2 * (1.0, 2.0), axis=1)
    fit = fit_local_cubic(
        np.zeros(2), np.eye(2), points, values[:, None], noise=1e-4, prior_curvature=np.eye(2)
    )
    far = np.full(2, 5.0)
    samples = sample_quadratics(fit, TrustRegion(np.zeros(2), np.eye(2), 1.0, -far, far, 1.0, 0.0))
    assert np.mean(samples.minima, axis=0) == pytest.approx([0.1, -0.2], abs=0.02)
    assert np.mean(samples.improvement) == pytest.approx(0.5 * (0.01 + 2 * 0.04), rel=0.1)


def test_newton_step_is_exact_within_the_radius_and_clipped_beyond():
    values, axes = np.linalg.eigh(CURVATURE)
    slope = np.array([0.1, -0.2, 0.05, 0.3])
    whole = -np.linalg.solve(CURVATURE, slope)
    assert newton_step(slope, values, axes, 100.0) == pytest.approx(whole)
    short = newton_step(slope, values, axes, 0.1)
    assert np.linalg.norm(short) == pytest.approx(0.1, rel=1e-6)
    # On the sphere the slope is parallel to the step; otherwise a rotation would lower the cost.
    downhill = -(slope + CURVATURE @ short)
    assert downhill / np.linalg.norm(downhill) == pytest.approx(short / 0.1, abs=1e-6)


def test_low_discrepancy_points_have_the_moments_of_their_distribution():
    for n in (1, 2, 4, 6):
        corners = simplex(n)
        assert np.linalg.norm(corners, axis=1) == pytest.approx(np.ones(n + 1))
        assert corners.sum(axis=0) == pytest.approx(np.zeros(n), abs=1e-12)
        filled = np.linalg.norm(unit_ball_points(n, 1024), axis=1)
        assert np.mean(filled**n < 0.5) == pytest.approx(0.5, abs=0.02)
        assert unit_ball_points(n, 1024).mean(axis=0) == pytest.approx(np.zeros(n), abs=0.03)
        points = normal_points(n, 1024)
        assert points.T @ points / 1024 == pytest.approx(np.eye(n))
        assert np.mean(np.abs(points) < 0.6745) == pytest.approx(0.5, abs=0.02)
