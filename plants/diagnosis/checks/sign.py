"""Columns whose sign is the other one: what the command drives then moves against it."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.recordings.issue import DataIssue
from plants.diagnosis.checks.units import torque_terms
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.smoothing import Smoother, proportion
from plants.diagnosis.models.base import BaseNumbers

Parts = list[NDArray[np.intp]]


def reversed_signs(
    measurements: Sequence[MeasuredRecord], numbers: Sequence[BaseNumbers | None]
) -> list[DataIssue | None]:
    """The issue of each record whose sign is reversed.

    Records of one rig have one sign: where some say that it is reversed and none says the
    contrary, those that say nothing are refused, too.
    """
    columns = _of_files(
        measurements,
        [reversed_column(*pair) for pair in zip(measurements, numbers, strict=True)],
    )
    why = "it moves the other way than the model says"
    issues = [None if name is None else _issue(name, why) for name in columns]
    names = {name for name in columns if name is not None}
    if len(names) != 1:
        return issues
    (name,) = names
    uses = [name in (m.command_column, *m.outputs) for m in measurements]
    for m, b, column, used in zip(measurements, numbers, columns, uses, strict=True):
        if used and column is None and reversed_column(_turned(m, name), b) == name:
            return issues
    shown = measurements[columns.index(name)]
    other = _issue(name, f"its sign is not to be seen here, but in {shown.source or shown.name}")
    return [issue or (other if used else None) for issue, used in zip(issues, uses, strict=True)]


def _of_files(
    measurements: Sequence[MeasuredRecord], columns: Sequence[str | None]
) -> list[str | None]:
    """The columns, without those of parts between gaps that are the lesser part of their file."""
    said: dict[tuple[str, str | None], float] = defaultdict(float)
    whole: dict[str, float] = defaultdict(float)
    for m, name in zip(measurements, columns, strict=True):
        said[m.file, name] += m.duration_s
        whole[m.file] += m.duration_s
    return [
        name if said[m.file, name] > 0.5 * whole[m.file] else None
        for m, name in zip(measurements, columns, strict=True)
    ]


def reversed_column(m: MeasuredRecord, b: BaseNumbers | None) -> str | None:
    """The column of the other sign, where each part of a record says so; None otherwise."""
    if b is None or b.linear is not None or (m.angle_rad is None and m.tension_N is None):
        return None
    smoother = Smoother.slow(m.duration_s, m.sampling_Hz)
    effort = smoother.held(
        m.command_A(b.newtons_per_ampere) * b.newtons_per_ampere, b.dead_time_s, 1.0
    )
    if b.is_free:
        back = m.angle_rad is not None and _brakes(m.angle_rad, effort, b, smoother)
        return m.command_column if back else None
    pull = None if m.tension_N is None else smoother.sampled(m.tension_N, 1.0)
    if m.angle_rad is None:
        return m.command_column if pull is not None and _falls(effort, pull) else None
    turned = smoother.sampled(m.angle_rad, b.tension_per_angle_N_rad)
    if pull is None:
        return m.command_column if _falls(turned, effort) else None
    by_angle, by_effort = _falls(turned, pull), _falls(effort, pull)
    if by_angle:
        return "tension_N" if by_effort else "angle_rad"
    return m.command_column if by_effort else None


def _turned(m: MeasuredRecord, name: str) -> MeasuredRecord:
    turned: dict[str, Any] = {name: -np.asarray(m.channel(name))}
    return replace(m, **turned)


def _issue(column: str, why: str) -> DataIssue:
    remedy = f"change the sign of {column} or of what it moves"
    return DataIssue("refused", f"{why}: its sign seems to be reversed; {remedy}", column)


def _parts(known: NDArray[np.intp], moving: FloatArray) -> Parts:
    """A record, and those of its quarters that move: one that rests says nothing of a sign."""
    if not known.size:
        return []
    least = CONSTANTS.small * float(moving[known].std())
    quarters = np.array_split(known, 4)
    return [known, *(part for part in quarters if part.size and moving[part].std() >= least)]


def _falls(x: FloatArray, y: FloatArray) -> bool:
    """Whether y falls as x rises in each part of a record that says anything.

    Friction holds what the effort does not overcome: while y moves by less than half of what x
    should move it, a falling y may be noise that a controller answers, or creep.
    """
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    fits = [proportion(x[part], y[part]) for part in _parts(known, y)]
    said = [slope for slope, share in fits if share > 0.5]
    return bool(said) and fits[0][1] > 0.5 and said[0] < -0.5 and max(said) < 0.0


def _brakes(angle_rad: FloatArray, effort: FloatArray, b: BaseNumbers, smoother: Smoother) -> bool:
    """Whether an effort explains the motion of a free drum by an inertia and friction below zero.

    A load that drives the motor, a cogging torque or a record that begins in motion may make one
    of them negative, but not both, and gravity of a link both; so it is beside them, the inertia
    has to have the size of the model's, they have to explain half of what gravity leaves, and each
    part of the record has to say so. Motion in one direction cannot tell friction from an offset:
    such a part says nothing.
    """
    terms = torque_terms(angle_rad, smoother)
    velocity = terms[:, 1]
    known = np.flatnonzero(np.isfinite(terms).all(axis=1) & np.isfinite(effort))
    said = []
    for part in _parts(known, velocity):
        v = velocity[part]
        if part.size > terms.shape[1] and min(np.mean(v > 0), np.mean(v < 0)) >= CONSTANTS.small:
            sizes, left = _fit(terms[part], effort[part])
            a, viscous, dry, *_ = sizes
            times = -a * b.drum_radius_m / b.drum_inertia_kg_m2
            of_size = 1.0 / CONSTANTS.range < times < CONSTANTS.range
            explained = left < CONSTANTS.law_left * _fit(terms[part, 3:], effort[part])[1]
            brakes = np.mean(viscous * v**2 + dry * np.abs(v)) < 0.0
            said.append(bool(of_size and explained and brakes))
    return bool(said) and all(said)


def _fit(terms: FloatArray, effort: FloatArray) -> tuple[FloatArray, float]:
    """Sizes of terms by least squares, and the power that they leave."""
    sizes = np.asarray(np.linalg.lstsq(terms, effort, rcond=1e-9)[0], np.float64)
    return sizes, float(np.mean(np.square(effort - terms @ sizes)))
