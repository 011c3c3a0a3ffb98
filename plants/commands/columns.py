"""Options that say where the columns of recorded data come from."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from estune.cli.values import check_folder_exists, numbers_from
from estune.errors import InvalidInput
from estune.recordings.column_map import AS_NAMED, ColumnMap, read_column_map

Sources = Annotated[tuple[str, ...], Parameter(name="--map", negative=(), show_default=False)]


def column_map(
    sources: Iterable[str], units: Iterable[str], scales: Iterable[str], save: Path | None
) -> ColumnMap:
    """The map of the options, on top of that of a file; written to a file where one is named.

    Raises:
        InvalidInput: an option cannot be used.
    """
    check_folder_exists("--save-map", save)
    given = _listed(sources)
    files = [text for text in given if text.endswith(".toml") and "=" not in text]
    if len(files) > 1:
        raise InvalidInput(f"--map names {' and '.join(files)}; give one file")
    columns = read_column_map(Path(files[0])) if files else AS_NAMED
    named = _texts(text for text in given if text not in files)
    columns = columns.with_options(named, _texts(_listed(units)), numbers_from(_listed(scales)))
    if save is not None:
        columns.save(save)
    return columns


def _listed(texts: Iterable[str]) -> list[str]:
    return [part for text in texts for part in text.split(",") if part]


def _texts(assignments: Iterable[str]) -> dict[str, str]:
    pairs = [text.partition("=") for text in assignments]
    for name, equals, value in pairs:
        if not (name and equals and value):
            raise InvalidInput(f"{name + equals + value!r} is not of the form COLUMN=VALUE")
    return {name.strip(): value.strip() for name, _, value in pairs}
