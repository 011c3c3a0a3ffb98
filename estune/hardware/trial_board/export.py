"""The files of a trial board's program, with the limits of a rig's file."""

import math
from pathlib import Path

from estune.errors import InvalidInput
from estune.hardware.compensation.plan import CompensationTerms
from estune.hardware.compensation.source import hybrid_source
from estune.hardware.config import RigConfig
from estune.hardware.firmware import COEFFICIENTS

PROGRAM = Path(__file__).with_name("estune_trial_board.c")

_COLUMNS, _TERMS = 3, len(CompensationTerms._fields)
"""Numbers of a sample in the record, and of its compensations; beside setpoint and flags."""

_TEXT = """\
/* The limits of {name}, from its rig file; change them there. N, rad, samples at {rate:g} Hz.
 *
 * Setpoints and record take {kilobytes:.0f} kB of memory, {row} bytes for each sample of the
 * longest trial (limits.duration_max_s); half of it with estune_stored defined as float. */
"""


def board_files(config: RigConfig) -> dict[str, str]:
    """The files of the program by name; only estune_trial_board.c is compiled.

    Args:
        config: The rig. Calibrations are the board's own; all else is taken from here.

    Raises:
        InvalidInput: it is no reel: the program takes a cable up.
    """
    return {
        "estune_pidf.c": config.plan().controller,
        "estune_board.h": _header(config),
        "estune_trial_board.c": PROGRAM.read_text(encoding="utf-8"),
        **compensation_files(config),
    }


def compensation_files(config: RigConfig) -> dict[str, str]:
    """Options of a rig's file beside the controller: compensations, hybrid control."""
    plan, files = config.plan(), dict[str, str]()
    if plan.compensation:
        files["estune_compensation.c"] = plan.compensation_source
    if config.hybrid:
        files["estune_hybrid.c"] = hybrid_source(config.hybrid.rules, config.hybrid.position.gains)
    return files


def _header(config: RigConfig) -> str:
    rate, motion, guard = config.sampling_Hz, config.motion, config.guard
    settings, newtons = config.settings(), config.newtons_per_ampere
    if motion.take_up_A is None or motion.taut_N is None:
        raise InvalidInput(
            "a board's program takes a cable up; give motion.take_up_A and motion.taut_N"
        )
    values: dict[str, float | int] = {
        "COEFFICIENTS": COEFFICIENTS,
        "CAPACITY": config.capacity,
        "TENSION_GUARD": guard.tension_max_N,
        "TRAVEL_GUARD": guard.travel_max_rad,
        "SILENCE": math.ceil(guard.heartbeat_s * rate),
        "EFFORT_MIN": settings.output_min_N,
        "EFFORT_MAX": settings.output_max_N,
        "HOLD": config.hold_N,
        "RATE": motion.rate_N_s / rate,
        "SETTLE_N": motion.settle_N,
        "SETTLE": math.ceil(motion.settle_s * rate),
        "SETTLE_WITHIN": math.ceil(motion.settle_within_s * rate),
        "TAKE_UP": motion.take_up_A * newtons,
        "TAKE_UP_WITHIN": math.ceil(motion.take_up_s * rate),
        "TAUT": motion.taut_N,
        "RAMP": max(1, math.ceil(config.safe.ramp_s * rate)),
    }
    lines = (f"#define ESTUNE_{name} {value!r}" for name, value in values.items())
    row = 8 * (2 + _COLUMNS + (_TERMS if config.compensation else 0))
    kilobytes = 1e-3 * config.capacity * row
    text = (
        _TEXT.format(name=config.name, rate=rate, kilobytes=kilobytes, row=row)
        + "\n".join(lines)
        + "\n"
    )
    return text + "#define ESTUNE_COMPENSATED\n" * (config.compensation is not None)
