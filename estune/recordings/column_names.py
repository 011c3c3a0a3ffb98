"""Column names and their units: known names, and advice on near misses."""

import difflib

from estune.recordings.units import UNITS, find_unit

TABLE_COLUMNS = (
    "time_s",
    "setpoint_N",
    "current_A",
    "tension_N",
    "angle_rad",
    "reference_N",
    "flags",
)

MEASURED = ("tension_N", "angle_rad", "reference_N")
"""Columns that a sensor measures; the others are commands, held until the next."""

SYNONYMS = {
    "input": "current_A",
    "torque": "current_A",
    "force": "current_A",
    "output": "tension_N",
    "position": "angle_rad",
}
"""What the columns are called on machines that are no reel: a plant, a motor or a carriage."""

METADATA = (
    "rig",
    "trial_id",
    "sampling_Hz",
    "cable_length_m",
    "preload_N",
    "loop",
    "gains",
    "profile",
)
"""The metadata that a record uses."""

SIMILAR = 0.75
"""Similarity of two names (difflib's ratio) from which one is taken for a misspelling."""
SIMILAR_RARE = 0.85
"""That of the columns that most records do not have."""
_RARE = ("reference_N", "flags")


def suggest_name(name: str, present: frozenset[str], known: tuple[str, ...]) -> str | None:
    """The remedy for an unknown name that resembles a known one.

    Returns:
        A sentence, or None where the name is known, or means something else.
    """
    if name in known:
        return None
    stem, _, unit = name.rpartition("_")
    for meant in known:
        meant_stem, _, meant_unit = meant.rpartition("_")
        if meant in present or not meant_stem:
            continue
        if stem.lower() == meant_stem and unit.lower() != meant_unit.lower():
            other = find_unit(unit)
            scale = f"multiplied by {UNITS[other].factor:.7g}" if other else "converted"
            return (
                f"{name} is in another unit; give it {scale} under the name {meant}, or "
                f"--map {meant_stem}={name} --unit {meant_stem}={unit}"
            )
        if name.lower() in (meant_stem, meant.lower()):
            return f"did you mean {meant}? rename it if it is in {meant_unit}"
    for rare, least in ((False, SIMILAR), (True, SIMILAR_RARE)):
        missing = {m.lower(): m for m in known if m not in present and (m in _RARE) == rare}
        near = difflib.get_close_matches(name.lower(), missing, 1, least)
        if near:
            return f"did you mean {missing[near[0]]}? rename it"
    return None
