"""A motion, or a command, to be recorded next, as a table."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput


@dataclass(frozen=True, slots=True, eq=False)
class NextRecording:
    """A motion, or a command, to be recorded next.

    Attributes:
        columns: The table by its heads, shape (rows,) each; empty where the words say it all.
    """

    sentence: str
    columns: Mapping[str, FloatArray]

    file_name = "next_recording.csv"

    def write(self, folder: Path) -> Path | None:
        """Writes the table into a folder; None where there is none.

        Raises:
            InvalidInput: it cannot be written there.
        """
        if not self.columns:
            return None
        written = io.StringIO()
        table = csv.writer(written, lineterminator="\n")
        table.writerow(self.columns)
        rows = zip(*self.columns.values(), strict=True)
        table.writerows([f"{value:.7g}" for value in row] for row in rows)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / self.file_name).write_text(written.getvalue(), "utf-8")
        except OSError as error:
            raise InvalidInput(f"{folder}: it cannot be written: {error.strerror}") from error
        return folder / self.file_name
