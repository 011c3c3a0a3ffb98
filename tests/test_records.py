"""Folders of measured records: every fault is reported with file, column and row."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

import estune
from estune.cli import run
from estune.errors import InvalidInput
from estune.run.results.export import columns, export_trials, metadata
from experiments.paper.identify.excitation import Band, multisine
from experiments.paper.identify.open_loop import open_loop_record
from plants import reference_reel
from plants.diagnosis.data.measured_record import CHANNELS, MeasuredRecord
from plants.diagnosis.data.records import read_measurements
from tests.support_runs import ArithmeticRig

RATE = 632.0


def rejecting_issues(contents):
    """Issues for which a record is rejected."""
    return tuple(f for f in contents.findings if f.level == "refused")


@pytest.fixture(scope="module")
def record():
    return open_loop_record(reference_reel(), multisine(RATE, Band(1.0, 60.0, periods=2), 4.0))


def write(folder, record, name="good", about=None, **changed):
    """Writes the record with columns replaced (None: omitted), and its metadata file."""
    written = {k: v for k, v in {**columns(record), **changed}.items() if v is not None}
    rows = zip(*(np.asarray(v).tolist() for v in written.values()), strict=True)
    text = "\n".join([",".join(written), *(",".join(map(str, row)) for row in rows)])
    (folder / f"{name}.csv").write_text(text + "\n")
    facts = {**metadata(record), "trial_id": name, **(about or {})}
    (folder / f"{name}.json").write_text(json.dumps(facts))
    return written


def refusal(folder, record, name="bad", about=None, **changed):
    """Issue of one bad file; the good file beside it must be accepted."""
    write(folder, record)
    write(folder, record, name, about, **changed)
    reading = read_measurements(folder)
    assert [m.name for m in reading.measurements] == ["good"]
    (finding,) = rejecting_issues(reading)
    assert finding.source == f"{name}.csv"
    return finding


def equal(one, other):
    assert one.sampling_Hz == pytest.approx(other.sampling_Hz)
    assert (one.name, one.rig, one.cable_length_m) == (other.name, other.rig, other.cable_length_m)
    assert (one.preload_N, one.loop, one.profile) == (other.preload_N, other.loop, other.profile)
    assert one.gains == other.gains
    for name in CHANNELS:
        a, b = one.channel(name), other.channel(name)
        assert (a is None and b is None) or np.array_equal(a, b)
    assert np.array_equal(one.flags, other.flags)


@pytest.mark.parametrize("form", ["csv", "parquet", "mcap", "run"])
def test_records_of_estune_are_read_back_exactly(tmp_path, form):
    run = estune.tune(ArithmeticRig(), trials=2, repeats=1, folder=tmp_path, run="r", watch=None)
    folder = run.folder
    if form != "run":
        folder = tmp_path / "out"
        export_trials(run.folder, folder, form)
    read = read_measurements(folder)
    assert not read.findings
    assert len(read.measurements) == len(run.entries)
    for measurement, entry in zip(read.measurements, run.entries, strict=True):
        equal(measurement, MeasuredRecord.of(run.record(entry.number)))


BAD_COLUMNS = {
    "slip of the pen": ({"tension_N": None, "tenson_N": 1.0}, "tenson_N", None, "tension_N"),
    "other case": ({"current_A": None, "Current_a": 1.0}, "Current_a", None, "current_A"),
}


@pytest.mark.parametrize("case", BAD_COLUMNS)
def test_misnamed_column_is_refused_with_the_right_name(tmp_path, record, case):
    changed, column, row, message = BAD_COLUMNS[case]
    n = record.time_s.size
    changed = {k: None if v is None else np.full(n, v) for k, v in changed.items()}
    finding = refusal(tmp_path, record, **changed)
    assert (finding.column, finding.row) == (column, row)
    assert message in finding.sentence


@pytest.mark.parametrize(
    ("column", "other", "factor"),
    [
        ("tension_N", "tension_kN", 1e3),
        ("angle_rad", "angle_deg", np.pi / 180.0),
        ("time_s", "time_ms", 1e-3),
    ],
)
def test_column_in_another_unit_is_converted(tmp_path, record, column, other, factor):
    values = columns(record)[column] / factor
    write(tmp_path, record, "other", **{column: None, other: values})
    write(tmp_path, record)
    good, converted = read_measurements(tmp_path).measurements
    for name in ("tension_N", "current_A", "angle_rad"):
        np.testing.assert_allclose(converted.channel(name), good.channel(name), rtol=1e-12)
    assert converted.sampling_Hz == pytest.approx(good.sampling_Hz, rel=1e-12)


def with_value(column, row, value):
    changed = column.astype(object)
    changed[row - 1] = value
    return changed


@pytest.mark.parametrize("value", ["nan", "inf", "oops", ""])
def test_cell_without_a_number_is_reported_by_column_and_row(tmp_path, record, value):
    finding = refusal(tmp_path, record, tension_N=with_value(record.tension_N, 17, value))
    assert (finding.column, finding.row) == ("tension_N", 17)


def test_record_without_a_setpoint_is_not_taken_for_a_closed_loop(tmp_path, capsys):
    t = np.arange(200) / 100.0
    table = np.column_stack([t, np.where(t > 0.5, 1.0, 0.0), 1.0 - np.exp(-t)])
    file = tmp_path / "step.csv"
    heading = "time_s,current_A,tension_N"
    np.savetxt(file, table, delimiter=",", header=heading, comments="")
    (made,) = read_measurements(file).measurements
    assert made.loop == "open"
    assert run(["records", str(file)]) == 0
    assert "closed" not in capsys.readouterr().out


def swap_rows(t):
    return np.concatenate([t[:99], t[[100, 99]], t[101:]])


BAD_TIMES = {
    "unsorted": (swap_rows, 101, "sort"),
    "repeated": (lambda t: np.concatenate([t[:50], t[49:-1]]), 51, "repeats"),
    "another rate": (lambda t: t * 632.0 / 500.0, None, "500"),
    "milliseconds": (lambda t: t * 1e3, None, "seems to be in ms"),
}


@pytest.mark.parametrize("case", BAD_TIMES)
def test_uneven_time_column_is_refused_at_the_row(tmp_path, record, case):
    spoil, row, message = BAD_TIMES[case]
    finding = refusal(tmp_path, record, time_s=spoil(record.time_s))
    assert finding.column == "time_s"
    assert message in finding.sentence
    if row is not None:
        assert finding.row == row


def test_rounded_or_jittered_time_stamps_are_accepted(tmp_path, record):
    write(tmp_path, record, "rounded", time_s=np.round(record.time_s, 3))
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, record.time_s.size) / RATE
    write(tmp_path, record, "scattered", time_s=record.time_s + jitter)
    read = read_measurements(tmp_path)
    assert [m.sampling_Hz for m in read.measurements] == [RATE, RATE]
    (finding,) = read.findings
    assert (finding.source, finding.level) == ("scattered.csv", "warning")


def test_stamps_of_a_poor_clock_are_one_record(tmp_path, record):
    jitter = np.random.default_rng(0).normal(0.0, 0.3, record.time_s.size) / RATE
    write(tmp_path, record, "jittered", time_s=np.sort(record.time_s + jitter))
    write(tmp_path, record, "shared", time_s=np.round(record.time_s, 2))
    found = read_measurements(tmp_path)
    assert len(found.measurements) == 2
    for m in found.measurements:
        assert m.samples == pytest.approx(record.time_s.size, abs=3)
        assert m.sampling_Hz == pytest.approx(RATE, rel=1e-3)


def test_record_with_a_gap_becomes_two_records(tmp_path, record):
    later = np.where(np.arange(record.time_s.size) >= 200, 3.0 / RATE, 0.0)
    write(tmp_path, record, time_s=record.time_s + later)
    read = read_measurements(tmp_path)
    assert [m.name for m in read.measurements] == ["good part 1", "good part 2"]
    joined = np.concatenate([m.tension_N for m in read.measurements])
    assert np.array_equal(joined, record.tension_N)
    (finding,) = read.findings
    assert (finding.level, finding.column, finding.row) == ("warning", "time_s", 201)


def test_record_of_a_drifting_clock_is_resampled(tmp_path, record):
    time_s = record.time_s + 0.004 * np.cos(2.0 * np.pi * record.time_s)
    write(tmp_path, record, time_s=time_s, tension_N=np.sin(time_s))
    read = read_measurements(tmp_path)
    (measurement,) = read.measurements
    assert np.allclose(np.diff(measurement.time_s), 1.0 / RATE)
    # Linear interpolation is wrong by at most T^2/8 of the curvature, which is 1.
    assert np.abs(measurement.tension_N - np.sin(measurement.time_s)).max() < 0.125 / RATE**2 * 1.2
    (finding,) = read.findings
    assert "resampled to 632 Hz" in finding.sentence


def test_rate_loop_and_preload_follow_from_columns_without_metadata(tmp_path, record):
    write(tmp_path, record, "foreign", velocity_rad_s=record.time_s)
    (tmp_path / "foreign.json").unlink()
    read = read_measurements(tmp_path)
    (measurement,) = read.measurements
    assert measurement.sampling_Hz == pytest.approx(RATE, rel=1e-9)
    assert (measurement.loop, measurement.preload_N) == ("open", record.setpoint_N[0])
    assert (measurement.cable_length_m, measurement.gains, measurement.rig) == (None, None, "")
    assert {f.column for f in read.findings} == {"", "velocity_rad_s"}
    assert all(f.level == "warning" for f in read.findings)


def test_semicolon_table_with_decimal_commas_is_read(tmp_path, record):
    written = write(tmp_path, record)
    text = (tmp_path / "good.csv").read_text()
    (tmp_path / "good.csv").write_text(text.replace(",", ";").replace(".", ","))
    (measurement,) = read_measurements(tmp_path).measurements
    assert np.array_equal(measurement.tension_N, written["tension_N"])


def test_truncated_files_do_not_affect_the_others(tmp_path, record):
    write(tmp_path, record)
    whole = (tmp_path / "good.csv").read_bytes()
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "heading.csv").write_bytes(whole.splitlines(keepends=True)[0])
    (tmp_path / "cut.csv").write_bytes(whole[: whole.rindex(b",") - 20])
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)) * 9)
    table = pa.table(columns(record))
    pq.write_table(table, tmp_path / "cut.parquet")
    content = (tmp_path / "cut.parquet").read_bytes()
    (tmp_path / "cut.parquet").write_bytes(content[: len(content) // 2])
    (tmp_path / "ragged.csv").write_bytes(whole + b"1,2,3,4,5,6,7,8,9\n")
    (tmp_path / "badmeta.csv").write_bytes(whole)
    (tmp_path / "badmeta.json").write_text('{"sampling_Hz": 632,')
    read = read_measurements(tmp_path)
    assert [m.name for m in read.measurements] == ["good"]
    assert {f.source for f in rejecting_issues(read)} == {
        *("empty.csv", "heading.csv", "cut.csv", "binary.csv", "cut.parquet", "ragged.csv"),
        "badmeta.csv",
    }
    rows = {f.source: f.row for f in rejecting_issues(read)}
    assert rows["cut.csv"] is not None
    assert rows["ragged.csv"] == record.time_s.size + 1


def test_export_of_a_whole_run_is_refused_by_name(tmp_path):
    for name in ("samples", "trials"):
        (tmp_path / f"{name}.csv").write_text("number,attempt\n", "utf-8")
    with pytest.raises(InvalidInput, match=r"samples\.csv.*export of a whole run; give the run"):
        read_measurements(tmp_path)


def test_folder_without_usable_records_reports_every_file(tmp_path, record):
    with pytest.raises(InvalidInput, match=r"no \.csv, .* or run"):
        read_measurements(tmp_path)
    write(tmp_path, record, "first", tension_N=with_value(record.tension_N, 3, "nan"))
    write(tmp_path, record, "second", about={"loop": "ajar"})
    with pytest.raises(InvalidInput, match=r"first\.csv, row 3, column tension_N.*second\.csv"):
        read_measurements(tmp_path)


def test_records_command_shows_and_converts_foreign_data(tmp_path, record, capsys):
    written = columns(record)
    foreign = {
        "t": written["time_s"],
        "F": written["tension_N"],
        "vir": 35.15 * written["current_A"],
        "qm": -25.0 * written["angle_rad"],
    }
    scipy.io.savemat(tmp_path / "log.mat", foreign)
    options = ["--map", "time=t,tension=F,current=vir,angle=qm", "--unit", "angle=mm"]
    options += ["--scale", f"current={1.0 / 35.15}", "--model", "plants:reference_reel"]
    command = ["records", str(tmp_path / "log.mat"), *options]
    assert run(command) == 0
    assert "tension_N falls as angle_rad rises" in capsys.readouterr().out
    assert run([*command, "--scale", "angle=-1", "--out", str(tmp_path / "out"), "--json"]) == 0
    (shown,) = json.loads(capsys.readouterr().out)["records"]
    assert shown["signs"]["tension_N by angle_rad"] > 0.9
    (read,) = read_measurements(tmp_path / "out").measurements
    np.testing.assert_allclose(read.angle_rad, record.angle_rad, rtol=1e-12)
    np.testing.assert_allclose(read.current_A, record.current_A, rtol=1e-12)
