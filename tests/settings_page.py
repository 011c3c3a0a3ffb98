"""Writes the lists of docs/reference/settings.md from the declared settings.

Run it after each change of a setting: ./dev python -m tests.settings_page
"""

import re
from collections.abc import Iterator
from pathlib import Path

from estune.run.toml_tables import CONTROLLER, COST, LIMITS, SEARCH, STEP, SettingsGroup

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "settings.md"
GROUPS = {"step": STEP, "cost": COST, "search": SEARCH, "limits": LIMITS, "controller": CONTROLLER}

_SECTION = re.compile(r"(<!-- from the code: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def lines(group: SettingsGroup) -> Iterator[str]:
    """The settings of a group, a line each: key, default, meaning."""
    for member in group.members:
        text = member.meaning
        if member.choices:
            text += ": " + " or ".join(f"`{choice}`" for choice in member.choices)
        forms = [f"or `none` for {member.setting.none}"] if member.setting.none else []
        default = f" ({member.default_text})" if member.default_text else ""
        yield f"* `{member.name}`{default}: {', '.join([text, *forms])}.\n"


def page(text: str) -> str:
    """The page with its lists renewed."""

    def renewed(found: re.Match[str]) -> str:
        return f"{found[1]}\n{''.join(lines(GROUPS[found[2]]))}\n{found[3]}"

    return _SECTION.sub(renewed, text)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
    print(f"{len(GROUPS)} lists written: {PAGE}")
