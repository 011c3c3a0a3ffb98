"""Motion of a mass on a spring against dry friction, and the force of it in records.

The first pair of poles is a mass on a spring, of position x and unit gain, and friction takes off
what it can of each step (a proximal step: Moreau, Numerical aspects of the sweeping process,
1999), so that it opposes every motion and sticks exactly:

    x(k+1) = x(k) + s - a f(k),     a f(k) = clip(s, -a F, a F),     a = 1 + a1 + a2
    s = -(1 + a1) x(k) - a2 x(k-1) + a u(k)

A record begins at rest with friction of an unknown size, the same in all.
"""

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estune.core.quantities import FloatArray
from estune.loop_model.compiled import compiled
from estune.loop_model.fit_signals import FitSignals, signals_of
from estune.loop_model.loop_fit import LoopFit
from estune.loop_model.model import LoopModel
from estune.loop_model.noise_model import NoiseModel
from estune.loop_model.poles import sections_of
from estune.loop_model.records import LoopRecord

DIVERGED = 1e9
"""Force in place of one that is not a number, of a mass whose poles are unstable."""


class FrictionMotion(NamedTuple):
    """Records with what the mass needs beside their deviations.

    Attributes:
        rest: Of each group the position before the record less its mean, in N of effort.
        rest_effort: Mean effort before the step.
        scale: Effort that a step needs.
        noise: The noises that there are, and the sizes that a search begins from.
        known: Forces at the last coordinates, by their bytes.
    """

    signals: FitSignals
    records: tuple[LoopRecord, ...]
    rest: tuple[FloatArray, ...]
    rest_effort: float
    scale: float
    poles: int
    noise: NoiseModel
    known: dict[bytes, list[FloatArray]]

    @classmethod
    def of(cls, records: Sequence[LoopRecord], like: LoopFit) -> "FrictionMotion":
        """The motion of records of a plant like an earlier fit."""
        gain = like.model.static_gain
        signals = signals_of(records, like.settling_samples)
        rests = [float(r.measurement[: max(r.step_index, 1)].mean()) for r in records]
        means = [float(r.measurement.mean()) for r in records]
        if any(r.at_rest for r in records):
            means = [float(np.mean(rests))] * len(records)
        return cls(
            signals=signals,
            records=tuple(records),
            rest=tuple(
                np.array([(rests[i] - means[i]) / gain for i in group.members])
                for group in signals.groups
            ),
            rest_effort=float(np.mean([_middle(r) for r in records])),
            scale=abs(records[0].span / gain),
            poles=like.order,
            noise=like.noise,
            known={},
        )

    def split(self, x: FloatArray) -> tuple[FloatArray, float, float]:
        """Poles, F, and the share of it that holds at rest as an area tangent."""
        n = self.poles
        return x[:n], self.scale * abs(float(x[n])), float(x[n + 1])

    def noise_at(self, x: FloatArray) -> NoiseModel:
        """The noise."""
        return self.noise.with_logarithms(x[self.poles + 2 :])


def two_poles(model: LoopModel) -> LoopModel:
    """The model of the first pair alone, with the same gain."""
    if model.order == 2:
        return model
    coordinates = (model.coordinates * 2)[:2] if model.order == 1 else model.coordinates[:2]
    unit = float(sections_of(coordinates)[0].powers[0])
    return LoopModel(coordinates, (model.static_gain * unit, 0.0, 0.0), model.dead_samples)


def _middle(record: LoopRecord) -> float:
    """Effort that the record begins with at rest, else that of its mean measurement."""
    return record.rest_effort if record.at_rest else float(record.effort.mean())


def forces_of(motion: FrictionMotion, coordinates: Sequence[FloatArray]) -> list[FloatArray]:
    """Friction of each group at several coordinates, shape (coordinates, records, samples)."""
    parts = [motion.split(x) for x in coordinates]
    a = np.array([sections_of(poles)[0].taps for poles, *_ in parts])
    friction = np.array([size for _, size, _ in parts])
    held = friction * np.tanh([part[2] for part in parts])
    found = []
    for group, rest in zip(motion.signals.groups, motion.rest, strict=True):
        effort = np.array([motion.records[i].effort for i in group.members])
        start = motion.rest_effort + held[:, np.newaxis] + rest
        found.append(friction_force(effort, a, friction, start))
    return found


def friction_force(
    effort: FloatArray, a: FloatArray, most: FloatArray, rest: FloatArray
) -> FloatArray:
    """Friction on masses on springs, shape (masses, records, samples).

    Args:
        effort: Shape (records, samples).
        a: Denominators of the two poles, shape (masses, 3).
        most: Size of the friction, shape (masses,).
        rest: Position before the first sample, shape (masses, records).
    """
    library = compiled("prediction_errors")
    if library is not None:
        taken = np.empty((*rest.shape, effort.shape[1]))
        arrays = [np.ascontiguousarray(one, float) for one in (effort, a, most, rest)]
        counts = map(ctypes.c_long, taken.shape)
        library.estune_friction(
            *counts, *(ctypes.c_void_p(one.ctypes.data) for one in (*arrays, taken))
        )
        return np.nan_to_num(taken, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
    unit = a.sum(axis=1)[:, np.newaxis]
    # All of one shape and without new arrays, a sample takes a third of the time.
    like = np.ones(rest.shape)
    first, second = -(1.0 + a[:, 1:2]) * like, -a[:, 2:3] * like
    most = unit * most[:, np.newaxis] * like
    least = -most
    pushed = np.ascontiguousarray(np.multiply.outer(effort.T, unit[:, 0]).transpose(0, 2, 1))
    taken = np.empty((effort.shape[1], *rest.shape))
    now, other, step = rest.copy(), rest.copy(), np.empty(rest.shape)  # other is the one before
    with np.errstate(over="ignore", invalid="ignore"):
        for push, off in zip(pushed, taken, strict=True):
            np.multiply(first, now, out=step)
            np.multiply(second, other, out=other)
            np.add(step, other, out=step)
            np.add(step, push, out=step)
            np.maximum(step, least, out=off)
            np.minimum(off, most, out=off)
            np.add(now, step, out=other)
            np.subtract(other, off, out=other)
            now, other = other, now
        taken /= unit
    taken = np.nan_to_num(taken, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
    return taken.transpose(1, 2, 0)


def less_friction(signals: FitSignals, forces: list[FloatArray]) -> FitSignals:
    """The records with the friction taken off their effort."""
    groups = (
        group._replace(effort=group.effort - (force - force[:, :1]))
        for group, force in zip(signals.groups, forces, strict=True)
    )
    return signals._replace(groups=tuple(groups))


def friction_of(model: LoopModel, signals: FitSignals, record: LoopRecord) -> list[FloatArray]:
    """The friction of a model on one record, which begins without any."""
    if not model.friction:
        return [np.zeros((1, record.samples)) for _ in signals.groups]
    a, most = model.sections[0].taps[np.newaxis], np.array([model.friction])
    rest = np.array([[record.rest_effort]])
    return [friction_force(record.effort[np.newaxis], a, most, rest)[0]]
