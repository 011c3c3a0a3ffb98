"""Files of every kind that a command reads, changed at random, and their readers."""

import json
import logging
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import plants
from estune.cli import sweep
from estune.cli.daemon import EXAMPLE as DAEMON
from estune.daemon.config_check import check_file
from estune.errors import EstuneError
from estune.hardware import read_config
from estune.hardware.schedule_file import read_schedule
from estune.proof.patch import Patch, patch_of, read_patch
from estune.recordings.recording import read_recording
from estune.remote.security import read_security
from estune.run.results.export import columns, metadata
from estune.run.trial_file import read_trial
from estune.studies.sweep.design import read_design
from experiments.inert_rig import RECORD
from experiments.misuse.mutations import mutated, with_extreme
from plants.commands import explain
from plants.emulator import RIG_FILE

_CONSTANT = {"form": "constant", "offset": 0.02}
_LAW = {
    "length_m": [0.5, 1.4],
    "tension_N": [15.0, 15.0],
    "gains": dict.fromkeys(("P", "D", "setpoint_filter_s"), _CONSTANT)
    | {"I": {"form": "linear", "offset": 50.0, "slope": -18.5}},
}
_TRIAL = {
    "estune_trial": 1,
    "name": "step",
    "why": "",
    "profile": {
        "kind": "step",
        "preload_N": 15.0,
        "step_N": 5.0,
        "step_at_s": 0.1,
        "duration_s": 1.0,
    },
    "gains": None,
}
_ACCESS = '[password]\nusers_file = "users"\n\n[access]\ncommand = ["anna"]\nstop = ["ben"]\n'
_MODEL = '\n[[effects]]\nname = "coulomb_friction"\ntorque_Nm = 0.015\n'
_PLANT = "[linear_plant]\nnumerator = [1.0]\ndenominator = [1.0, 2.0]\nsettling_time_s = 3.0\n"
_FRICTION = {"friction": {"coulomb_Nm": 0.02, "static_Nm": 0.02, "stribeck_rad_s": 1.0}}


class Kind(NamedTuple):
    """Files of one kind.

    Attributes:
        name: Name of the file.
        text: A valid one.
        read: Its reader.
    """

    name: str
    text: str
    read: Callable[[Path], Any]


def kinds(folder: Path) -> list[Kind]:
    """All of them; files beside those are written to the folder."""
    (folder / "users").write_text("anna:one\nben:two\n")
    (folder / "users").chmod(0o600)
    patch = folder / "seed.remedy.json"
    Patch("coulomb_friction", "feed friction forward", "", _FRICTION).write(patch)
    names = columns(RECORD)
    row = ",".join(str(values[1]) for name, values in names.items() if name != "time_s")
    table = "\n".join([",".join(names), *(f"{k / 632.0},{row}" for k in range(80))])
    model = explain.EXAMPLE.read_text() + _MODEL
    return [
        Kind("rig.toml", RIG_FILE.read_text(), read_config),
        Kind("model.toml", model, plants.load_model),
        Kind("plant.toml", _PLANT, plants.load_model),
        Kind("sweep.toml", sweep.EXAMPLE.read_text(), read_design),
        Kind("daemon.toml", DAEMON.read_text(), check_file),
        Kind("access.toml", _ACCESS, read_security),
        Kind("law.json", json.dumps(_LAW), read_schedule),
        Kind("one.trial.json", json.dumps(_TRIAL), read_trial),
        Kind("one.remedy.json", patch.read_text(), read_patch),
        Kind("diagnosis.json", json.dumps({"remedies": [], "effects": []}), patch_of),
        Kind("record.csv", table, read_recording),
        Kind("record.json", json.dumps(metadata(RECORD)), _beside(table)),
        Kind(
            "record.jsonl",
            "\n".join(
                f'{{"time_s": {k / 632.0}, "tension_N": 1.5, "current_A": 1}}' for k in range(80)
            ),
            read_recording,
        ),
    ]


def _beside(table: str) -> Callable[[Path], Any]:
    """The reader of the metadata beside a table."""

    def read(path: Path) -> Any:
        path.with_suffix(".csv").write_text(table)
        return read_recording(path.with_suffix(".csv"))

    return read


class Files:
    """Changed files, read one after the other.

    Attributes:
        counts: Number of files by kind, refused or read.
        faults: What their readers raised that is no refusal.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder, self._random = folder, Random(seed)  # noqa: S311  nothing here is secret
        self._kinds = kinds(folder)
        self._others = [kind.text.encode() for kind in self._kinds]
        self.counts: Counter[str] = Counter()
        self.faults: list[str] = []

    def _changed(self, data: bytes) -> bytes:
        """Damaged anywhere; or, as often, with values that are extreme, in order otherwise."""
        if self._random.random() < 0.5:
            return mutated(self._random, data, self._others)
        for _ in range(self._random.randint(1, 3)):
            data = with_extreme(self._random, data)
        return data

    def read(self, number: int) -> None:
        """Writes and reads a number of them."""
        logging.disable()
        for k in range(number):
            kind = self._kinds[k % len(self._kinds)]
            data = self._changed(kind.text.encode())
            path = self._folder / kind.name
            path.write_bytes(data)
            path.chmod(0o600)
            try:
                kind.read(path)
            except EstuneError:
                self.counts[f"{kind.name}, refused"] += 1
            except Exception as error:  # noqa: BLE001  this experiment looks for them
                self.faults.append(f"{kind.name} {data!r} raises {type(error).__name__}: {error}")
            else:
                self.counts[f"{kind.name}, read"] += 1
        logging.disable(logging.NOTSET)
