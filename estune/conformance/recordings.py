"""Conformance suite of a reader of recorded data; see estune.recordings."""

import gzip
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from estune.core.quantities import FloatArray
from estune.recordings.column_map import AS_NAMED, ColumnMap
from estune.recordings.issue import Unusable
from estune.recordings.recording import Recording, read_recording

RATE_Hz = 632.0
SAMPLES = 400

Damage = Callable[[bytes], bytes]
_NOISE = np.random.default_rng(0).bytes(4096)


def _without(data: bytes, begin: int, size: int = 64) -> bytes:
    return data[:begin] + bytes(len(data[begin : begin + size])) + data[begin + size :]


RUINED: dict[str, Damage] = {
    "empty": lambda _: b"",
    "one byte": lambda data: data[:1],
    "zeros": lambda data: bytes(len(data)),
    "noise": lambda _: _NOISE,
    "a page of HTML": lambda _: b"<html><body>404 Not Found</body></html>",
    "compressed": gzip.compress,
}
"""Contents of which nothing can be read."""

DAMAGED: dict[str, Damage] = {
    "first tenth": lambda data: data[: len(data) // 10],
    "first half": lambda data: data[: len(data) // 2],
    "all but the last byte": lambda data: data[:-1],
    "beginning zeroed": lambda data: _without(data, 0),
    "middle zeroed": lambda data: _without(data, len(data) // 2),
    "end zeroed": lambda data: _without(data, len(data) - 64),
    "written twice": lambda data: data + data,
    "a byte lost": lambda data: data[: len(data) // 3] + data[len(data) // 3 + 1 :],
}
"""Contents that some formats can read in part, or read as other values."""


def _at(values: FloatArray, row: int, value: float) -> FloatArray:
    return np.concatenate([values[: row - 1], [value], values[row:]])


SPOILED: dict[str, tuple[Callable[[dict[str, FloatArray]], dict[str, FloatArray]], str]] = {
    "NaN": (lambda c: {**c, "tension_N": _at(c["tension_N"], 17, np.nan)}, "empty or NaN"),
    "infinity": (lambda c: {**c, "angle_rad": _at(c["angle_rad"], 3, np.inf)}, "finite"),
    "nothing measured": (lambda c: {n: c[n] for n in ("time_s", "current_A")}, "there is no"),
    "nothing commanded": (lambda c: {n: c[n] for n in ("time_s", "tension_N")}, "there is n"),
    "two rows": (lambda c: {n: v[:2] for n, v in c.items()}, "rows"),
    "time stands still": (lambda c: {**c, "time_s": 0.0 * c["time_s"]}, "repeats the time|rows"),
}
"""Contents that are no record, with what the message says."""


def columns() -> dict[str, FloatArray]:
    """The columns of a record: a noisy response to a swept current."""
    rng, time_s = np.random.default_rng(1), np.arange(SAMPLES) / RATE_Hz
    current = 0.75 + 0.25 * np.sin(40.0 * time_s**2)
    return {
        "time_s": time_s,
        "setpoint_N": 20.0 * current,
        "current_A": current,
        "tension_N": 20.0 * current + 0.04 * rng.standard_normal(SAMPLES),
        "angle_rad": 1e-3 * current + 1e-5 * rng.standard_normal(SAMPLES),
    }


class ReaderConformance:
    """Tests of a reader: `ending` and `write`, which a subclass must define.

    Attributes:
        ending: Ending of the file's name.
        column_map: Where the format names the columns otherwise.
        stamp_s: Resolution of the format's time stamps; 0 where they are numbers as any.
    """

    ending: ClassVar[str]
    column_map: ClassVar[ColumnMap] = AS_NAMED
    stamp_s: ClassVar[float] = 0.0

    def write(self, path: Path, columns: Mapping[str, FloatArray]) -> None:
        """Writes the columns with the format's own library."""
        raise NotImplementedError("define write: a file of your format with these columns")

    def bytes_of(self, path: Path) -> Path:
        """The file that is damaged, where the path is a folder."""
        return path

    def read(self, path: Path) -> Recording:
        """The recording, by the map."""
        return read_recording(path, self.column_map)

    def test_columns_are_read_back_exactly(self, tmp_path: Path) -> None:
        written, path = columns(), tmp_path / f"record{self.ending}"
        self.write(path, written)
        recording = self.read(path)
        (part,) = recording.parts
        assert part.keys() == written.keys()
        for name, values in written.items():
            if name == "time_s" and self.stamp_s:
                assert np.abs(part[name] - values).max() <= self.stamp_s
            else:
                assert np.array_equal(part[name], values)
        assert recording.sampling_Hz == pytest.approx(RATE_Hz, rel=1e-6)

    @pytest.mark.parametrize("damage", RUINED)
    def test_ruined_file_is_refused_in_one_line(self, tmp_path: Path, damage: str) -> None:
        assert self._damaged(tmp_path, RUINED[damage]) is not None

    @pytest.mark.parametrize("damage", DAMAGED)
    def test_damaged_file_is_read_or_refused_in_one_line(
        self, tmp_path: Path, damage: str
    ) -> None:
        self._damaged(tmp_path, DAMAGED[damage])

    @pytest.mark.parametrize("kind", SPOILED)
    def test_file_that_is_no_record_is_refused(self, tmp_path: Path, kind: str) -> None:
        spoil, message = SPOILED[kind]
        path = tmp_path / f"record{self.ending}"
        self.write(path, spoil(columns()))
        with pytest.raises(Unusable, match=message) as refusal:
            self.read(path)
        assert "\n" not in str(refusal.value)

    def _damaged(self, folder: Path, damage: Damage) -> str | None:
        """The message on a damaged file; None where it is read."""
        path = folder / f"record{self.ending}"
        self.write(path, columns())
        target = self.bytes_of(path)
        target.write_bytes(damage(target.read_bytes()))
        try:
            self.read(path)
        except Unusable as error:
            message = str(error)
        else:
            return None
        assert message
        assert "\n" not in message
        return message
