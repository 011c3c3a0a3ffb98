"""The page of a running tuning in headless Chromium: what an operator sees, and when."""

import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.resources import files
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from playwright.sync_api import Page, Response, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
QUIET = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync")
SIZES = ((400, 800), (1280, 900))
WITHIN_MS = 60_000.0
OPENED = 5
"""Number of times the page is opened; the median time counts."""

NOTE_TRIALS = """() => {
  window.shown = {};
  const facts = document.getElementById("facts");
  new MutationObserver(() => {
    const done = /(\\d+) done/.exec(facts.textContent);
    if (done) window.shown[done[1]] ??= Date.now() / 1000;
  }).observe(facts, { childList: true, subtree: true, characterData: true });
}"""
IS_USABLE = """() => document.getElementById("state").textContent === "running"
  && document.querySelectorAll("canvas").length > 6"""
IS_STALE = """() => document.getElementById("state").textContent.startsWith("no link")"""


class SeenPage(NamedTuple):
    """Observations of a page.

    Attributes:
        shown_at_s: Time of day at which a number of trials was shown, by the number.
        page_kB: Size of all files of the page.
        usable_s: Median time from the request to state and charts.
        stale_s: Time from the end of the rig's process to the state "no link".
        faults: Serious faults that axe-core finds, narrow and wide, light and dark.
        complaints: Messages of the browser's console.
        elsewhere: Requests to other hosts.
    """

    shown_at_s: dict[int, float]
    page_kB: float
    usable_s: float
    stale_s: float
    faults: list[str]
    complaints: list[str]
    elsewhere: list[str]


@contextmanager
def new_page(**options: Any) -> Iterator[Page]:
    """A page of a new headless Chromium."""
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET) as browser,
    ):
        page = browser.new_page(**options)
        page.set_default_timeout(WITHIN_MS)
        yield page


def look_at(address: str, watch_s: float, kill_rig: Callable[[], None]) -> SeenPage:
    """Opens the page of a running tuning, watches it for a while, then ends the rig's process."""
    with new_page() as page:
        return _look_at(page, address, watch_s, kill_rig)


def _look_at(page: Page, address: str, watch_s: float, kill_rig: Callable[[], None]) -> SeenPage:
    complaints: list[str] = []
    answers: list[Response] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("response", partial(list.append, answers))
    usable_s = statistics.median(_usable_s(page, address) for _ in range(OPENED))
    answers.clear()
    _usable_s(page, address)
    files_sent = [one for one in answers if one.status == 200]  # not a list that the page has
    whole = [one for one in files_sent if "event-stream" not in one.headers["content-type"]]
    page_kB = sum(len(one.body()) for one in whole) / 1e3
    faults = _faults(page)
    page.evaluate(NOTE_TRIALS)
    page.wait_for_timeout(1e3 * watch_s)
    shown = {int(n): at_s for n, at_s in page.evaluate("window.shown").items()}
    kill_rig()
    begun_s = time.perf_counter()
    page.wait_for_function(IS_STALE)
    stale_s = time.perf_counter() - begun_s
    own = urlsplit(address).netloc
    elsewhere = [one.url for one in answers if urlsplit(one.url).netloc != own]
    return SeenPage(shown, page_kB, usable_s, stale_s, faults, complaints, elsewhere)


def _usable_s(page: Page, address: str) -> float:
    begun_s = time.perf_counter()
    page.goto(address)
    page.wait_for_function(IS_USABLE)
    return time.perf_counter() - begun_s


def _faults(page: Page) -> list[str]:
    found = []
    page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text("utf-8"))
    for width, height in SIZES:
        for scheme in ("light", "dark"):
            page.set_viewport_size({"width": width, "height": height})
            page.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
            violations = page.evaluate("axe.run()")["violations"]
            serious = [v["id"] for v in violations if v["impact"] in ("serious", "critical")]
            found += [f"{fault} at {width} px, {scheme}" for fault in serious]
    return found
