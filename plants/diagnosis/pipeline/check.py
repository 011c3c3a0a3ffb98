"""Step 2: records that no model could explain are refused, each with the reason."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from estune.errors import InvalidInput
from estune.recordings.issue import DataIssue, refusals
from plants.diagnosis.checks.quality import issues
from plants.diagnosis.checks.sign import reversed_signs
from plants.diagnosis.constants import CONSTANTS
from plants.diagnosis.data.measured_record import MeasuredRecord
from plants.diagnosis.data.noise import step_of
from plants.diagnosis.data.records import FolderContents
from plants.diagnosis.models.base import BaseNumbers
from plants.effects.plant_scale import PlantScale


def check(logged: FolderContents, model: Any) -> FolderContents:
    """The measurements that can be used, with the issues of the files and of the data.

    Of a model that has no numbers only what needs no model is checked.

    Raises:
        InvalidInput: none is left; the message says why for each.
    """
    kept, listed = _of_one_rig(logged.measurements)
    kept, short = _long_enough(kept)
    listed += short
    rate_Hz = PlantScale.of(model).sampling_Hz
    # A record in which the drum hardly turns does not show the encoder's step.
    step_rad = max((step_of(m.angle_rad) for m in kept if m.angle_rad is not None), default=0.0)
    usable = []
    numbers = [BaseNumbers.of(model, m) for m in kept]
    for m, b, sign in zip(kept, numbers, reversed_signs(kept, numbers), strict=True):
        of_record = issues(m, b, rate_Hz, step_rad, sign)
        own = [replace(issue, source=m.source or m.name) for issue in of_record]
        listed += own
        if not any(issue.level == "refused" for issue in own):
            usable.append(m)
    if not usable:
        raise InvalidInput(f"no record can be used: {refusals(listed) or 'there is none'}")
    return FolderContents(tuple(usable), (*logged.findings, *listed))


def _long_enough(
    measurements: Sequence[MeasuredRecord],
) -> tuple[list[MeasuredRecord], list[DataIssue]]:
    """The records but parts between gaps that are too short; these are told once for each file."""
    parts: dict[str, list[MeasuredRecord]] = defaultdict(list)
    for m in measurements:
        parts[m.file].append(m)
    short = {
        source: [m for m in of_file if m.samples < CONSTANTS.fewest]
        for source, of_file in parts.items()
        if len(of_file) > 1
    }
    issues = [
        DataIssue(
            "refused" if len(few) == len(parts[source]) else "warning",
            f"{len(few)} of {len(parts[source])} parts between gaps are shorter than "
            f"{CONSTANTS.fewest:g} samples and left out; record without gaps",
            "time_s",
            source=source,
        )
        for source, few in short.items()
        if few
    ]
    left_out = {id(m) for few in short.values() for m in few}
    return [m for m in measurements if id(m) not in left_out], issues


def _of_one_rig(
    measurements: Sequence[MeasuredRecord],
) -> tuple[list[MeasuredRecord], list[DataIssue]]:
    """The records of the rig with most of them, by time; those without a name go with any."""
    duration_s: dict[str, float] = defaultdict(float)
    for m in measurements:
        duration_s[m.rig] += m.duration_s if m.rig else 0.0
    rig = max(duration_s, key=lambda name: duration_s[name], default="")
    others = [m for m in measurements if rig and m.rig not in ("", rig)]
    issues = [
        DataIssue(
            "refused",
            f"this is a record of {m.rig!r} among those of {rig!r}; give one rig's at a time",
            source=m.source or m.name,
        )
        for m in others
    ]
    return [m for m in measurements if m not in others], issues
