"""`estune docs`: the installed documentation."""

import difflib
import tempfile
import webbrowser
from pathlib import Path

from estune.cli.values import Flag
from estune.errors import InvalidInput
from estune.support.documentation import documentation_folder, documentation_pages, write_html


def docs(name: str = "index", /, *, path: Flag = False) -> None:
    """Open the installed documentation in the browser; nothing is fetched.

    Args:
        name: A page, such as daemon; the index of all pages by default.
        path: Print the folder of the pages, which are Markdown, and open nothing.
    """
    folder = documentation_folder()
    if path:
        print(folder)
        return
    page = _found(name, documentation_pages(folder))
    out = Path(tempfile.mkdtemp(prefix="estune-docs-"))
    write_html(folder, out)
    address = (out / f"{page}.html").as_uri()
    print(f"documentation at {address}", flush=True)
    webbrowser.open(address)


def _found(name: str, pages: dict[str, Path]) -> str:
    """The page of that name, with or without its folder."""
    for page in pages:
        if name in (page, page.rpartition("/")[2]):
            return page
    known = sorted(page.rpartition("/")[2] for page in pages)
    nearest = difflib.get_close_matches(name, known, 1)
    remedy = f"did you mean {nearest[0]}?" if nearest else f"there are {', '.join(known)}"
    raise InvalidInput(f"there is no page {name}; {remedy}")
