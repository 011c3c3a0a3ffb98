"""Limits of the records, stated before anything else."""

import math
from collections.abc import Sequence

import numpy as np

from estune.recordings.issue import DataIssue
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise import step_of, upper_rms
from plants.diagnosis.models.free_parameters import BASE, Free
from plants.diagnosis.models.signal_scales import travels
from plants.diagnosis.result import Limitation
from plants.diagnosis.search.model_fitter import CandidateFit, edges
from plants.effects.plant_scale import PlantScale


def limitations(
    measurements: Sequence[MeasuredRecord],
    findings: Sequence[DataIssue],
    last: CandidateFit,
    scale: PlantScale,
) -> tuple[Limitation, ...]:
    """Limits of the records, the gravest first; `last` is the model that is believed."""
    limits = []
    refused = len(_refused(findings))
    if refused:
        finding = f"{refused} of {refused + len(measurements)} records were refused"
        most = most_refused(measurements, findings)
        remedy = f"{finding}; correct them and run again"
        limits.append(Limitation("records_refused", finding, remedy, by_data=most))
    if scale.has_cable:
        limits += _of_tension(measurements)
    limits += [*_of_base(last, scale), *_of_motion(measurements)]
    if scale.has_cable and all(m.angle_rad is None for m in measurements):
        finding = (
            "no record has an angle: effects of cable and gauge cannot be distinguished from "
            "effects of the drum, and the inertia is known only relative to the stiffness given; "
            "record angle_rad"
        )
        limits.append(Limitation("no_encoder", "no encoder", finding))
    first = "base_parameter_moved"
    return tuple(sorted(limits, key=lambda limit: (not limit.by_data, limit.kind != first)))


def _refused(findings: Sequence[DataIssue]) -> set[str]:
    return {f.source for f in findings if f.level == "refused"}


def most_refused(measurements: Sequence[MeasuredRecord], findings: Sequence[DataIssue]) -> bool:
    """Whether more records were refused than are left."""
    return len(_refused(findings)) > len(measurements)


def _of_tension(measurements: Sequence[MeasuredRecord]) -> list[Limitation]:
    tensions = [m.tension_N for m in measurements if m.tension_N is not None]
    if not tensions:
        return []
    # Clearly below, by noises or steps.
    low = np.concatenate([t < -CONSTANTS.clear * max(upper_rms(t), step_of(t)) for t in tensions])
    share = float(np.mean(low))
    if share < CONSTANTS.small**2:
        return []
    finding = f"{share:.0%} of the tensions read are below zero, and a cable cannot push"
    remedy = "check the sign and the zero of tension_N"
    label = "tension below zero"
    return [Limitation("tension_below_zero", label, f"{finding}; {remedy}", by_data=True)]


def has_moved(base: CandidateFit) -> bool:
    """Whether a number of the model came out further from what was given than is believed."""
    return bool(_of_base(base, PlantScale()))


def _of_base(base: CandidateFit, scale: PlantScale) -> list[Limitation]:
    """Numbers of the model that moved; an offset is about zero, and nothing is stated of it."""
    stated = (
        (f, base.values[f.name])
        for f in base.fitted.predictor.free
        if f.owner == BASE and f.start > 0.0 and (f.low >= 0.0 or f.scale == "log")
    )
    limits = (_of_parameter(f, value, scale.name(f.name)) for f, value in stated)
    return [limit for limit in limits if limit is not None]


def _of_parameter(f: Free, value: float, name: str) -> Limitation | None:
    factor = value / f.start
    moved = f"{name} moved to {factor:.2g} times what was given"
    if f.scale == "log" and edges(f, value):
        sentence = f"{moved}, the limit of the fit; check the units and signs of the columns"
        label = f"{name} at its bound"
        return Limitation("base_parameter_at_bound", label, sentence, by_data=True)
    if f.prior is None:
        usual = 2.0 if f.scale == "log" else 5.0  # a friction is often no more than a guess
        if 1.0 / usual < factor < usual:
            return None
        sentence = f"{moved}; check it: it may compensate for an effect that the model lacks"
    else:
        apart, unit = (math.log(factor), 1.0) if f.scale == "log" else (value - f.start, f.start)
        deviations = abs(apart) / f.prior
        if deviations <= CONSTANTS.quantile:
            return None
        known = f"{f.prior / unit:.0%}"
        sentence = f"{moved}, {deviations:.1f} standard deviations of {known}; check it first"
    return Limitation("base_parameter_moved", f"{name} x{factor:.2g}", sentence)


def _of_motion(measurements: Sequence[MeasuredRecord]) -> list[Limitation]:
    angles = [(m.angle_rad, m) for m in measurements if m.angle_rad is not None]
    each = ((*travels(a), m.sampling_Hz) for a, m in angles if a.size > 1)
    moved = np.concatenate([np.zeros(1), *(moved * (rate / span) for moved, span, rate in each)])
    size = float(np.sqrt(np.mean(moved**2)))
    if size == 0.0:
        return []
    limits = []
    going = moved[np.abs(moved) > 0.5 * np.median(np.abs(moved[moved != 0.0]))]
    # A winch motor that is turned one way slips back for 0.05 of the time, by its cogging.
    if min(np.mean(going > 0.0), np.mean(going < 0.0)) < CONSTANTS.small:
        sentence = (
            "all motion is in one direction: dry friction cannot be distinguished from an offset "
            "of the force; record motion both ways"
        )
        limits.append(Limitation("one_direction", "one direction of motion", sentence))
    if np.mean(np.abs(moved) < CONSTANTS.small * size) < CONSTANTS.small**2:
        sentence = (
            "no motion is slow: friction at low speed cannot be identified; record slow motion "
            "and standstill"
        )
        limits.append(Limitation("no_slow_motion", "no slow motion", sentence))
    return limits
