"""What to measure next, as a diagnosis asks for it: a trial of a rig, or a record."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.run.trial_file import SUFFIX, TrialFile


@dataclass(frozen=True, slots=True)
class NextExperiment:
    """A trial worth running next.

    Attributes:
        trial: The trial, ready to be written to a file.
        separation: Predicted mean square difference between the models, in variances; None where
            no two models are compared.
        tried: The separation, or else the score from 0 to 1, of every experiment considered.
    """

    trial: TrialFile
    sentence: str
    separation: float | None
    tried: Mapping[str, float]

    @property
    def file_name(self) -> str:
        """Name of the trial's file."""
        return f"{self.trial.name}{SUFFIX}"

    @property
    def command(self) -> str:
        """Command line that runs it."""
        return f"estune run-experiment {self.file_name} tcp/127.0.0.1:7447 --data data"

    def write(self, folder: Path) -> Path:
        """Writes the trial's file into a folder.

        Raises:
            InvalidInput: it cannot be written there.
        """
        return self.trial.write(folder)


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
