"""Files ending in `.log`, by what stands in them: Klipper, Marlin, candump, or a table."""

from pathlib import Path

from estune.recordings.raw_file import RawFile
from estune.recordings.readers import candump, printer_log
from estune.recordings.readers.text import decoded, table


def read_log(path: Path) -> RawFile:
    """Reads the log of a program."""
    text = decoded(path)
    lines = text.splitlines()
    if candump.is_candump(lines):
        return candump.read_candump(path, lines)
    if printer_log.is_klippy(lines):
        return printer_log.read_klippy(lines)
    if printer_log.is_marlin(lines):
        return printer_log.read_marlin(lines)
    return table(text)
