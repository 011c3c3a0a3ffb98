"""What a file from outside may cost before it is refused."""

import math

import numpy as np
import pytest
from scipy.io import savemat

from estune.errors import InvalidInput
from estune.recordings.issue import Unusable
from estune.recordings.raw_file import BAG, formats, read_raw
from estune.support import file_limits
from estune.support.file_limits import DEPTH_MAX, OPTION
from estune.support.toml_file import read_toml

TABLE = "time_s,tension_N,current_A\n0.0,1.0,0.1\n0.1,2.0,0.2\n0.2,3.0,0.3\n"


def test_small_file_that_unpacks_to_much_is_refused_and_read_once_the_limit_is_raised(
    tmp_path, monkeypatch
):
    path = tmp_path / "step.mat"
    savemat(path, {"tension": np.zeros(12_000_000)}, do_compression=True)
    assert path.stat().st_size < 200_000
    monkeypatch.setattr(file_limits, "MEMORY_MIN", 2**26)
    with pytest.raises(Unusable, match=rf"unpack the file .* MB.*raise .* {OPTION}=4"):
        read_raw(path)
    monkeypatch.setenv(OPTION, "8")
    assert read_raw(path).channels[0].values.size == 12_000_000


@pytest.mark.parametrize("ending", [one for one in formats() if one != BAG])
def test_every_format_has_the_limit_of_size(tmp_path, monkeypatch, ending):
    monkeypatch.setattr(file_limits, "SIZE_MAX", 100)
    path = tmp_path / f"step{ending}"
    path.write_bytes(bytes(101))
    with pytest.raises(Unusable, match="is the limit"):
        read_raw(path)


def test_too_many_rows_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "step.csv"
    path.write_text(TABLE)
    monkeypatch.setattr(file_limits, "ROWS_MAX", 2)
    with pytest.raises(Unusable, match="3 rows, 2 is the limit"):
        read_raw(path)


def test_text_of_one_line_is_refused_without_reading_it_whole(tmp_path, monkeypatch):
    path = tmp_path / "step.csv"
    path.write_text("1," * 1_000_000)
    monkeypatch.setattr("pathlib.Path.read_bytes", lambda _: pytest.fail("read whole"))
    with pytest.raises(Unusable, match="line 1 is longer than 1048576 bytes"):
        read_raw(path)


@pytest.mark.parametrize(
    "text",
    [
        f"x = {'[' * 5000}{']' * 5000}",
        f"{'.'.join(['a'] * 3000)} = 1",
        f"x = {'[' * (DEPTH_MAX + 1)}{']' * (DEPTH_MAX + 1)}",
    ],
)
def test_nested_settings_are_refused(tmp_path, text):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"rig\.toml: nested"):
        read_toml(path)


@pytest.mark.parametrize("name", ["step.jsonl", "step.json"])
def test_nested_json_is_refused(tmp_path, name):
    from estune.recordings.recording import read_recording  # noqa: PLC0415  beside the others

    table = tmp_path / ("step.csv" if name.endswith(".json") else name)
    table.write_text(TABLE)
    (tmp_path / name).write_text("[" * 100_000)
    with pytest.raises(Unusable, match="nested too deeply"):
        read_recording(table)


def test_whole_number_of_hundreds_of_digits_is_refused_or_infinite(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text(f"sampling_Hz = {'1' * 400}\n")
    with pytest.raises(InvalidInput, match="a whole number is above 1e"):
        read_toml(file)
    assert file_limits.parse_json(f"[{'1' * 400}, {2**63}]") == [math.inf, 2**63]


@pytest.mark.parametrize("text", ["four", "0", "-1", "nan", "1e9"])
def test_option_that_is_no_factor_is_refused(tmp_path, monkeypatch, text):
    monkeypatch.setenv(OPTION, text)
    with pytest.raises(InvalidInput, match="give a number above zero"):
        file_limits.check_size(tmp_path / "x.csv", 1)
