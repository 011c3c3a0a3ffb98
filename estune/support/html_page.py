"""Report pages as one HTML file: figures inside, no request, light and dark, printable.

A page is a value: a `Page` has a headline and `Section`s, and each section is a list of blocks.

    page = Page(
        "Equal transparency",
        Status("2 of 3 reels pass", good=False),
        sections=(
            Section("Result", (Table(("reel", "cost"), (("left", "0.41"),), numeric=(1,)),)),
            Section("How", (Paragraph("Cost (35), `move_weight` = 0.2."), Warnings(("slack",)))),
        ),
    )
    write(page, Path("transparency.html"))

All texts are plain and are escaped; `code` between backticks and **bold** are the only markup.
Numbers stay on one line with their units, and a minus before a number is a true one. A page is the
same, byte for byte, whenever it shows the same.
"""

import base64
import json
import platform
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar, Literal

import matplotlib as mpl
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from estune.support.page_image import DARK_GROUND, light_and_dark, narrow
from estune.support.version import __version__
from estune.support.whole_file import write_file


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; `soft` is small and grey, `lead` large, `quote` set off, `code` verbatim."""

    kind: ClassVar[str] = "paragraph"
    text: str
    style: Literal["", "soft", "lead", "quote", "code"] = ""


@dataclass(frozen=True)
class Heading:
    """A heading within a section."""

    kind: ClassVar[str] = "heading"
    text: str


@dataclass(frozen=True)
class Status:
    """A coloured verdict, as headline, block or table cell.

    Attributes:
        good: Green if true, red if false, neutral if None.
        detail: Explanation after it, in plain colour.
    """

    kind: ClassVar[str] = "status"
    text: str
    good: bool | None = None
    detail: str = ""


@dataclass(frozen=True)
class Link:
    """A table cell that leads to the section with this anchor."""

    kind: ClassVar[str] = "link"
    text: str
    anchor: str


Cell = str | Status | Link


@dataclass(frozen=True)
class Table:
    """A table; without columns it has no head.

    Attributes:
        numeric: Indices of the columns that are set flush right.
    """

    kind: ClassVar[str] = "table"
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    numeric: Sequence[int] = ()


@dataclass(frozen=True)
class Bullets:
    """A bulleted list."""

    kind: ClassVar[str] = "bullets"
    items: Sequence[str]


@dataclass(frozen=True)
class Warnings:
    """Warnings that a reader must not miss; nothing is shown without items."""

    kind: ClassVar[str] = "warnings"
    items: Sequence[str]


@dataclass(frozen=True, eq=False)
class Drawing:
    """A figure with the numbers behind it.

    Attributes:
        name: File-safe name, unique within the page.
        alt: Its content in words.
        caption: Text below it.
        csv: The numbers in it as CSV, offered as a download; empty offers none.
    """

    kind: ClassVar[str] = "drawing"
    figure: Figure
    name: str
    alt: str
    caption: str = ""
    csv: str = ""


@dataclass(frozen=True, eq=False)
class Panel:
    """A part with controls: its scripts run in the page, and the rest of it needs none.

    Attributes:
        name: Unique name of its element.
        data: Its data as JSON values.
        files: Its scripts and styles in the order in which they need each other, as packages and
            paths within them. A script is a module; imports are resolved by the order alone.
        start: Script that starts it, with the names `element` and `data`.
    """

    kind: ClassVar[str] = "panel"
    name: str
    text: str
    data: Any
    files: Sequence[tuple[str, str]]
    start: str

    @property
    def styles(self) -> Markup:
        """The style sheets of all parts, one after the other."""
        return Markup("\n".join(self._texts(".css")))  # noqa: S704  files of the packages

    @property
    def scripts(self) -> Markup:
        """Its scripts as one module."""
        modules = (_IMPORT.sub("", text) for text in self._texts(".js"))
        data = json.dumps(self.data, separators=(",", ":"), allow_nan=False).replace(
            "<", "\\u003c"
        )
        begin = f"const element = document.getElementById({json.dumps(self.name)}), data = {data};"
        return Markup("\n".join((*modules, begin, self.start)))  # noqa: S704  as above

    def _texts(self, ending: str) -> Iterator[str]:
        for package, path in self.files:
            if path.endswith(ending):
                yield files(package).joinpath(path).read_text("utf-8")


_IMPORT = re.compile(r"^import .*$\n|^export (?=\w)", re.MULTILINE)

Block = Paragraph | Heading | Status | Table | Bullets | Warnings | Drawing | Panel


@dataclass(frozen=True)
class Section:
    """Blocks below a title; `anchor` is the target of a `Link`."""

    title: str
    blocks: Sequence[Block]
    anchor: str = ""


@dataclass(frozen=True)
class Page:
    """A report page.

    Attributes:
        sections: Sections in order; those without blocks are left out.
    """

    title: str
    headline: Status
    summary: Sequence[Block] = ()
    sections: Sequence[Section] = ()


def render(page: Page) -> str:
    """The page as HTML."""
    template = _environment().get_template("html_page.html.jinja")
    return template.render(page=page, versions=_versions(), dark_ground=DARK_GROUND) + "\n"


def write(page: Page, path: Path) -> None:
    """Writes the page as one file, whole or not at all.

    Raises:
        InvalidInput: the file cannot be written.
    """
    write_file(path, render(page).encode())


def prose(plain: str) -> Markup:
    """Escaped text with true minus signs, numbers tied to their units, code and bold."""
    text = re.sub(r"(?<![^\s(])-(?=[\d ])", "&minus;", str(escape(plain)))
    text = re.sub(r"(?<=\d) (?=[A-Za-z%±])|(?<=±) ", "&nbsp;", text)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    text = re.sub(r"(?<![\w*])\*\*(\w[^*<]*)\*\*(?!\w)", r"<b>\1</b>", text)
    return Markup(text)  # noqa: S704  escaped above


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("estune.support", "."), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"prose": prose, "svg_addresses": _svg_addresses, "base64": _base64}
    return environment


def _svg_addresses(drawing: Drawing) -> tuple[str, str]:
    """The figure for wide and for small screens as data URLs.

    As images of their own their element ids meet no others.
    """
    with mpl.rc_context({"svg.hashsalt": drawing.name}):  # fixed salt: the same figure, same bytes
        # The narrow layout is made last, on the same figure.
        forms = light_and_dark(drawing.figure), light_and_dark(narrow(drawing.figure))
    wide, small = (f"data:image/svg+xml;base64,{_base64(svg)}" for svg in forms)
    return wide, small


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def _versions() -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "casadi"))
    return f"Made by estune {__version__} (Python {platform.python_version()}, {packages})."
