"""Tables of state machines in Markdown; writes those of docs/reference/state-machines.md.

Run it after each change of a transition: ./dev python -m tests.state_tables
"""

import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from estune.daemon import supervisor_state
from estune.hardware.reel_machine import transitions
from estune.support.state_table import IMPOSSIBLE, StateTable
from tests.protocol_tables import table

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "state-machines.md"
TABLES: dict[str, StateTable[Any, Any, Any]] = {
    "supervisor": supervisor_state.TABLE,
    "reel": transitions.TABLE,
}

_SECTION = re.compile(r"(<!-- from the code: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def sentence_of(cell: Callable[..., Any] | str) -> str:
    """What a cell does, or why it does nothing, in a sentence."""
    if not isinstance(cell, str):
        return (inspect.getdoc(cell) or "").split("\n")[0]
    return f"{cell[:1].upper()}{cell[1:]}." if cell == IMPOSSIBLE else f"Refused: {cell}."


def matrix(states: StateTable[Any, Any, Any], title: Callable[[Any], str]) -> Iterator[str]:
    """A state machine in Markdown: numbers of actions by event and mode, then the actions.

    A cell is empty where the event is impossible.
    """
    numbers: dict[str, str] = {sentence_of(IMPOSSIBLE): ""}
    for row in states.rows.values():
        for cell in row.values():
            numbers.setdefault(sentence_of(cell), str(len(numbers)))
    yield from table(
        ("event", *map(_name, states.modes)),
        (
            (title(event), *(numbers[sentence_of(cell)] for cell in row.values()))
            for event, row in states.rows.items()
        ),
    )
    yield "\n"
    yield from (f"{number}. {action}\n" for action, number in numbers.items() if number)


def possible_events(states: StateTable[Any, Any, Any]) -> Iterator[str]:
    """What each event does in which modes, in Markdown, without what is refused or impossible."""
    rows: dict[tuple[str, str], list[str]] = {}
    for event, row in states.rows.items():
        modes: dict[str, list[str]] = {}
        for mode, cell in row.items():
            if not isinstance(cell, str):
                modes.setdefault(sentence_of(cell), []).append(_name(mode))
        for action, names in modes.items():
            others = [_name(mode) for mode in row if _name(mode) not in names]
            where = ", ".join(names)
            if len(others) < 3:
                where = f"all but {', '.join(others)}" if others else "all"
            rows.setdefault((where, action), []).append(f"`{event.value}`")
    yield from table(
        ("event", "in mode", "action"),
        ((", ".join(events), *rest) for rest, events in rows.items()),
    )
    yield "\n"


def _name(mode: Any) -> str:
    return f"`{mode.value if isinstance(mode.value, str) else mode.name.lower()}`"


def page(text: str) -> str:
    """The page with its tables renewed."""

    def renewed(found: re.Match[str]) -> str:
        return f"{found[1]}\n{''.join(possible_events(TABLES[found[2]]))}{found[3]}"

    return _SECTION.sub(renewed, text)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
    print(f"{len(TABLES)} tables written: {PAGE}")
