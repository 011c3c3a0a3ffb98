"""The content of a page as JSON, encoded once however many pages are open."""

import json
import math
import threading
import time
from collections.abc import Iterable
from typing import Any, NamedTuple


class Seen(NamedTuple):
    """The part of a board that a page has been sent.

    Attributes:
        rows: Generation and number of the rows, by table.
    """

    version: int = 0
    rows: tuple[tuple[str, int, int], ...] = ()


class _Table:
    """Rows that grow, or begin again under the next generation."""

    def __init__(self) -> None:
        self.generation = 0
        self.rows: list[str] = []


class Board:
    """Values by name, and tables of rows by name. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._version = 0
        self._values: dict[str, tuple[int, str]] = {}
        self._tables: dict[str, _Table] = {}
        self._heard_s: dict[str, float] = {}

    def put(self, name: str, value: Any) -> None:
        """Sets a value; pages are told only of a change."""
        text = to_json(value)
        with self._lock:
            if self._values.get(name, (0, ""))[1] != text:
                self._version += 1
                self._values[name] = self._version, text

    def get(self, name: str) -> Any:
        """A value, or None."""
        with self._lock:
            text = self._values.get(name, (0, "null"))[1]
        return json.loads(text)

    def extend(self, table: str, rows: Iterable[Any], *, restart: bool = False) -> None:
        """Appends rows to a table, or begins it again with them."""
        texts = [to_json(row) for row in rows]
        with self._lock:
            kept = self._tables.setdefault(table, _Table())
            if restart:
                kept.generation += 1
                kept.rows = []
            kept.rows.extend(texts)

    def mark_heard(self, source: str) -> None:
        """Notes that a source has answered now."""
        self._heard_s[source] = time.monotonic()

    def ages(self) -> dict[str, float]:
        """Time since each source answered, s."""
        now_s = time.monotonic()
        return {name: now_s - at_s for name, at_s in self._heard_s.copy().items()}

    def changes(self, seen: Seen) -> tuple[str, Seen]:
        """Changes that a page has not been sent yet, as JSON; empty where there are none."""
        known = {name: (generation, count) for name, generation, count in seen.rows}
        with self._lock:
            values = {n: text for n, (v, text) in self._values.items() if v > seen.version}
            tables = {
                name: (table.generation, len(table.rows), table.rows[begin:], begin == 0)
                for name, table in self._tables.items()
                if (begin := _begin(table, known.get(name))) < len(table.rows)
                or known.get(name, (0, 0))[0] != table.generation
            }
            version = self._version
        if not values and not tables:
            return "", seen
        known |= {name: (generation, count) for name, (generation, count, *_) in tables.items()}
        shown = ",".join(f"{json.dumps(name)}:{text}" for name, text in values.items())
        rows = ",".join(
            f'{json.dumps(name)}:{{"restart":{to_json(restart)},"rows":[{",".join(texts)}]}}'
            for name, (_, _, texts, restart) in tables.items()
        )
        return (
            f'{{"values":{{{shown}}},"tables":{{{rows}}}}}',
            Seen(version, tuple((name, *at) for name, at in known.items())),
        )


def _begin(table: _Table, known: tuple[int, int] | None) -> int:
    """First row of the table that a page does not have."""
    return known[1] if known is not None and known[0] == table.generation else 0


def to_json(value: Any) -> str:
    """JSON without spaces; numbers that are not finite become null."""
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return json.dumps(_finite(value), allow_nan=False, separators=(",", ":"))


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
