"""One file of recorded data as its format gives it, and how the reader of a format is found."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from estune.core.quantities import FloatArray
from estune.errors import InvalidInput
from estune.recordings.heading import heading
from estune.recordings.issue import Unusable
from estune.support.file_limits import bounded_memory, check_lines, check_rows, check_size
from estune.support.plugins import load_plugin, plugins

ENTRY_POINTS = "estune.record_readers"
"""Entry point group by which a package offers readers, by the ending of the file's name."""


class Channel(NamedTuple):
    """One channel of a file.

    Attributes:
        name: As the file gives it: `column`, `struct.field`, `group/channel`, `/topic.field[i]`.
        values: Shape (samples,): numbers, time stamps, or objects where a cell is no number.
        unit: As the file states it, or empty.
        time_s: Stamps of the channel's own, s, ascending, same shape; None where the file has one
            time channel for all, or none.
    """

    name: str
    values: NDArray[Any]
    unit: str = ""
    time_s: FloatArray | None = None


class RawFile(NamedTuple):
    """The channels of a file, and what it says beside them: rate, cable length, gains."""

    channels: tuple[Channel, ...]
    metadata: dict[str, Any]


Reader = Callable[[Path], RawFile]
"""Reads a file; raises `Unusable` with row and remedy, or anything where the file is damaged."""

BAG = "metadata.yaml"
"""File by which a folder is a ROS 2 bag."""

_NAMED_ONLY = (".txt", ".log", ".bin")
"""Endings of files that are read where they are named: in a folder they are notes and logs of
programs as a rule."""

_TEXTS = (".csv", ".tsv", ".txt", ".lvm", ".jsonl", ".ndjson", ".lp", ".log")

_OWN = {
    ".csv": "text:read_text",
    ".tsv": "text:read_text",
    ".txt": "program_log:read_log",
    ".parquet": "parquet:read_parquet",
    ".mat": "matlab:read_mat",
    ".bag": "ros:read_bag",
    ".db3": "ros:read_bag",
    BAG: "ros:read_bag",
    ".mcap": "mcap:read_mcap",
    ".zstd": "mcap:refuse_compressed",
    ".tdms": "tdms:read_tdms",
    ".xlsx": "spreadsheet:read_spreadsheet",
    ".lvm": "lvm:read_lvm",
    ".jsonl": "json_lines:read_json_lines",
    ".ndjson": "json_lines:read_json_lines",
    ".lp": "line_protocol:read_line_protocol",
    ".log": "program_log:read_log",
    ".ulg": "flight_log:read_ulog",
    ".bin": "flight_log:read_ardupilot",
    ".blackbox": "black_box:read_black_box",
}
"""Readers by the ending, module and function in `estune.recordings.readers`."""


def formats() -> tuple[str, ...]:
    """Endings of the files that can be read."""
    return (*(ending for ending in _OWN if ending not in (BAG, ".zstd")), *plugins(ENTRY_POINTS))


def is_readable(path: Path) -> bool:
    """Whether a reader is known for a file; the parts of a ROS 2 bag belong to its folder."""
    if _is_bag(path.parent):
        return path.name == BAG
    ending = path.suffix.lower()
    return ending not in _NAMED_ONLY and (ending in _OWN or ending in plugins(ENTRY_POINTS))


def _is_bag(folder: Path) -> bool:
    try:
        return b"rosbag2_bagfile_information" in folder.joinpath(BAG).read_bytes()
    except OSError:
        return False


def read_raw(path: Path) -> RawFile:
    """Reads a file with the reader of its ending.

    Raises:
        Unusable: it cannot be read; the message is one line.
    """
    try:
        reader, size = _reader(path), _size(path)
        check_size(path, size)
        if path.suffix.lower() in _TEXTS:
            check_lines(path)
        with bounded_memory(size):
            raw = reader(path)
        check_rows(max((channel.values.size for channel in raw.channels), default=0))
    except Unusable:
        raise
    except ModuleNotFoundError as error:
        raise Unusable(_missing(path, error)) from error
    except InvalidInput as error:
        raise Unusable(str(error)) from error
    except RecursionError as error:
        raise Unusable("the file is nested too deeply; write it flatter") from error
    except UnicodeDecodeError as error:
        raise Unusable("the file is no UTF-8 text; save it as UTF-8") from error
    except OSError as error:
        what = error.strerror or "the file is damaged or of another format"
        raise Unusable(f"{what}; copy or export it again") from error
    except Exception as error:  # a format's library may raise anything on damage
        why = " ".join(f"{type(error).__name__} {error}".split())[:100]
        raise Unusable(
            f"the file is damaged or of another format ({why}); copy or export it again"
        ) from error
    if not any(channel.values.size for channel in raw.channels):
        raise Unusable("the file has no rows; record the trial again or remove the file")
    return raw._replace(channels=tuple(map(_with_unit, raw.channels)))


def _size(path: Path) -> int:
    """Size of a file, or of all files of a bag."""
    files = path.parent.iterdir() if path.name == BAG else (path,)
    return sum(file.stat().st_size for file in files)


def _with_unit(channel: Channel) -> Channel:
    """The channel with the unit that stands apart in its name, where its file states no other."""
    own = heading(channel.name)
    return channel._replace(unit=own.unit) if own.said and not channel.unit else channel


def _reader(path: Path) -> Reader:
    ending = path.suffix.lower()
    where = _OWN.get(path.name, _OWN.get(ending))
    if where is None:
        offered = plugins(ENTRY_POINTS)
        if ending not in offered:
            known = ", ".join(formats())
            raise Unusable(f"{ending or path.name} is no format of records; use {known}")
        plugin: Reader = load_plugin(offered[ending])
        return plugin
    module, _, function = where.partition(":")
    own: Reader = getattr(import_module(f"estune.recordings.readers.{module}"), function)
    return own


def _missing(path: Path, error: ModuleNotFoundError) -> str:
    extras = {"pyarrow": "parquet", "matio": "matlab", "rosbags": "ros", "nptdms": "tdms"}
    extras |= {"openpyxl": "xlsx", "cantools": "can", "pyulog": "px4", "pymavlink": "ardupilot"}
    package = (error.name or "").partition(".")[0]
    extra = extras.get(package, package)
    return (
        f"{path.suffix} files need {package}; install it with: pip install 'estune[{extra}]', "
        "or export CSV"
    )
