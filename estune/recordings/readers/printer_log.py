"""Logs of 3D printers: `klippy.log` of Klipper, and reports of temperatures by Marlin (M105)."""

import re
from collections import defaultdict
from collections.abc import Iterable
from datetime import UTC, datetime

import numpy as np

from estune.recordings.raw_file import Channel, RawFile

_STATS = re.compile(r"^Stats (?P<time>[\d.]+): (?P<rest>.*)$")
_SECTION = re.compile(r"(\w[\w-]*): ((?:[\w-]+=[^\s=]+ ?)+)")
_PAIR = re.compile(r"([\w-]+)=([^\s=]+)")

_TEMPERATURE = re.compile(r"(?P<name>\b[TBCP]\d?):\s*(?P<now>-?[\d.]+)\s*/\s*(?P<target>-?[\d.]+)")
_POWER = re.compile(r"(?P<name>B?)@(?P<number>\d?):\s*(?P<value>-?[\d.]+)")
_CLOCK = re.compile(r"(?:(?P<date>\d{4}-\d\d-\d\d)[T ])?(?P<time>\d{1,2}:\d\d:\d\d(?:[.,]\d+)?)")
_SECONDS = re.compile(r"^\W*(?P<seconds>\d+\.\d+)\b")
_NAMES = {"T": "extruder", "T0": "extruder", "B": "bed", "C": "chamber", "P": "probe"}
_DAY_S = 86_400.0

Rows = dict[str, list[tuple[float, float]]]


def is_klippy(lines: Iterable[str]) -> bool:
    """Whether lines are of Klipper."""
    return any(_STATS.match(line) for line in lines)


def is_marlin(lines: Iterable[str]) -> bool:
    """Whether lines report temperatures as Marlin does."""
    return any(_TEMPERATURE.search(line) for line in lines)


def read_klippy(lines: Iterable[str]) -> RawFile:
    """Reads the statistics, a line a second: `extruder.target`, `.temp` and `.pwm`."""
    rows: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    for line in lines:
        stats = _STATS.match(line)
        if stats is None:
            continue
        for section, pairs in _SECTION.findall(stats["rest"]):
            for name, text in _PAIR.findall(pairs):
                try:
                    rows[f"{section}.{name}"].append((float(stats["time"]), float(text)))
                except ValueError:
                    continue  # a text
    return _file(rows)


def read_marlin(lines: Iterable[str]) -> RawFile:
    """Reads `T:199.8 /200.0 @:64`: `extruder.target`, `extruder.temp`, `extruder.power`.

    Stamps are those that the host writes before the report; without them the rate must be stated.
    """
    rows: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    stamped, count, last_s, days = True, 0, -np.inf, 0.0
    for line in lines:
        reports = list(_TEMPERATURE.finditer(line))
        if not reports:
            continue
        stamp_s = _stamp(line[: reports[0].start()])
        stamped = stamped and stamp_s is not None
        at_s = float(count) if stamp_s is None else stamp_s + days
        if at_s < last_s - 0.5 * _DAY_S:  # past midnight
            days += _DAY_S
            at_s += _DAY_S
        last_s, count = at_s, count + 1
        for report in reports:
            name = _NAMES.get(report["name"], report["name"])
            rows[f"{name}.target"].append((at_s, float(report["target"])))
            rows[f"{name}.temp"].append((at_s, float(report["now"])))
        for power in _POWER.finditer(line):
            name = "bed" if power["name"] else _NAMES.get(f"T{power['number']}", "extruder")
            rows[f"{name}.power"].append((at_s, float(power["value"])))
    return _file(rows) if stamped else _without_stamps(rows)


def _stamp(text: str) -> float | None:
    """The time that stands before a report, s."""
    clock = _CLOCK.search(text)
    if clock:
        written = f"{clock['date'] or '1970-01-01'} {clock['time'].zfill(8).replace(',', '.')}"
        return datetime.fromisoformat(written).replace(tzinfo=UTC).timestamp()
    seconds = _SECONDS.match(text)
    return float(seconds["seconds"]) if seconds else None


def _file(rows: Rows) -> RawFile:
    channels = []
    for name, pairs in rows.items():
        stamps, first = np.unique(np.array([t for t, _ in pairs]), return_index=True)
        channels.append(Channel(name, np.array([v for _, v in pairs])[first], "", stamps))
    return RawFile(tuple(channels), {})


def _without_stamps(rows: Rows) -> RawFile:
    return RawFile(
        tuple(Channel(name, np.array([v for _, v in pairs])) for name, pairs in rows.items()), {}
    )
