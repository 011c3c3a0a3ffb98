"""Rows and headings of logs as historians write them: backward, twice, and in German."""

import numpy as np
import pytest

from estune.recordings.loop_log import read_loop_log
from estune.service_records.sources import read_logs

HEADING = "time;SP;PV;OP"


def rows(number: int = 60) -> list[str]:
    values = np.random.default_rng(2).standard_normal((number, 3)).round(3)
    return [f"{0.1 * k:.1f};{a};{b};{c}" for k, (a, b, c) in enumerate(values.tolist())]


def write(path, lines, heading=HEADING):
    path.write_text("\n".join([heading, *lines]) + "\n", "utf-8")
    return path


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (lambda lines: lines[::-1], ["reversed"]),
        (lambda lines: [*lines[:30], lines[29], *lines[30:]], ["a row repeats"]),
        (lambda lines: [*lines[::-1], lines[0]], ["a row repeats", "reversed"]),
    ],
)
def test_rows_backward_or_twice_are_put_in_order_and_it_is_said(tmp_path, changed, said):
    usual = read_loop_log(write(tmp_path / "usual.csv", rows()))

    log = read_loop_log(write(tmp_path / "log.csv", changed(rows())))

    assert log.sampling_Hz == pytest.approx(10.0)
    for name, values in usual.parts[0].items():
        np.testing.assert_allclose(log.parts[0][name], values)
    assert [str(issue) for issue in log.issues if not any(w in str(issue) for w in said)] == []
    assert len(log.issues) == len(said)


def test_rows_of_one_rounded_time_with_other_values_are_samples(tmp_path):
    lines = rows()
    other = lines[29].rpartition(";")[0] + ";7.0"

    log = read_loop_log(write(tmp_path / "log.csv", [*lines[:30], other, *lines[30:]]))

    assert log.parts[0]["time"].size == 61


def test_the_only_column_left_is_the_measurement(tmp_path):
    heading = "Zeitstempel;Sollwert [%];Füllstand [%];Stellgröße [%]"

    log = read_loop_log(write(tmp_path / "log.csv", rows(), heading))

    assert log.sources["measurement"] == "Füllstand [%]"


def test_a_log_with_the_samples_of_another_is_left_out_and_said(tmp_path):
    for name in ("a.csv", "b.csv"):
        write(tmp_path / name, rows())

    found = read_logs(tmp_path)

    assert [log.name for log in found.logs] == ["a.csv"]
    assert any("the samples of a.csv" in str(issue) for issue in found.issues)
