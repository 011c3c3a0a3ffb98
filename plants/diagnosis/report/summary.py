"""A diagnosis as text: the heading, tables of strings, and JSON."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

from plants.effects import EFFECTS
from plants.effects.plant_scale import digits, si

if TYPE_CHECKING:  # a diagnosis is built on this
    from plants.diagnosis.report.diagnosis import Diagnosis, Interval

_HEADINGS = {
    "named": "NAMED",
    "incomplete": "NAMED, BUT INCOMPLETE",
    "ambiguous": "AMBIGUOUS",
    "unknown": "UNKNOWN",
    "none": "NONE",
}


_MOST_PLACES = 7
"""Decimals beyond which a number is told with an exponent."""


class Table(NamedTuple):
    """A table of strings; numbers are told with their units.

    Attributes:
        columns: Heads of the columns.
        rows: Its cells, row by row.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def heading(d: "Diagnosis") -> str:
    """The verdict in one line, and what became of the gap."""
    if d.verdict == "ambiguous":
        what = " or ".join(title(d, name) for name in d.ambiguous)
    elif d.verdict == "unknown":
        what = "no declared effect closes the gap"
    elif d.verdict == "none":
        what = "there is nothing to name"
    else:
        what = " and ".join(effect.title for effect in d.effects)
    came = _in(d.gap_before, d.written_unit)
    if d.effects:
        came += f" → {_in(d.gap_after, d.written_unit)}"
    return f"{_HEADINGS[d.verdict]}: {what}; gap {came}, floor {_in(d.floor, d.written_unit)}"


def sentences(d: "Diagnosis") -> tuple[str, ...]:
    """The verdict in plain words, what each effect is and how large, and where it shows."""
    told = [d.sentence, *(e.sentence for e in d.effects if e.sentence not in d.sentence)]
    if d.where.sentence:
        told.append(d.where.sentence)
    return tuple(f"{text[:1].upper()}{text[1:].rstrip('.')}." for text in told if text)


def title(d: "Diagnosis", name: str) -> str:
    """The name of an effect in plain words, by its slug."""
    found = {effect.name: effect.title for effect in d.effects}
    if name in found:
        return found[name]
    return EFFECTS[name].title if name in EFFECTS else name.replace("_", " ")


def gaps(d: "Diagnosis") -> Table:
    """What the gap was and what is left of it, on records that were never used to choose."""
    rows = [
        (
            "gap of short predictions",
            _in(d.gap_before, d.written_unit),
            _in(d.gap_after, d.written_unit),
        ),
        ("noise floor", _in(d.floor, d.written_unit), _in(d.floor, d.written_unit)),
        ("gap in floors, all channels", number(d.ratio_before), number(d.ratio_after)),
        (
            "error of a free run",
            _in(d.rms_before, d.written_unit),
            _in(d.rms_after, d.written_unit),
        ),
    ]
    if math.isfinite(d.closure):
        rows.append(("closed of what is above the floor", "", f"{100.0 * d.closure:.1f} %"))
    if d.effects:
        return Table(("", "base model", "with the effects"), tuple(rows))
    return Table(("", "base model"), tuple(row[:2] for row in rows if row[1]))


def parameters(d: "Diagnosis") -> Table:
    """What was fitted of each effect, with its 95 % interval."""
    rows = [
        (effect.name, name, *_interval(found))
        for effect in d.effects
        for name, found in effect.parameters.items()
    ]
    return Table(("effect", "parameter", "value", "95 % interval", "unit"), tuple(rows))


def calibrations(d: "Diagnosis") -> Table:
    """The base model's numbers: as given, fitted alone, fitted with the effects."""
    rows = [
        (c.name, number(c.given), _with(c.base), _with(c.with_effects), c.unit)
        for c in d.calibrations
    ]
    if d.effects:
        columns = ("", "given", "fitted alone", "with the effects", "unit")
        return Table(columns, tuple(rows))
    return Table(("", "given", "fitted", "unit"), tuple((*r[:3], r[4]) for r in rows))


def ranking(d: "Diagnosis") -> Table:
    """All effects that were tried as the first one, best first, and why each was taken or not."""
    rows = [
        (c.name, _percent(c.cosine2), _percent(c.closure), number(c.gap), c.sentence)
        for c in d.candidates
    ]
    return Table(("effect", "explains", "closes", "leaves, floors", ""), tuple(rows))


def fitted(d: "Diagnosis", most: int) -> Table:
    """The best of the effects that were fitted, without the reasons."""
    rows = [
        (c.name, _percent(c.cosine2), _percent(c.closure), f"{number(c.gap)} floors")
        for c in d.candidates
        if math.isfinite(c.gap)
    ]
    return Table(("tried", "explains", "closes", "leaves"), tuple(rows[:most]))


def steps(d: "Diagnosis") -> Table:
    """The gap on the report split, step by step."""
    rows = [
        (
            "base fit" if s.effect is None else f"+ {s.effect}",
            _in(s.gap, d.written_unit),
            _in(s.floor, d.written_unit),
            number(s.ratio),
        )
        for s in d.steps
    ]
    return Table(("", "gap", "floor", "in floors"), tuple(rows))


def distortions(d: "Diagnosis") -> Table:
    """What records that repeat a period show on lines they do not excite."""
    rows = [
        (x.source, x.channel, f"{number(x.even_dB)} dB", f"{number(x.odd_dB)} dB")
        for x in d.where.distortion
    ]
    return Table(("record", "channel", "even lines, over the noise", "odd lines"), tuple(rows))


def reasons(d: "Diagnosis") -> tuple[str, ...]:
    """What was ruled out and why, beyond what the ranking says of each effect."""
    told = {c.sentence.rstrip(".").lower() for c in d.candidates}
    return tuple(text for text in d.ruled_out if text.rstrip(".").lower() not in told)


def noises(d: "Diagnosis") -> Table:
    """The noise of each channel, and what it was found from."""
    rows = [
        (name, _in(n.rms, unit), _in(n.lsb, unit) if n.lsb > 0.0 else "-", n.how)
        for name, n in d.noise.channels.items()
        for unit in [name.rpartition("_")[2]]
    ]
    return Table(("channel", "noise, rms", "step of the reading", "from"), tuple(rows))


def findings(d: "Diagnosis") -> Table:
    """What was wrong with the data."""
    rows = [
        (f.level, f.source, f.column or "-", "-" if f.row is None else str(f.row), f.sentence)
        for f in d.findings
    ]
    return Table(("", "file", "column", "row", ""), tuple(rows))


def number(value: float) -> str:
    """A number to three digits, or a dash where there is none."""
    return digits(value) if math.isfinite(value) else "-"


def to_json(d: "Diagnosis") -> dict[str, Any]:
    """The diagnosis as JSON values; what is not a finite number is null."""
    unit = d.unit
    told: dict[str, Any] = _strict(
        {
            "verdict": d.verdict,
            "sentence": d.sentence,
            "effects": [
                {
                    "name": effect.name,
                    "title": effect.title,
                    "sentence": effect.sentence,
                    "parameters": {n: _bounds(i) for n, i in effect.parameters.items()},
                }
                for effect in d.effects
            ],
            "ambiguous": list(d.ambiguous),
            "candidates": [
                {
                    "name": c.name,
                    f"gap_{unit}": c.gap * d.floor,
                    "gap_floors": c.gap,
                    "closure": c.closure,
                    "explains": c.cosine2,
                    "sentence": c.sentence,
                }
                for c in d.candidates
            ],
            f"gap_before_{unit}": d.gap_before,
            f"gap_after_{unit}": d.gap_after,
            f"floor_{unit}": d.floor,
            "gap_before_floors": d.ratio_before,
            "gap_after_floors": d.ratio_after,
            "closure": d.closure,
            f"free_run_before_{unit}": d.rms_before,
            f"free_run_after_{unit}": d.rms_after,
            "where": d.where.to_json(),
            "not_excited": dict(d.not_excited),
            "ruled_out": list(d.ruled_out),
            "next_experiment": d.next_experiment and d.next_experiment.to_json(),
            "calibrations": {
                c.name: {
                    "unit": c.unit,
                    "given": c.given,
                    "base": _bounds(c.base),
                    "with_effects": _bounds(c.with_effects),
                }
                for c in d.calibrations
            },
            "steps": [
                {"effect": s.effect, f"gap_{unit}": s.gap, f"floor_{unit}": s.floor,
                 "gap_floors": s.ratio}
                for s in d.steps
            ],
            "noise": d.noise.to_json(),
            "findings": [asdict(f) for f in d.findings],
            "splits": [
                {"record": p.record, "start_s": p.start_s, "end_s": p.end_s, "split": p.split}
                for p in d.splits
            ],
        }
    )  # fmt: skip
    return told


def _bounds(found: "Interval") -> dict[str, Any]:
    return {"value": found.value, "low": found.low, "high": found.high, "unit": found.unit}


def _strict(value: Any) -> Any:
    """The same with null for what is not a finite number."""
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    return float(value) if math.isfinite(value) else None


def _in(value: float, unit: str) -> str:
    return si(value, unit) if math.isfinite(value) else "-"


def _percent(value: float) -> str:
    return f"{100.0 * value:.1f} %" if math.isfinite(value) else "-"


def _interval(found: "Interval") -> tuple[str, str, str]:
    """Value, interval and unit, to as many digits as the interval settles."""
    places = _places(found)
    value, low, high = (_rounded(v, places) for v in (found.value, found.low, found.high))
    return value, f"{low} to {high}", found.unit


def _with(found: "Interval") -> str:
    """A value with half its interval."""
    places = _places(found)
    half = max(abs(found.high - found.value), abs(found.value - found.low))
    value = _rounded(found.value, places)
    return f"{value} ± {_rounded(half, places)}" if math.isfinite(half) else value


def _places(found: "Interval") -> int | None:
    """Decimals that two digits of the interval's width take; None where it has none."""
    width = found.high - found.low
    if not (math.isfinite(width) and width > 0.0):
        return None
    return 1 - math.floor(math.log10(width))


def _rounded(value: float, places: int | None) -> str:
    if not math.isfinite(value):
        return "-"
    if places is None or not 0 <= places <= _MOST_PLACES:
        return f"{value:.4g}" if places is None else f"{round(value, places):.6g}"
    return f"{value:.{places}f}"
