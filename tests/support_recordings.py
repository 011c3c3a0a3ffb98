"""Tables and maps of records that tests write."""

import pandas as pd

from estune.recordings.column_map import AS_NAMED


def names(**sources):
    return AS_NAMED.with_options(sources, {}, {})


def write_csv(path, written, separator=",", decimal="."):
    pd.DataFrame(written).to_csv(path, sep=separator, decimal=decimal, index=False)
