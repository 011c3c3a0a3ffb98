"""What these records cannot tell, said before anything else."""

import math
from collections.abc import Sequence

import numpy as np

from plants.diagnosis.data.measured_record import DataIssue, MeasuredRecord
from plants.diagnosis.result import Limitation
from plants.diagnosis.search.model_fitter import CandidateFit

ONE_WAY, SLOW, MOVED, EDGE = 0.02, 0.01, 2.0, 1e-3
"""Share of the travel against the main direction; share of the samples below a tenth of the rms
velocity; factor by which a base number moves; distance from a bound, relative."""


def limitations(
    measurements: Sequence[MeasuredRecord], findings: Sequence[DataIssue], base: CandidateFit
) -> tuple[Limitation, ...]:
    """What the records cannot tell, the gravest first."""
    found = []
    refused = len({f.source for f in findings if f.level == "refused"})
    if refused:
        of = refused + len(measurements)
        found.append(
            Limitation(
                "records_refused",
                f"{refused} of {of} records were refused; correct them and run again",
            )
        )
    found += [*_of_base(base), *_of_motion(measurements)]
    if not any(m.angle_rad is not None for m in measurements) and any(
        m.cable_length_m for m in measurements
    ):
        found.append(
            Limitation(
                "no_encoder",
                "no record has an angle: effects of cable and gauge cannot be told from effects "
                "of the drum, nor the drum's inertia but by the stiffness given; record angle_rad",
            )
        )
    return tuple(found)


def most_refused(measurements: Sequence[MeasuredRecord], findings: Sequence[DataIssue]) -> bool:
    """Whether more records were refused than are left."""
    return len({f.source for f in findings if f.level == "refused"}) > len(measurements)


def _of_base(base: CandidateFit) -> list[Limitation]:
    found = []
    for f in base.fitted.predictor.free:
        value = base.values[f.name]
        if f.owner != "base" or f.scale != "log" or not f.start:
            continue
        factor = value / f.start
        if min(value / f.low, f.high / value) < 1.0 + EDGE:
            found.append(
                Limitation(
                    "base_parameter_at_bound",
                    f"{f.name} moved to {factor:.3g} times what was given, as far as it may; "
                    "check the units and signs of the columns",
                )
            )
        elif abs(math.log(factor)) > math.log(MOVED):
            found.append(
                Limitation(
                    "base_parameter_moved",
                    f"{f.name} moved to {factor:.2g} times what was given; check it, for it may "
                    "make up for what is missing",
                )
            )
    return found


def _of_motion(measurements: Sequence[MeasuredRecord]) -> list[Limitation]:
    velocities = [
        (m.angle_rad[span:] - m.angle_rad[:-span])
        for m in measurements
        if m.angle_rad is not None and m.samples > 16
        for span in [8]
    ]
    if not velocities:
        return []
    moved = np.concatenate(velocities)
    size = float(np.sqrt(np.mean(moved**2)))
    if size == 0.0:
        return []
    found = []
    forward, backward = float(moved[moved > 0].sum()), -float(moved[moved < 0].sum())
    if min(forward, backward) < ONE_WAY * max(forward, backward):
        found.append(
            Limitation(
                "one_direction",
                "all motion is in one direction: dry friction cannot be told from an offset of "
                "the force; record motion both ways",
            )
        )
    if np.mean(np.abs(moved) < 0.1 * size) < SLOW:
        found.append(
            Limitation(
                "no_slow_motion",
                "nothing moves slowly: friction at low speed cannot be told; record slow motion "
                "and standstill",
            )
        )
    return found
