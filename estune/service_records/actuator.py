"""Whether the identified loop leaves room for a sticking actuator.

The judge of causes knows no gains, and takes a setpoint filter or a controller of another form for
an actuator that sticks. The identified plant tells how far such an actuator would move the
measurement, and what the loop leaves of the measurement is all that it may have moved it by.
"""

import numpy as np

from estune.core.filtering import lfilter
from estune.core.quantities import FloatArray
from estune.loop_model.model import LoopModel, plant_polynomials
from estune.loop_model.records import LoopRecord
from estune.service_records.cause.valve import Valve, positions
from estune.service_records.identification import ServiceLoop

ROOM = 0.27
"""Least of what the loop leaves over what the actuator would move, root mean squares. It is 0.43
to 1.8 in twelve simulated loops that stick and whose setpoint moves, and 0.04 to 0.16 in six
that do not and were called so."""


def may_stick(loop: ServiceLoop, valve: Valve) -> bool:
    """Whether what a loop leaves of the measurement is as large as an actuator's share of it."""
    fit, records = loop.fit, loop.records
    kept = [(r, left) for r, left in zip(records, fit.unexplained, strict=True) if left.any()]
    moved = np.concatenate([_moved(fit.model, record, left, valve) for record, left in kept])
    left = np.concatenate([_level(left[np.flatnonzero(left)[0] :]) for _, left in kept])
    return bool(np.linalg.norm(left) >= ROOM * np.linalg.norm(moved))


def _moved(model: LoopModel, record: LoopRecord, left: FloatArray, valve: Valve) -> FloatArray:
    """What the actuator moves the measurement by, where the fit left something."""
    A, B = plant_polynomials(model)
    away = positions(record.effort, [valve])[:, 0] - record.effort
    return _level(lfilter(B, A, away - away.mean())[np.flatnonzero(left)[0] :])


def _level(signal: FloatArray) -> FloatArray:
    """A signal without its parabola: a slow plant's start and offset are free."""
    basis, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, signal.size), 3))
    return np.asarray(signal - basis @ (basis.T @ signal))
