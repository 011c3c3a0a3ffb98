"""A diagnosis as text: heading, sentences, tables of strings."""

import math
from collections import defaultdict
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from estune.errors import InvalidInput
from plants.diagnosis.interval import Interval
from plants.diagnosis.report.plant_units import own_names
from plants.diagnosis.result import DiagnosisResult, Trace
from plants.effects import EFFECTS
from plants.effects.plant_scale import PlantScale, digits, si
from plants.remedies.text import full_sentence

_HEADINGS = {
    "named": "IDENTIFIED",
    "incomplete": "IDENTIFIED, INCOMPLETE",
    "ambiguous": "AMBIGUOUS",
    "unknown": "UNEXPLAINED",
    "none": "NO MISSING EFFECT",
}


class TextTable(NamedTuple):
    """A table of strings; numbers are written with their units."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def numeric(self) -> tuple[int, ...]:
        """Indices of the columns of numbers."""
        return tuple(
            n
            for n in range(1, len(self.columns))
            if all(row[n][:1] in "-0123456789" for row in self.rows)
        )

    def lines(self) -> list[str]:
        """The table as plain text."""
        rows = [self.columns, *self.rows]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return [
            "  ".join(
                f"{cell:>{width}}" if n in self.numeric else f"{cell:<{width}}"
                for n, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in rows
        ]


def heading(d: DiagnosisResult) -> str:
    """Limits of the records, the verdict and the prediction error in one line."""
    if d.verdict == "ambiguous":
        what = " or ".join(_title(d, name) for name in d.ambiguous)
    elif d.verdict == "unknown":
        what = "no declared effect explains the prediction error"
    elif d.verdict == "none":
        what = "the prediction error is at the noise floor"
    else:
        what = " and ".join(effect.title for effect in d.effects)
    error = _in(d.before.gap, d)
    if d.effects:
        error += f" → {_in(d.after.gap, d)}"
    first = "".join(f"{limit.label}; " for limit in d.limitations)
    first = f"WITH RESERVATION, {first.removesuffix('; ')}. " if first else ""
    finding = f"{what}; prediction error {error}, noise floor {_in(d.floor, d)}"
    return f"{first}{_HEADINGS[d.verdict]}: {finding}"


def sentences(d: DiagnosisResult) -> tuple[str, ...]:
    """The verdict, each effect with its size, and where it shows, in plain words."""
    sizes = [e.sentence for e in d.effects if e.sentence not in d.sentence]
    declared = [effect.sentence for effect in d.declared]
    texts = (d.sentence, *sizes, *declared, d.unexplained.sentence)
    return tuple(full_sentence(text) for text in texts if text)


def _title(d: DiagnosisResult, name: str) -> str:
    titles = {n: e.title for n, e in EFFECTS.items()} | {e.name: e.title for e in d.effects}
    return titles.get(name, name.replace("_", " "))


def gaps(d: DiagnosisResult) -> TextTable:
    """Prediction errors: of the model as given, refitted, and refitted with the effects."""
    models = (d.given, d.before, d.after)
    rows = [
        ("error of short predictions, rms", *(_in(m.gap, d) for m in models)),
        ("noise floor", *[_in(d.floor, d)] * 3),
        ("times the noise floor, all channels", *(number(m.ratio) for m in models)),
        ("error of a free run, rms", *(_in(m.rms, d) for m in models)),
    ]
    if d.hold_out is not None:
        held = d.hold_out[2:]
        rows += [
            ("held-out records: short predictions", *(_in(m.gap, d) for m in held)),
            ("their noise floor", *[_in(d.hold_out.floor, d)] * 3),
            ("held-out records: free run", *(_in(m.rms, d) for m in held)),
        ]
    if math.isfinite(d.closure):
        rows.append(("explained of the power above the floor", "", "", _percent(d.closure)))
    columns = ("", "model as given", "refitted", "with the effects")
    if d.effects:
        return TextTable(columns, tuple(rows))
    return TextTable(columns[:3], tuple(row[:3] for row in rows if row[1]))


def parameters(d: DiagnosisResult) -> TextTable:
    """The fitted parameters of each effect, with 95 % confidence intervals."""
    scale = PlantScale.of(d.base_model)
    rows = []
    for effect in d.effects:
        declared = effect.effect.parameters()
        names = own_names(type(effect.effect), effect.parameters, scale)
        for name, interval_of in effect.parameters.items():
            value, interval, unit = _interval(interval_of)
            known = interval_of.is_determined or declared[name].is_phase
            shown = value if known else "not determined"
            rows.append((effect.name, names[name], shown, interval, unit))
    return TextTable(("effect", "parameter", "value", "95 % interval", "unit"), tuple(rows))


def not_tried(d: DiagnosisResult) -> list[tuple[str, str]]:
    """Effects that a plant of this kind cannot have in the model, and why."""
    never = {name: why for name, why in d.not_excited.items() if name in d.not_of_the_plant}
    return [(", ".join(names), why) for why, names in _alike(never).items()]


def _alike(reasons: Mapping[str, str]) -> dict[str, list[str]]:
    alike = defaultdict[str, list[str]](list)
    for name, why in reasons.items():
        alike[why].append(name)
    return alike


def not_excited(d: DiagnosisResult) -> TextTable:
    """Effects that these records cannot show, the reason, and the experiment that would."""
    rows = []
    for why, names in _alike(d.not_excited).items():
        shown = {d.shown_by.get(name) or "-" for name in names}
        rows.append((", ".join(names), why, shown.pop() if len(shown) == 1 else "-"))
    return TextTable(("effect", "why", "shown by"), tuple(rows))


def calibrations(d: DiagnosisResult) -> TextTable:
    """The base model's numbers: as given, fitted alone, fitted with the effects."""
    fits = ("base", "with_effects") if d.effects else ("base",)
    heads = ("fitted alone", "with the effects") if d.effects else ("fitted",)
    rows = [
        (c.name, number(c.given), *(_with_half_width(getattr(c, fit)) for fit in fits), c.unit)
        for c in d.calibrations
    ]
    return TextTable(("", "given", *heads, "unit"), tuple(rows))


def ranking(d: DiagnosisResult) -> TextTable:
    """All effects that were tried as the first one, best first."""
    rows = [
        (
            c.name,
            *map(_percent, (c.cosine2, c.own_probability, c.probability, c.closure)),
            number(c.gap),
        )
        for c in d.candidates
    ]
    columns = (
        *("effect", "screening R²", "probability", "of its family"),
        *("explained", "times the floor left"),
    )
    return TextTable(columns, tuple(rows))


def fitted(d: DiagnosisResult, most: int) -> TextTable:
    """The best of the effects that were fitted."""
    columns, rows = ranking(d)
    return TextTable(columns, tuple(row for row in rows if row[-1] != "-")[:most])


def steps(d: DiagnosisResult) -> TextTable:
    """Prediction error on data left out, step by step."""
    rows = [
        (step_name(s.effect), _in(s.gap, d), _in(s.floor, d), number(s.ratio)) for s in d.steps
    ]
    return TextTable(("", "error, rms", "noise floor", "times the floor"), tuple(rows))


def step_name(effect: str | None) -> str:
    """The effect that a step of the search added to the model."""
    return "base fit" if effect is None else f"+ {effect}"


def noises(d: DiagnosisResult) -> TextTable:
    """The noise of each channel, and how it was estimated."""
    scale = PlantScale.of(d.base_model)
    rows = [
        (title, _amount(n.rms, unit), _amount(n.lsb, unit) if n.lsb > 0.0 else "-", n.how)
        for channel, n in d.noise.channels.items()
        for title, unit in [scale.channel(channel)]
    ]
    return TextTable(("channel", "noise, rms", "step of the reading", "from"), tuple(rows))


def findings(d: DiagnosisResult) -> TextTable:
    """Issues of the data."""
    rows = [
        (f.level, f.source, f.column or "-", "-" if f.row is None else str(f.row), f.sentence)
        for f in d.findings
    ]
    return TextTable(("", "file", "column", "row", ""), tuple(rows))


def main_channel(d: DiagnosisResult) -> str:
    """The channel of the prediction error, or the first there is."""
    channels = [trace.channel for trace in d.traces]
    wanted = "tension_N" if d.unit == "N" else "angle_rad"
    return wanted if wanted in channels else channels[0]


def worst_trace(d: DiagnosisResult) -> Trace:
    """The record of the main channel in which the base model is worst."""
    traces = [trace for trace in d.traces if trace.channel == main_channel(d)]
    return max(traces, key=lambda t: float(np.nanmean((t.measured - t.before) ** 2)))


def trace_of(d: DiagnosisResult, record: str | None) -> Trace:
    """A record by name, in the main channel if it has it; the worst for None.

    Raises:
        InvalidInput: there is no such record.
    """
    if record is None and d.traces:
        return worst_trace(d)
    named = [trace for trace in d.traces if trace.name == record]
    if not named:
        names = ", ".join(dict.fromkeys(trace.name for trace in d.traces)) or "nothing"
        raise InvalidInput(f"there is no record {record}; there are {names}")
    return next((trace for trace in named if trace.channel == main_channel(d)), named[0])


def number(value: float) -> str:
    """A number to three digits, or a dash where there is none."""
    return digits(value) if math.isfinite(value) else "-"


def _in(value: float, d: DiagnosisResult) -> str:
    return _amount(value, d.written_unit)


def _amount(value: float, unit: str) -> str:
    return si(value, unit) if math.isfinite(value) else "-"


def _percent(value: float) -> str:
    return f"{100.0 * value:.1f} %" if math.isfinite(value) else "-"


def _interval(fitted: Interval) -> tuple[str, str, str]:
    """Value, interval and unit, to the digits that the interval determines."""
    places = _places(fitted)
    value, low, high = (_rounded(v, places) for v in (fitted.value, fitted.low, fitted.high))
    return value, f"{low} to {high}", fitted.unit


def _with_half_width(fitted: Interval) -> str:
    places = _places(fitted)
    half = max(abs(fitted.high - fitted.value), abs(fitted.value - fitted.low))
    value = _rounded(fitted.value, places)
    return f"{value} ± {_rounded(half, places)}" if math.isfinite(half) else value


def _places(fitted: Interval) -> int | None:
    """Decimals that two digits of the interval's width take; None where it has none."""
    width = fitted.high - fitted.low
    if not (math.isfinite(width) and width > 0.0):
        return None
    return 1 - math.floor(math.log10(width))


def _rounded(value: float, places: int | None) -> str:
    if not math.isfinite(value):
        return "-"
    if places is None:
        return f"{value:.4g}"
    within = 0 <= places <= 7
    return f"{value:.{places}f}" if within else f"{round(value, places):.6g}"
