"""Files of a gain schedule: the JSON of a sweep, and a C header for firmware."""

from importlib.metadata import version
from pathlib import Path
from typing import Any

from estune.core.gains import GAIN_NAMES, GAIN_UNITS
from estune.core.schedule import GainCurve, GainSchedule
from estune.errors import InvalidInput
from estune.support.file_limits import parse_json

_ALONG = {"linear": "length_m", "log": "log(length_m)", "inverse": "1 / length_m"}

_HEADER = """\
/* Gain schedule of a motorised cable reel, made by estune {software}.
 *
{equations}
 *
 * with the cable length L from {length_low:g} to {length_high:g} m and the tension T from
 * {tension_low:g} to {tension_high:g} N; beyond, the gains of the nearest end. With the controller
 * of estune_pidf.c, at each sample before estune_pidf_step:
 *
 *     estune_schedule(length_m, tension_N, gains);
 *     estune_pidf_exchange(&reel, gains[0], gains[1], gains[2], gains[3], setpoint, measured);
 *
 * Without double precision, define casadi_real as float before this text.
 */
#ifndef ESTUNE_SCHEDULE_H
#define ESTUNE_SCHEDULE_H

#include <math.h>

#ifndef casadi_real
#define casadi_real double
#endif

/* P, I, D and setpoint_filter_s at a cable length and a tension. */
static void estune_schedule(casadi_real length_m, casadi_real tension_N, casadi_real gains[4]) {{
  if (!(length_m > {length_low!r})) length_m = {length_low!r}; /* not a number, too */
  if (length_m > {length_high!r}) length_m = {length_high!r};
  if (!(tension_N > {tension_low!r})) tension_N = {tension_low!r};
  if (tension_N > {tension_high!r}) tension_N = {tension_high!r};
{assignments}
}}

#endif
"""


def read_schedule(path: Path) -> GainSchedule:
    """Gain schedule of a JSON file: one by itself, or that of a sweep with one law.

    Raises:
        InvalidInput: the file cannot be read, holds no usable schedule, or several laws.
    """
    try:
        return GainSchedule.from_dict(_schedule_in(parse_json(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InvalidInput(f"gain schedule {path}: {why}") from error
    except InvalidInput as error:
        raise InvalidInput(f"gain schedule {path}: {error}") from error


def _schedule_in(stored: Any) -> Any:
    if not isinstance(stored, dict) or "laws" not in stored:
        return stored
    schedules = {name: law.get("schedule") for name, law in stored["laws"].items()}
    if len(schedules) != 1:
        raise InvalidInput(
            f"it holds {len(schedules)} laws ({'; '.join(schedules)}); write the schedule of one "
            "of them to a file of its own"
        )
    return next(iter(schedules.values()))


def schedule_header(schedule: GainSchedule) -> str:
    """The schedule as a C header of one function; C90, no state, no library but `log`."""
    named = tuple(zip(GAIN_NAMES, schedule.curves, strict=True))
    (length_low, length_high), (tension_low, tension_high) = schedule.length_m, schedule.tension_N
    return _HEADER.format(
        software=version("estune"),
        equations="\n".join(f" *     {n} = {curve}   {GAIN_UNITS[n]}" for n, curve in named),
        length_low=length_low,
        length_high=length_high,
        tension_low=tension_low,
        tension_high=tension_high,
        assignments="\n".join(
            f"  gains[{n}] = {_expression(curve)}; /* {name} */"
            for n, (name, curve) in enumerate(named)
        ),
    )


def _expression(curve: GainCurve) -> str:
    """The curve in C, to the last digit."""
    terms = [repr(curve.offset)]
    if curve.form != "constant":
        terms.append(f"{curve.slope!r} * ({_ALONG[curve.form]})")
    if curve.per_newton != 0.0:
        terms.append(f"{curve.per_newton!r} * tension_N")
    return " + ".join(terms)
