"""Cases that a change of the diagnosis is tried on: seeds that anything may be chosen on."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estune.recordings.column_map import AS_NAMED, ColumnMap
from experiments import hidden_machines
from experiments.hidden_scores import choice, measurement, model
from experiments.independent_drives.drives import draw
from experiments.independent_drives.logs import Logger
from plants.models.model_file import load_model

CASES = (
    *("servo 1", "link 2", "spindle 1", "stage 5", "unloaded 20000", "none_unloaded 20000"),
    *("none 20000", "plain 20001", "plain 20002", "outside 20000", "none 20001", "stage 20000"),
    *("plain 20003", "none_no_encoder 20000", "steps_only 20000", "noise5 20000"),
    *("wrong_base 20000", "left_out 20000", "outside 20001", "two 20000", "two 20001"),
)
"""Kinds with the seed of a hidden machine, or a drive's number; the shortest first."""
DRIVES, DRIVE_SEED = ("servo", "stage", "spindle", "link"), 3000


class DiagnosisCase(NamedTuple):
    """What a diagnosis is asked."""

    model: Any
    records: Any
    effects: list[str] | None
    columns: ColumnMap


def case_of(name: str, folder: Path) -> DiagnosisCase:
    """A case by its name; a drive writes its files into a folder."""
    kind, number = name.split()
    if kind in DRIVES and int(number) < 100:
        rng = np.random.default_rng([DRIVE_SEED, int(number), 1, *kind.encode()])
        logger = Logger.drawn(kind, rng)
        logger.write(draw(kind, int(number), DRIVE_SEED), folder, rng)
        return DiagnosisCase(
            load_model(folder / "model.toml"), folder / "logs", None, logger.columns
        )
    drawn, secret = hidden_machines.draw(int(number), kind)
    records = [measurement(record) for record in drawn.records]
    return DiagnosisCase(model(drawn), records, choice(drawn, secret), AS_NAMED)
