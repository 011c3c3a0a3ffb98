"""Of long logs a part is fitted, where it speaks for the rest, in little memory."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from estune.core.controller_equation import unlimited_effort
from estune.core.controller_form import ControllerForm
from estune.core.gains import Gains
from estune.core.pidf import ControllerSettings
from estune.loop_model import beginning, linear_past
from estune.loop_model.beginning import best_scale
from estune.loop_model.identification import cold_starts
from estune.loop_model.linear_past import less, orthonormal
from estune.loop_model.margins import robustness
from estune.service_records import fitted_part, replay
from estune.service_records.identification import ServicePart, identify
from estune.service_records.stretches import Stretch

ROWS, MOVES_FROM, CHANGES_AT, WINDOW = 6000, 2000, 4500, 500
GAINS = Gains(1.5, 0.05, 0.0, 0.0)


def loop(change=1.0):
    """A loop of two poles whose setpoint moves late, and whose gain changes later."""
    rng = np.random.default_rng(4)
    noise = 0.002 * rng.standard_normal(ROWS)
    setpoint = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 100), 100)
    setpoint[:MOVES_FROM] = 0.0
    y, u, measured, sums = np.zeros(ROWS), np.zeros(ROWS), np.zeros(ROWS), 0.0
    for k in range(ROWS):
        if k >= 3:
            gain = 0.005 * (change if k >= CHANGES_AT else 1.0)
            y[k] = 1.8 * y[k - 1] - 0.805 * y[k - 2] + gain * u[k - 3]
        measured[k] = y[k] + noise[k]
        sums += 0.05 * (setpoint[k] - measured[k])
        u[k] = 1.5 * (setpoint[k] - measured[k]) + sums
    form = ControllerForm(integral="backward")
    settings = ControllerSettings(1.0, 0.0, -math.inf, math.inf, form)
    stretch = Stretch("log", 0.0, setpoint, measured, u)
    return identify([ServicePart(stretch, GAINS)], settings, 60.0)


@pytest.fixture
def short_windows(monkeypatch):
    monkeypatch.setattr(fitted_part, "SAMPLES", WINDOW)
    monkeypatch.setattr(fitted_part, "SETTLING_TIMES", 0.0)


def test_long_log_is_fitted_where_its_setpoint_moves_and_states_what_all_of_it_does(request):
    whole = loop()
    assert sum(record.samples for record in whole.records) == ROWS
    request.getfixturevalue("short_windows")
    part = loop()
    assert sum(record.samples for record in part.records) == fitted_part.WINDOWS * WINDOW
    assert all(np.ptp(record.setpoint) for record in part.records)
    assert part.span == whole.span
    by_part, by_all = (
        robustness(one.fit.model, GAINS, one.settings).sensitivity for one in (part, whole)
    )
    assert by_part == pytest.approx(by_all, rel=fitted_part.WIDEST)


@pytest.mark.usefixtures("short_windows")
def test_long_log_whose_rest_says_otherwise_is_fitted_whole():
    assert sum(record.samples for record in loop(change=0.5).records) == ROWS


def test_slow_loop_in_many_samples_begins_where_all_of_them_would_begin_it(monkeypatch):
    records = loop().records
    whole = best_scale(records, 1.0, [60.0])
    monkeypatch.setattr(beginning, "THIN_FROM", 0)
    monkeypatch.setattr(beginning, "THIN", 12)
    monkeypatch.setattr(beginning, "HOPELESS", 0.0)  # so that it is not improved
    seen = []
    monkeypatch.setattr(
        beginning, "cold_starts", lambda *of: seen.append(of[0].samples) or cold_starts(*of)
    )
    thinned = best_scale(records, 1.0, [60.0])
    assert seen[0] < ROWS / 4
    assert thinned.power == pytest.approx(whole.power, rel=0.1)


def test_filter_that_ran_is_found_by_the_part_in_which_the_setpoint_moves(monkeypatch):
    random, rows = np.random.default_rng(2), 4000
    setpoint = np.repeat(random.standard_normal(rows // 100), 100)
    setpoint[: rows // 2] = 0.0
    measured = np.convolve(setpoint, np.full(40, 1 / 40))[:rows]
    measured = measured + 0.01 * random.standard_normal(rows)
    own = ControllerSettings(100.0, 0.02, -math.inf, math.inf)
    gains = Gains(2.0, 20.0, 0.1, 0.3)
    effort = unlimited_effort(own, gains, setpoint, measured, first_effort=3.0)
    effort += 1e-3 * random.standard_normal(rows)
    stretch = Stretch("log", 0.0, setpoint, measured, effort)
    monkeypatch.setattr(replay, "SEARCHED", 1000)
    found = replay.replay([stretch], own, replace(gains, setpoint_filter_s=0.0))
    assert found.explained
    assert not found.is_thin
    assert found.ran.as_tuple() == pytest.approx(gains.as_tuple(), rel=0.05)


def test_basis_of_columns_that_hardly_differ_is_that_of_their_decomposition_in_their_memory():
    rng, samples, count = np.random.default_rng(0), 60_000, 40
    columns = rng.standard_normal((samples, count)) * np.geomspace(1e-6, 1e6, count)
    columns[:, -1] = columns[:, -2] + 1e-5 * columns[:, -1]
    values = rng.standard_normal(samples)
    scaled = columns / np.linalg.norm(columns, axis=0)
    U = np.linalg.svd(scaled, full_matrices=False)[0]
    tracemalloc.start()
    basis = orthonormal(samples, iter(columns.T))
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.abs(basis.T @ basis - np.eye(count)).max() < 1e-12
    assert less(values, basis) == pytest.approx(values - U @ (U.T @ values), abs=1e-8)
    # The columns that are not used are room without memory.
    assert held < 8 * samples * linear_past.MOST + columns.nbytes
