"""Dates and times of day as the time of a record."""

import numpy as np
import pandas as pd
import pytest

from estune.recordings.recording import read_recording


@pytest.mark.parametrize(
    ("form", "first"),
    [
        ("%d.%m.%Y %H:%M:%S", "2026-03-02T23:59:55"),
        ("%m/%d/%Y %I:%M:%S %p", "2026-03-31T23:59:55"),
        ("%d/%m/%y %H:%M:%S.%f", "2025-12-31T23:59:55"),
        ("%Y-%m-%dT%H:%M:%SZ", "2026-03-02T23:59:55"),
        ("%H:%M:%S", "2026-03-02T12:00:00"),
        ("%d.%m.%Y %H:%M:%S,%f", "2026-03-02T23:59:55"),
    ],
)
def test_dates_as_loggers_write_them_are_the_time(tmp_path, form, first):
    stamps = pd.Series(pd.date_range(first, periods=40, freq="s")).dt.strftime(form)
    table = {"time_s": stamps, "tension_N": np.arange(40.0), "current_A": np.arange(40.0)}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    (part,) = read_recording(tmp_path / "log.csv").parts
    np.testing.assert_allclose(part["time_s"], np.arange(40.0), atol=1e-9)
