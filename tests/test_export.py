"""Exported records: equal bit for bit, in the documented columns."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

import estune
from estune.core.gains import GAIN_NAMES
from estune.errors import JournalError
from estune.run.journal import Journal
from estune.run.loop import Stopped
from estune.run.results.export import export_run, export_trials
from tests.support_runs import ArithmeticRig

COLUMNS = ["time_s", "setpoint_N", "tension_N", "current_A", "angle_rad", "flags"]
METADATA = {
    *("rig", "trial_id", "sampling_Hz", "cable_length_m", "preload_N", "loop", "gains", "profile"),
    *("outcome", "reason", "started_at", "software"),
}


class Referenced(ArithmeticRig):
    """Rig with an additional, external gauge."""

    def run(self, request):
        record = super().run(request)
        return replace(record, reference_N=record.tension_N / 3.0)


@pytest.fixture(params=[ArithmeticRig, Referenced])
def run(request, tmp_path):
    return estune.tune(
        request.param(), trials=2, repeats=1, folder=tmp_path, run="run", watch=None
    )


def read_columns(path):
    """Columns and metadata of an exported trial, read by other libraries."""
    if path.suffix == ".parquet":
        table = pq.read_table(path)
        columns = {name: table[name].to_numpy() for name in table.column_names}
        return columns, json.loads(table.schema.metadata[b"estune"])
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            reader = make_reader(file)
            rows = [json.loads(message.data) for _, _, message in reader.iter_messages()]
            (about,) = (m.metadata["record"] for m in reader.iter_metadata())
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}, json.loads(about)
    names = path.read_text().splitlines()[0].split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return dict(zip(names, values.T, strict=True)), json.loads(
        path.with_suffix(".json").read_text()
    )


@pytest.mark.parametrize("form", ["csv", "parquet", "mcap"])
def test_export_returns_every_record_bit_for_bit(run, form, tmp_path):
    written = export_trials(run.folder, tmp_path / "out", form)
    assert [path.name for path in written] == [f"{e.trial_id}.{form}" for e in run.entries]
    for path, entry in zip(written, run.entries, strict=True):
        record = run.record(entry.number)
        columns, about = read_columns(path)
        referenced = ["reference_N"] if record.reference_N is not None else []
        assert list(columns) == COLUMNS[:-1] + referenced + COLUMNS[-1:]
        for name, column in columns.items():
            np.testing.assert_array_equal(column, getattr(record, name))
        assert about.keys() == METADATA
        assert about["gains"] == dict(zip(GAIN_NAMES, entry.gains.as_tuple(), strict=True))
        assert about["outcome"] == "done"


class Heater(ArithmeticRig):
    """A rig that is no reel."""

    def describe(self):
        return replace(super().describe(), measurement="temperature, degC", command="duty, %")


def test_metadata_of_a_record_of_no_reel_names_its_signals(tmp_path):
    estune.tune(Heater(), trials=1, repeats=1, folder=tmp_path, run="run", watch=None)
    first = export_trials(tmp_path / "run", tmp_path / "out", "csv")[0]
    _, about = read_columns(first)
    assert (about["measurement"], about["command"]) == ("temperature, degC", "duty, %")


def test_repeated_export_replaces_all_files(run, tmp_path):
    out = tmp_path / "out"
    first = export_trials(run.folder, out, "csv")
    content = first[0].read_bytes()
    first[0].write_text("half a fi")
    assert export_trials(run.folder, out, "csv") == first
    assert first[0].read_bytes() == content
    assert {path.suffix for path in out.iterdir()} == {".csv", ".json"}
    assert len(list(out.iterdir())) == 2 * len(first)


def test_export_omits_trial_without_record(tmp_path):
    class Stopping(ArithmeticRig):
        def run(self, request):
            if request.number == 2:
                raise KeyboardInterrupt
            return super().run(request)

    with pytest.raises(Stopped):
        estune.tune(Stopping(), folder=tmp_path, run="cut", watch=None)
    with Journal.open(tmp_path / "cut") as journal:
        assert len(list(journal.entries())) == 3
    assert len(export_trials(tmp_path / "cut", tmp_path / "out", "csv")) == 2


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_whole_run_export_holds_every_sample_and_trial(run, form, tmp_path):
    seen = []
    files = export_run(run.folder, tmp_path, form, lambda done, total: seen.append((done, total)))
    read_file = pd.read_csv if form == "csv" else pd.read_parquet
    samples, trials = map(read_file, files)
    assert [file.name for file in files] == [f"samples.{form}", f"trials.{form}"]
    assert seen == [(n + 1, len(run.entries)) for n in range(len(run.entries))]
    assert list(trials["trial_id"]) == [entry.trial_id for entry in run.entries]
    assert list(trials["cost"]) == [entry.cost for entry in run.entries]
    assert list(zip(*(trials[name] for name in GAIN_NAMES), strict=True)) == [
        entry.gain_values for entry in run.entries
    ]
    for number, rows in samples.groupby("number"):
        record = run.record(number)
        for name in COLUMNS:
            np.testing.assert_array_equal(rows[name], getattr(record, name))
        assert rows["reference_N"].isna().all() == (record.reference_N is None)
    assert samples["number"].nunique() == len(run.entries)


def test_export_names_a_folder_that_cannot_be_written(run, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(JournalError, match="file"):
        export_run(run.folder, tmp_path / "file" / "out", "csv")
