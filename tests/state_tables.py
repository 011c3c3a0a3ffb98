"""Writes the tables of state machines that no other page has to docs/reference/state-machines.md.

Run it after each change of a transition: ./dev python -m tests.state_tables
"""

import re
from pathlib import Path
from typing import Any

from estune.daemon import supervisor_state
from estune.hardware.reel_machine import transitions
from estune.support.state_table import StateTable, printed

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "state-machines.md"
TABLES: dict[str, StateTable[Any, Any, Any]] = {
    "supervisor": supervisor_state.TABLE,
    "reel": transitions.TABLE,
}

_SECTION = re.compile(r"(<!-- from the code: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """The page with its tables renewed."""

    def renewed(found: re.Match[str]) -> str:
        table = "".join(printed(TABLES[found[2]], lambda event: f"**{event.value}**"))
        return f"{found[1]}\n{table}{found[3]}"

    return _SECTION.sub(renewed, text)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
    print(f"{len(TABLES)} tables written: {PAGE}")
