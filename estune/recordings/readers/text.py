"""Tables as text: any separator, decimal point or comma, comments, units in the heading."""

import re
import warnings
from pathlib import Path

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile
from estune.recordings.readers.text_layout import layout_of


def read_text(path: Path) -> RawFile:
    """Reads a table with a heading; one without names its columns 1, 2, and so on."""
    import pandas as pd  # noqa: PLC0415  slow to import

    layout = layout_of(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            frame = pd.read_csv(
                path,
                sep=layout.separator,
                decimal=layout.decimal,
                header=None,
                names=layout.names,
                skiprows=layout.skipped,
                encoding=layout.encoding,
                index_col=False,
                skipinitialspace=True,
                low_memory=False,
            )
    except pd.errors.ParserWarning as error:
        raise Unusable("rows have more cells than the heading; name every column") from error
    except pd.errors.EmptyDataError:
        return RawFile((), {})
    except pd.errors.ParserError as error:
        line = re.search(r"line (\d+)", str(error))
        raise Unusable(
            "the row has more cells than the heading, or a quote is not closed; correct it",
            row=int(line[1]) - layout.skipped if line else None,
        ) from error
    named = zip(layout.names, layout.units, strict=True)
    return RawFile(tuple(Channel(n, frame[n].to_numpy(), unit) for n, unit in named), {})
