"""The installed documentation: Markdown, shown as HTML that needs neither script nor network.

The pages are those of `docs/` in the source. They are read by the parser that the site is built
with, and look like its plain form: what only Sphinx can make, such as the reference from
docstrings, is left out.
"""

import json
import re
import shutil
from collections.abc import Sequence
from functools import cache
from importlib.metadata import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from markdown_it import MarkdownIt
from markdown_it.token import Token
from mdit_py_plugins.anchors import anchors_plugin
from mdit_py_plugins.dollarmath import dollarmath_plugin

from estune.errors import InvalidInput

_INDEX = "index.md"


def documentation_folder() -> Path:
    """The folder of the pages: of a checkout, or as installed.

    Raises:
        InvalidInput: the installation has none.
    """
    root = Path(__file__).parents[2]
    if (root / "pyproject.toml").is_file() and (root / "docs" / _INDEX).is_file():
        return root / "docs"
    for file in files("estune") or ():
        if file.parts[-4:] == ("share", "doc", "estune", _INDEX):
            return Path(str(file.locate())).resolve().parent
    raise InvalidInput("this installation of estune has no documentation; install its wheel anew")


def documentation_pages(folder: Path) -> dict[str, Path]:
    """The pages by name, which is their path in the folder without its ending."""
    found = [path for ending in ("md", "ipynb") for path in sorted(folder.rglob(f"*.{ending}"))]
    return {str(path.relative_to(folder).with_suffix("")): path for path in found}


def write_html(folder: Path, out: Path) -> None:
    """Writes all pages of a folder as HTML, with links between them, and their images."""
    page = Environment(loader=PackageLoader("estune.support", "."), autoescape=True).get_template(
        "documentation.html.jinja"
    )
    for name, path in documentation_pages(folder).items():
        tokens = _parser().parse(_markdown(path))
        title = next((t.content for t in tokens if t.type == "inline"), name)
        target = out / f"{name}.html"
        target.parent.mkdir(parents=True, exist_ok=True)
        body = _parser().renderer.render(_own(tokens), _parser().options, {})
        # What may have to be scrolled sideways can be reached by the keyboard.
        body = re.sub(r'<(pre|table|div class="math block")>', r'<\1 tabindex="0">', body)
        up = "../" * name.count("/")
        target.write_text(page.render(title=title, body=body, up=up), "utf-8")
    for image in folder.rglob("*.png"):
        target = out / image.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(image, target)


@cache
def _parser() -> MarkdownIt:
    parser = MarkdownIt("commonmark").enable("table")
    anchors_plugin(parser, max_level=3)
    dollarmath_plugin(parser, renderer=_mathml)
    return parser


def _mathml(formula: str, options: dict[str, Any]) -> str:
    from latex2mathml.converter import convert  # noqa: PLC0415  only pages with formulas need it

    return str(convert(formula, display="block" if options["display_mode"] else "inline"))


def _markdown(path: Path) -> str:
    """The text of a page; of a notebook its texts and programs."""
    if path.suffix == ".md":
        return path.read_text("utf-8")
    cells = json.loads(path.read_text("utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in cells]
    return "\n\n".join(
        f"```python\n{text}\n```" if cell["cell_type"] == "code" else text
        for cell, text in zip(cells, texts, strict=True)
    )


def _own(tokens: Sequence[Token]) -> list[Token]:
    """The tokens without directives of Sphinx, links leading to the HTML."""
    for token in tokens:
        for link in token.children or ():
            if link.type == "link_open":
                link.attrs["href"] = re.sub(
                    r"^(?!\w+:)([^#]+)\.(?:md|ipynb)(?=#|$)", r"\1.html", str(link.attrs["href"])
                )
    return [token for token in tokens if not (token.type == "fence" and token.info[:1] == "{")]
