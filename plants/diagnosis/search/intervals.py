"""95 % confidence intervals of fitted values by a delete-a-group jackknife.

    s^2 = (G - 1)/G sum_g d_g^2,    d_g = (H - H_g + 1)^-1 J_g^T r_g

J is the derivative of the residuals r by the values in prior deviations, over differences of a
standard error, but a tenth of the value at most, which it begins with. Where a drive sticks,
residuals jump: over a millionth of a value a jump is a slope that tells it to 0.01 %, and what
follows from so small an error hardly grows again (an excess of 0.0105 that came out as 0.00989 was
told to 0.3 %, from a tenth on to 8 %). Where nothing jumps both end in the same. H = J^T J, and g
is one of G groups of entries that belong together: blocks of time, or whole records. Residuals may
have any colour within a group, and a block that alone determines a value counts in full, where the
sandwich of White (1980) has it near zero.

Records are unlike by design, and those that hardly show a value say little of it without the one
that does. Of them d_g^2 counts c_g = min(1/w_g - 1, G - 1) times, in the place of G - 1, with the
share w_g = 1 - (H^-1)_ii/((H - H_g)^-1)_ii of what is known that is due to the record (Busing,
Meijer & van der Leeden 1999), and G is the sum of c_g/(1/w_g - 1).

No machine follows a law exactly, which shifts values in a way that every group shares. A relative
model error f changes a value by at most f sqrt((H^-1)_ii); f is a share of the length of what the
effects explain, and another of the length of what nothing explains. The first is at most that
share of the value itself.

At a bound, and of the shapes of a friction, a derivative says little: residuals jump, and a bend
of next to nothing changes next to nothing. There all values are told that leave a sum of squares
no more above the least than the end of an interval does elsewhere, 1.96^2 (c^2 + l^2), with the
errors of form as lengths l and c^2 the usual ratio of s^2 to (H^-1)_ii.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.interval import Interval
from plants.diagnosis.models.free_parameters import BASE, Free, prior_deviation
from plants.diagnosis.search.model_fitter import CandidateFit, ModelFitter, edges, record_of
from plants.effects import Role
from plants.effects.plant_scale import PlantScale

FIRST_ZERO = "encoder_zero_rad[0]"
"""Zero of the first record's encoder. Phases of waves along a drive are known relative to it; of a
reel they count from where the cable is taut."""


def intervals(
    fitter: ModelFitter, model: CandidateFit, base: CandidateFit, *, along: bool = False
) -> Mapping[str, Interval]:
    """Values and 95 % confidence intervals of all that the records share.

    Phases of waves along a drive are those at the fitted zero of the first record's encoder.

    Args:
        fitter: Model and records.
        model: The model.
        base: The model without effects: of what the effects explain, a share is put down to the
            wrong value where their laws are unlike the machine's.
        along: Whether to go along values at bounds and shapes of frictions.
    """
    at = _about(fitter, model)
    explained, unexplained = (
        math.sqrt(max(power, 0.0) * at.columns.shape[1])
        for power in (base.J - model.J, model.J - 1.0)
    )
    unexplained *= CONSTANTS.form_taken_up if model.effects else CONSTANTS.form_lacking
    form = {e.name: max(e.form_error, CONSTANTS.form_least) for e in model.effects}
    # The hysteresis of a gauge shifts base parameters, above all the torque's gain.
    has_gauge = "tension_N" in fitter.floor.channels
    base_least = CONSTANTS.form_least if has_gauge else CONSTANTS.base_least
    shifts = greatest_shifts(at.columns)
    lengths = {slug: math.hypot(f * explained, unexplained) for slug, f in form.items()}
    alike = _along(model, at, shifts, lengths) if along else at.values[None]
    stated = {}
    for n, f in enumerate(at.free):
        if record_of(f.owner) is not None:
            continue
        value, prior = float(at.values[n]), float(at.prior[n])
        # A limit is neutral far up, a ratio at one: what counts is the nearer of that and zero.
        size = min(abs(value - (f.neutral or 0.0)), abs(value)) / prior
        most, calibrated = (1.0, base_least * size) if f.owner == BASE else (size, 0.0)
        if f.owner == BASE or f.owner in form:
            law = form.get(f.owner, max(form.values(), default=0.0))
            by_law = law * min(explained * shifts[n], most)
        else:  # an effect that the model declares: how much it explains is not known
            by_law = CONSTANTS.form_least * size
        by_rest = min(unexplained * shifts[n], most)
        error = prior * math.hypot(at.noise[n], by_law, by_rest, calibrated)
        low, high = _ends(f, value, CONSTANTS.quantile * error)
        low, high = min(low, *alike[:, n].tolist()), max(high, *alike[:, n].tolist())
        stated[f.name] = Interval(value, low, high, f.unit)
    return stated


class _Local(NamedTuple):
    """A fit's values and its residuals about them; all of shape (values,) but `columns`.

    Attributes:
        moves: Numbers of the values.
        prior: Their prior deviations, in which `noise` and `columns` are.
        noise: Their standard errors by noise.
        columns: Derivative of the residuals, shape (values, entries).
    """

    moves: NDArray[np.int64]
    free: list[Free]
    values: FloatArray
    prior: FloatArray
    noise: FloatArray
    columns: FloatArray


def _about(fitter: ModelFitter, model: CandidateFit) -> _Local:
    """What is known of the values of a fit, by derivatives over differences as large as errors."""
    fitted = model.fitted
    moves = fitter.moves(fitted.predictor)
    # A number that is wrong as an effect says is not wrong besides: both are one.
    held = {effect.base_parameter for effect in model.effects}
    if not PlantScale.of(fitter.model.model).has_cable:
        held.add(FIRST_ZERO)
    moves = moves[[fitted.predictor.free[n].name not in held for n in moves]]
    free = [fitted.predictor.free[n] for n in moves]
    values = fitted.values[moves]
    prior = np.array([prior_deviation(f, v) for f, v in zip(free, values.tolist(), strict=True)])
    leaping = {effect.name for effect in model.effects if not effect.smooth}
    least = np.array([CONSTANTS.leaping if f.owner in leaping else 0.0 for f in free])
    record = fitted.predictor.index.measurement[fitted.entries]
    widest = 0.1
    noise = np.full(values.size, widest)
    for _ in range(3):
        residuals, jacobian = fitted.predictor.linearise(
            fitted.values,
            moves,
            fitted.entries,
            fitted.residuals,
            prior * np.clip(noise, least, widest),
        )
        columns = jacobian.T * prior[:, None]
        noise = np.maximum(
            jackknife(columns, residuals, fitter.group[fitted.entries]),
            jackknife(columns, residuals, record, unequal=True),
        )
    return _Local(moves, free, values, prior, noise, columns)


def _along(
    model: CandidateFit, at: _Local, shifts: FloatArray, lengths: Mapping[str, float]
) -> FloatArray:
    """Rows of values, shape (some, values), that the records allow where a derivative says little.

    Args:
        model: The fit.
        at: Its values.
        shifts: Changes of the values per length of an error.
        lengths: Lengths of the errors of form, by the slugs of the model's effects.
    """
    colour = float(np.median(np.square(at.noise / shifts)))
    shapes = {f"{e.name}.{n}" for e in model.effects if e.resists for n in e.named(Role.SHAPE)}
    alike = [at.values[None]]
    for n, f in enumerate(at.free):
        if f.owner in lengths and (f.name in shapes or edges(f, float(at.values[n]))):
            more = CONSTANTS.quantile**2 * (colour + lengths[f.owner] ** 2)
            alike.append(_consistent(model, at, n, more))
    return np.concatenate(alike)


def _consistent(model: CandidateFit, at: _Local, n: int, more: float) -> FloatArray:
    """Values that leave no more than so much above the least sum of squares, along the nth.

    It is moved from bound to bound, alone and with the others following it by one step of least
    squares, which may go too far where residuals jump.

    Returns:
        Rows of all values, shape (some, values); the fit is one.
    """
    fitted, free, moved = model.fitted, model.fitted.predictor.free, at.moves[n]
    f, value = at.free[n], float(at.values[n])
    away = np.geomspace(1e-6, 1.0, 24)  # values from the fit to a bound
    tried = [
        np.geomspace(value, end, away.size + 1)[1:]
        if f.scale == "log"
        else value + (end - value) * away
        for end in (f.low, f.high)
        if not math.isclose(end, value, rel_tol=1e-6)
    ]
    column = np.concatenate([[value], *tried])
    rows = np.tile(fitted.values, (column.size, 1))
    rows[:, moved] = column
    alone = fitted.predictor.residuals(rows, fitted.entries)
    others, places = np.delete(at.columns, n, axis=0), np.delete(at.moves, n)
    steps = np.linalg.solve(others @ others.T + np.eye(len(others)), others @ alone.T).T
    followed = rows.copy()
    followed[:, places] -= (steps - steps[0]) * np.delete(at.prior, n)
    followed = np.clip(followed, [one.low for one in free], [one.high for one in free])
    after = fitted.predictor.residuals(followed, fitted.entries)
    squares = np.square(np.concatenate([alone, after])).sum(axis=1)
    alike: FloatArray = np.concatenate([rows, followed])[squares <= squares[0] + more]
    return alike[:, at.moves]


def _ends(free: Free, value: float, half: float) -> tuple[float, float]:
    """Both ends of an interval of so much half a width, within the value's bounds."""
    if free.scale == "log" and value > 0.0:
        factor = math.exp(min(half / value, 50.0))  # a value of nearly zero may have any factor
        low, high = value / factor, value * factor
    else:
        low, high = value - half, value + half
    return max(low, free.low), min(high, free.high)


def greatest_shifts(columns: FloatArray) -> FloatArray:
    """Change of each value, in prior deviations, per length of the error that shifts it most.

    Args:
        columns: Derivative of the residuals by the values in prior deviations, (values, entries).
    """
    normal = columns @ columns.T + np.eye(len(columns))
    shifts: FloatArray = np.sqrt(np.diag(np.linalg.inv(normal)))
    return shifts


def jackknife(
    columns: FloatArray,
    residuals: FloatArray,
    group: NDArray[np.int64] | NDArray[np.int32],
    *,
    unequal: bool = False,
) -> FloatArray:
    """Standard errors by leaving out one group at a time, shape (values,).

    Args:
        columns: Derivative of the residuals by the values in prior deviations, (values, entries).
        residuals: Shape (entries,).
        group: Number of each entry's group, same shape.
        unequal: Whether a group counts by the share of what is known that is due to it.
    """
    unit = np.eye(len(columns))
    normal = columns @ columns.T
    groups = np.unique(group)
    of_all = np.diag(np.linalg.inv(normal + unit))
    total, count = np.zeros(len(columns)), np.zeros(len(columns))
    for n in groups:
        of_group = columns[:, group == n]
        of_others = np.linalg.inv(normal - of_group @ of_group.T + unit)
        moved = of_others @ (of_group @ residuals[group == n])
        weight = np.full(len(columns), groups.size - 1.0)
        expected = np.ones(len(columns))
        if unequal:
            known = np.clip(of_all / np.diag(of_others), 1e-12, 1.0 - 1e-12)  # by the others
            weight = np.minimum(known / (1.0 - known), weight)
            expected = weight * (1.0 - known) / known
        total += weight * np.clip(moved, -2.0, 2.0) ** 2
        count += expected
    spread: FloatArray = np.sqrt(total / np.maximum(count, 1e-12))
    return spread
