"""Tables in long form: a row for each value, with its time and the name of its signal."""

import numpy as np
from numpy.typing import NDArray

from estune.recordings.channel_search import TIMES
from estune.recordings.column_map import ColumnTable, map_column
from estune.recordings.heading import heading
from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.units import NO_DRUM

_VALUES = ("value", "state", "wert", "reading")
_SIGNALS = (
    *("entity", "entityid", "name", "tag", "tagname", "variable", "signal", "metric", "field"),
    *("channel", "point", "pointname", "series", "sensor", "attribute", "measurement", "item"),
)
_SIGNALS_MAX = 200
"""Signals of a table at most; more are texts of another kind."""


def separated(raw: RawFile) -> RawFile:
    """The file with a channel for each signal, with stamps of its own; others as they are."""
    keys = {heading(channel.name).key: channel for channel in raw.channels}
    value = next((keys[k] for k in _VALUES if k in keys), None)
    times = [name.replace(" ", "") for name in TIMES]
    time = next((keys[k] for k in times if k in keys), None)
    named = [keys[k] for k in _SIGNALS if k in keys and keys[k].values.dtype == object]
    if value is None or time is None or not named or value in named:
        return raw
    labels = np.array(
        [".".join(map(str, row)) for row in zip(*(c.values for c in named), strict=True)]
    )
    signals = list(dict.fromkeys(labels.tolist()))
    numbers = _numbers(value)
    there = np.isfinite(numbers)
    if len(signals) > _SIGNALS_MAX or not there.any():
        return raw
    # Rows without a number repeat the heading, or state that the sensor is away.
    stamps = map_column("time_s", ColumnTable(), time._replace(values=time.values[there]), NO_DRUM)
    if stamps is None:
        return raw
    labels, numbers = labels[there], numbers[there]
    channels = []
    for signal in signals:
        own = np.flatnonzero(labels == signal)
        if own.size:
            at, kept = np.unique(stamps.values[own], return_index=True)
            channels.append(Channel(signal, numbers[own][kept], value.unit, at))
    return raw._replace(channels=tuple(channels))


_STATES = {"on": 1.0, "off": 0.0, "true": 1.0, "false": 0.0}


def _numbers(channel: Channel) -> NDArray[np.float64]:
    """Cells as numbers, switches as 1 and 0, others as NaN."""
    import pandas as pd  # noqa: PLC0415  slow to import

    cells = pd.Series(channel.values)
    if cells.dtype == object:
        cells = cells.map(lambda cell: _STATES.get(str(cell).strip().lower(), cell))
    return np.asarray(pd.to_numeric(cells, errors="coerce").to_numpy(np.float64))
