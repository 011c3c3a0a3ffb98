"""The form of a rig's controller, from the effort it logged."""

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import product
from typing import NamedTuple, get_args, get_type_hints

import numpy as np

from estune.core.controller_form import OWN_FORM, ControllerForm
from estune.core.pidf import ControllerSettings
from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.trial.description import RigDescription
from estune.trial.loop_records import recomputed_effort
from estune.trial.outcome import Outcome
from estune.trial.records import SATURATED, TrialRecord

REPRODUCED = 0.01
"""Residual of the increments of the effort, as a share of them, up to which a form reproduces the
log. On the reference reel other forms leave 0.3 to 60 %, a log rounded to 0.1 mA 0.4 %."""

EXACT = 1e-4
"""Residual from which on other forms need not be tried: that of a simulated reel is 6e-6."""

FORGOTTEN = 7.0
"""Time constants after which a filter has forgotten all but a thousandth."""

ALIKE = 2.0
"""Ratio of residuals up to which two forms reproduce a log equally well: that with fewer
differences from estune's own is taken."""


def fitted_form(record: TrialRecord, rig: RigDescription) -> ControllerForm | None:
    """The form that reproduces the logged effort of a trial where estune's own does not.

    None where its own does, where no form does, or where the record cannot show it.
    """
    logged = record.controller_A * rig.newtons_per_ampere
    if record.outcome is not Outcome.DONE or (record.flags & SATURATED).any():
        return None
    if not np.isfinite(logged).all() or not np.diff(logged).any():
        return None
    if _residual(record, rig, logged, OWN_FORM).of_all <= EXACT:
        return None
    residuals: dict[ControllerForm, float] = {}
    excluded: set[ControllerForm] = set()  # whatever the filter of the setpoint
    for form in _forms():
        any_filter = replace(form, setpoint_filter=OWN_FORM.setpoint_filter)
        if any_filter not in excluded:
            residuals[form], before = _residual(record, rig, logged, form)
            if before > ALIKE * REPRODUCED:
                excluded.add(any_filter)
    least = min(residuals.values())
    if least > REPRODUCED:
        return None
    found = min(
        (form for form, residual in residuals.items() if residual <= ALIKE * least),
        key=lambda form: (_differences(form), residuals[form]),
    )
    return None if found == OWN_FORM else found


class _Residual(NamedTuple):
    """Root mean square of what a form leaves of the increments of the effort, as a share of them.

    Attributes:
        of_all: Without the samples in which the filter still knows what was before the record.
        before: Of these, those before the setpoint changes; not above that of all.
    """

    of_all: float
    before: float


def _residual(
    record: TrialRecord, rig: RigDescription, logged: FloatArray, form: ControllerForm
) -> _Residual:
    try:
        effort = recomputed_effort(record, rig, 0.0, form)
    except InvalidInput:
        return _Residual(math.inf, math.inf)
    known = known_samples(rig.controller, logged.size)
    moves, left = np.diff(logged)[known], (np.diff(effort) - np.diff(logged))[known]
    size = max(float(np.linalg.norm(moves)), 1e-300)
    before = left[: unfiltered_moves(record, rig.controller)]
    return _Residual(float(np.linalg.norm(left) / size), float(np.linalg.norm(before) / size))


def known_samples(settings: ControllerSettings, samples: int) -> slice:
    """The samples in which the filter has forgotten what was before the record."""
    forgotten = math.ceil(FORGOTTEN * settings.derivative_filter_s * settings.sampling_Hz) + 3
    return slice(min(forgotten, samples // 4), None)


def unfiltered_moves(record: TrialRecord, settings: ControllerSettings) -> int:
    """Number of the first known increments in which no filter of the setpoint has a part."""
    changed = np.flatnonzero(record.setpoint_N != record.setpoint_N[0])
    samples = int(changed[0]) if changed.size else record.setpoint_N.size
    first: int = known_samples(settings, record.setpoint_N.size).start
    return max(0, samples - 1 - first)


def _forms() -> Iterator[ControllerForm]:
    kinds = get_type_hints(ControllerForm)
    for values in product(*(get_args(kinds[field.name]) for field in fields(ControllerForm))):
        yield ControllerForm(*values)


def _differences(form: ControllerForm) -> int:
    return sum(
        getattr(form, field.name) != getattr(OWN_FORM, field.name) for field in fields(form)
    )
