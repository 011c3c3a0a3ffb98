"""Options that say where the columns of recorded data come from."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from estune.cli.values import check_folder_exists, numbers_from, words_from
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
    given = list(sources)
    files = [text for text in given if text.endswith(".toml") and "=" not in text]
    if len(files) > 1:
        raise InvalidInput(f"--map names {' and '.join(files)}; give one file")
    columns = read_column_map(Path(files[0])) if files else AS_NAMED
    named = words_from("--map", (text for text in given if text not in files))
    factors = words_from("--scale", scales)
    columns = columns.with_options(
        named, words_from("--unit", units), numbers_from(f"{n}={f}" for n, f in factors.items())
    )
    if save is not None:
        columns.save(save)
    return columns
