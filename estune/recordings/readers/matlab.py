"""MATLAB files: version 5 by scipy; version 7.3, tables and timetables by mat-io.

Vectors and the columns of matrices are channels, fields of structures `struct.field`; scalars and
texts are metadata. Objects of other classes, such as Simulink's timeseries, are not read.
"""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estune.recordings.issue import Unusable
from estune.recordings.raw_file import Channel, RawFile

_OBJECTS = "__function_workspace__"
"""Key under which scipy keeps what belongs to objects, which it cannot read."""


def read_mat(path: Path) -> RawFile:
    """Reads all variables."""
    from scipy.io import loadmat  # noqa: PLC0415  slow to import
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of objects, which are read below
            variables = loadmat(path, simplify_cells=True)
    except MatReadError as error:
        raise Unusable(f"{error}; save it again") from error
    except NotImplementedError:
        variables = _by_matio(path)
    if _OBJECTS in variables:
        variables = _by_matio(path)
    channels: list[Channel] = []
    metadata: dict[str, Any] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            found, about = _read(name, value)
            channels += found
            metadata |= {} if about is None else {name: about}
    return RawFile(tuple(channels), metadata)


def _by_matio(path: Path) -> dict[str, Any]:
    from matio import load_from_mat  # noqa: PLC0415  an optional dependency

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of time zones and formats, which do not matter here
        return dict(load_from_mat(path, add_table_attrs=True))


def _read(name: str, value: Any) -> tuple[list[Channel], Any]:
    """Channels of a variable, and its value where it is metadata."""
    if hasattr(value, "columns"):
        return list(_of_table(name, value)), None
    if isinstance(value, dict):
        return _of_fields(name, value)
    if isinstance(value, str | int | float):
        return [], value
    if isinstance(value, np.ndarray):
        return _of_array(name, value.squeeze())
    kind = getattr(value, "classname", type(value).__name__)
    raise Unusable(f"it is a {kind}; save time and values as vectors", name)


def _of_array(name: str, array: NDArray[Any]) -> tuple[list[Channel], Any]:
    if array.dtype.names and array.ndim == 0:
        return _of_fields(name, {field: array[field].item() for field in array.dtype.names})
    if array.ndim == 0:
        return [], array.item()
    if array.dtype.names or array.dtype.kind in "OUS" or array.ndim > 2:
        return [], None  # lists of structures or texts, pictures
    if array.ndim == 1:
        return [Channel(name, array)], None
    return [Channel(f"{name}[{k}]", column) for k, column in enumerate(array.T)], None


def _of_fields(name: str, fields: dict[str, Any]) -> tuple[list[Channel], Any]:
    channels: list[Channel] = []
    metadata: dict[str, Any] = {}
    for field, value in fields.items():
        found, about = _read(f"{name}.{field}", value)
        channels += found
        metadata |= {} if about is None else {field: about}
    return channels, metadata or None


def _of_table(name: str, table: Any) -> Iterator[Channel]:
    units = [str(unit) for unit in np.ravel(table.attrs.get("varUnits", []))]
    if table.index.dtype.kind in "mM":
        yield Channel(f"{name}.{table.index.name or 'Time'}", table.index.to_numpy())
    for k, column in enumerate(table.columns):
        unit = units[k] if len(units) == table.shape[1] else ""
        yield Channel(f"{name}.{column}", table[column].to_numpy(), unit)
