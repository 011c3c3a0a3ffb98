"""A diagnosis in the making: records, map of their columns, model, and the search."""

import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from estune.cli.values import command_line, numbers_from
from estune.errors import EstuneError, InvalidInput
from estune.recordings.column_map import AS_NAMED, ColumnMap
from estune.recordings.column_names import TABLE_COLUMNS
from estune.recordings.issue import Unusable
from estune.recordings.long_form import separated
from estune.recordings.raw_file import formats, is_readable, read_raw
from estune.recordings.units import NO_DRUM, UNITS
from plants.diagnosis.data.measured_record import CHANNELS, MeasuredRecord
from plants.diagnosis.data.records import drum_of, read_measurements
from plants.explain_page.preview import preview, warnings
from plants.explain_page.search_process import SearchProcess
from plants.models.model_file import load_model
from plants.models.model_tables import KINDS, ModelKind, form_of

DATA, MAP, MODEL = "data", "columns.toml", "model.toml"
IMPROVED, REPORT, RESULT = "improved.toml", "report.html", "diagnosis.json"
"""Names in the folder of a workbook."""
FILE_MAX_BYTES, DATA_MAX_BYTES = 200_000_000, 1_000_000_000
"""Largest file, and all files, that a page may send."""
SHOWN, LISTED = 12, 40
"""Records that are drawn, and files whose channels are listed."""
POINTS_MAX = 800
"""Points of a curve."""


@dataclass(eq=False)
class Workbook:
    """What one page works on. Its methods raise `InvalidInput` with what to correct.

    Attributes:
        folder: Where its files are kept; made with the first of them.
        data: Records: a folder or a file. None until there are any.
        model: The model, as `estune explain --model` takes it; empty until there is one.
        columns: Where the columns come from, in files that name them otherwise.
    """

    folder: Path
    data: Path | None = None
    model: str = ""
    columns: ColumnMap = AS_NAMED
    search: SearchProcess = field(default_factory=SearchProcess)

    def file_for(self, name: str) -> Path:
        """The path at which a file given by name is to be stored."""
        path = self.folder / DATA / Path(name).name
        if path.name != name or name.startswith("."):
            raise InvalidInput(f"{name!r} is no name of a file")
        if not (is_readable(path) or path.suffix == ".json"):
            raise InvalidInput(
                f"{name} is no record; give {', '.join(formats())}, or .json with the metadata"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        self.data = path.parent
        return path

    def room_bytes(self) -> int:
        """How many bytes the next file may have."""
        stored = sum(path.stat().st_size for path in (self.folder / DATA).glob("*"))
        return min(FILE_MAX_BYTES, DATA_MAX_BYTES - stored)

    def remove_files(self) -> None:
        """Removes the files that were given to the page."""
        with suppress(FileNotFoundError):
            shutil.rmtree(self.folder / DATA)
        self.data = None

    def use(self, path: str) -> None:
        """Takes the records of a folder, or a file, where they are."""
        data = Path(path).expanduser()
        if not path.strip() or not data.exists():
            raise InvalidInput(f"{path or 'the path'} does not exist on this machine")
        self.data = data

    def map_columns(self, given: Mapping[str, Any]) -> None:
        """Takes the `from`, `unit` and `scale` of columns by name; what is empty is not given."""

        def of(key: str) -> dict[str, str]:
            return {name: str(one[key]) for name, one in given.items() if one.get(key, "") != ""}

        try:
            sources, units, factors = of("from"), of("unit"), of("scale")
        except AttributeError:
            raise InvalidInput("a column is given by its from, unit and scale") from None
        scales = numbers_from(f"{name}={text}" for name, text in factors.items())
        self.columns = AS_NAMED.with_options(sources, units, scales)

    def use_model(self, *, toml: str = "", reference: str = "") -> None:
        """Takes a model: the text of a model file, its path, or module:attribute."""
        if toml:
            path = self.folder / MODEL
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(toml, "utf-8")
            reference = str(path)
        if not reference:
            raise InvalidInput("give a model: a file such as reel.toml, or plants:reference_reel")
        self.model = ""
        load_model(reference)
        self.model = reference

    def understood(self) -> dict[str, Any]:
        """How the records are understood, as `estune records` shows it, with their curves."""
        if self.data is None:
            raise InvalidInput("there are no records yet; drop a file, or open a folder")
        drum = drum_of(load_model(self.model)) if self.model else NO_DRUM
        shown: dict[str, Any] = {"data": str(self.data), "channels": _channels(self.data)}
        shown |= {"columns": list(TABLE_COLUMNS), "units": list(UNITS)}
        shown["map"] = {
            name: one.model_dump(
                by_alias=True, include={"from_", "unit", "scale"}, exclude_defaults=True
            )
            for name, one in self.columns.column.items()
        }
        try:
            contents = read_measurements(self.data, self.columns, drum)
        except EstuneError as error:
            return shown | {"fault": str(error), "records": [], "sources": [], "findings": []}
        previews = [preview(m) for m in contents.measurements]
        told = [f"{p.name}: {sentence}" for p in previews for sentence in warnings(p)]
        return shown | {
            "fault": "",
            "records": [p._asdict() for p in previews],
            "curves": [_curve(m) for m in contents.measurements[:SHOWN]],
            "sources": [source._asdict() for source in contents.sources],
            "findings": [f"{issue.level}: {issue}" for issue in contents.findings] + told,
        }

    def begin(self) -> None:
        """Begins `estune explain` in a process of its own."""
        if self.data is None or not self.model:
            missing = "records" if self.data is None else "a model"
            raise InvalidInput(f"there is nothing to explain yet; give {missing}")
        self.folder.mkdir(parents=True, exist_ok=True)
        for name in (REPORT, IMPROVED, RESULT):
            (self.folder / name).unlink(missing_ok=True)
        self.search.begin(self._options(), self.folder / RESULT)

    @property
    def command(self) -> str:
        """The command that repeats the search in a terminal."""
        return command_line("explain", *self._options())

    def state(self) -> dict[str, Any]:
        """State of the search, and its result once there is one."""
        shown: dict[str, Any] = self.search.state()
        if shown["state"] == "done":
            improved = self.folder / IMPROVED
            shown["result"] = json.loads((self.folder / RESULT).read_text("utf-8"))
            shown["toml"] = improved.read_text("utf-8") if improved.exists() else ""
            shown["improved"], shown["command"] = str(improved), self.command
        return shown

    def _options(self) -> list[str]:
        options = ["--model", self.model, "--data", str(self.data)]
        if self.columns != AS_NAMED:
            self.columns.save(self.folder / MAP)
            options += ["--map", str(self.folder / MAP)]
        files = {"--report": REPORT, "--save": IMPROVED}
        return options + [
            word for o, name in files.items() for word in (o, str(self.folder / name))
        ]


def form() -> list[dict[str, Any]]:
    """Kinds of models: their keys, what each takes, its default, and what must be given."""
    kinds = ((kind, *_defaults(kind)) for kind in KINDS)
    return [
        {
            "table": kind.table,
            "needs": needs,
            "keys": [
                {"name": name, "form": form_of(reader), "default": defaults.get(name, "")}
                for name, reader in kind.keys.items()
            ],
        }
        for kind, defaults, needs in kinds
    ]


def _defaults(kind: ModelKind) -> tuple[dict[str, Any], str]:
    """The values of a model of which nothing is given; where something must be, what."""
    try:
        values = kind.values(kind.make())
    except EstuneError as error:
        return {}, str(error)
    return {name: v for name, v in values.items() if isinstance(v, int | float | str)}, ""


def _channels(data: Path) -> list[dict[str, str]]:
    """The channels of the files, each name once, with the unit that its file states."""
    files = [data] if data.is_file() else sorted(p for p in data.rglob("*") if is_readable(p))
    found: dict[str, str] = {}
    for path in files[:LISTED]:
        with suppress(Unusable):  # the reading of the records says why
            found |= {
                c.name: found.get(c.name) or c.unit for c in separated(read_raw(path)).channels
            }
    return [{"name": name, "unit": unit} for name, unit in found.items()]


def _curve(m: MeasuredRecord) -> dict[str, Any]:
    every = max(1, -(-m.samples // POINTS_MAX))
    named = {"time_s": m.time_s} | {name: m.channel(name) for name in CHANNELS}
    columns = {name: column for name, column in named.items() if column is not None}
    return {"name": m.name} | {name: column[::every].tolist() for name, column in columns.items()}
