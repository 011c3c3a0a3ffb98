"""Tables as text: any separator, decimal point or comma, comments, units in the heading."""

import io
import re
import warnings
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.readers.flight_log import with_loops_of_betaflight
from estune.recordings.readers.text_layout import layout_of, number_with_unit
from estune.recordings.units import find_unit


def read_text(path: Path) -> RawFile:
    """Reads a table with a heading; one without names its columns 1, 2, and so on."""
    return table(decoded(path))


def decoded(path: Path) -> str:
    """The text of a file: UTF-8, UTF-16 by its mark, or the code page of Windows."""
    data = path.read_bytes()
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252")  # refused where it is no text
        if any(ord(sign) < 32 and sign not in "\t\r\n" for sign in text[:10_000]):
            raise
        return text


def table(text: str) -> RawFile:
    """A table from its text."""
    import pandas as pd  # noqa: PLC0415  slow to import

    layout = layout_of(text)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(
                io.StringIO(text),
                sep=layout.separator,
                decimal=layout.decimal,
                header=None,
                names=layout.names,
                skiprows=layout.skipped,
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
            )
    except pd.errors.ParserWarning as error:
        raise Unusable("rows have more cells than the heading; name every column") from error
    except pd.errors.EmptyDataError:
        return RawFile((), {})
    except pd.errors.ParserError as error:
        if "out of memory" in str(error):
            raise MemoryError from error
        line = re.search(r"line (\d+)", str(error))
        raise Unusable(
            "the row has more cells than the heading, or a quote is not closed; correct it",
            row=int(line[1]) - layout.skipped if line else None,
        ) from error
    named = zip(layout.names, layout.units, strict=True)
    channels = (_plain(Channel(n, frame[n].to_numpy(), u), layout.decimal) for n, u in named)
    return with_loops_of_betaflight(RawFile(tuple(channels), {}))


def _plain(channel: Channel, decimal: str) -> Channel:
    """The channel with numbers for cells such as `21.5 °C`, where all are in one known unit."""
    import numpy as np  # noqa: PLC0415  beside pandas
    import pandas as pd  # noqa: PLC0415  slow to import

    cells: NDArray[Any] = channel.values
    if cells.dtype != object or channel.unit:
        return channel
    there = ~np.asarray(pd.isna(pd.Series(cells)))
    parts = [number_with_unit(str(cell), decimal) for cell in cells[there]]
    units = {part[1] for part in parts if part is not None}
    unit = find_unit(next(iter(units), ""))
    if None in parts or len(units) != 1 or unit is None:
        return channel
    values = np.full(cells.size, np.nan)
    values[there] = [part[0] for part in parts if part is not None]
    return channel._replace(values=values, unit=unit)
