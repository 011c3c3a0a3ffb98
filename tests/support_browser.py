"""A headless Chromium that watches what a page asks for and complains of."""

import shutil
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
WITHIN_MS = 60_000.0
"""Time within which an event must occur; far more than it takes on a busy machine."""

QUIET = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)

expect.set_options(timeout=WITHIN_MS)

needs_browser = pytest.mark.slow
"""Mark of a test with a browser: such tests are of the slow lane."""


@contextmanager
def browser():
    """A browser; where there is none, the test is skipped."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET)
        try:
            yield chromium
        finally:
            chromium.close()


@contextmanager
def opened(chromium, address: str, **options):
    """A page; at its end nothing must have been complained of or asked for elsewhere."""
    page: Page = chromium.new_page(**options)
    page.set_default_timeout(WITHIN_MS)
    complaints, asked = [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    try:
        page.goto(address)
        yield page
        assert complaints == [], complaints
        own = urlsplit(address).netloc
        assert {urlsplit(url).netloc for url in asked if not url.startswith("data:")} <= {own}
    finally:
        page.close()


def serious(page: Page) -> list[str]:
    """Names of the serious faults of accessibility."""
    found = Axe().run(page).response["violations"]
    return [v["id"] for v in found if v["impact"] in ("serious", "critical")]


def check_forms(page: Page) -> None:
    """No serious fault of accessibility, and nothing wider than the window, in either form."""
    for width, scheme in ((1280, "light"), (400, "dark")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        assert serious(page) == [], scheme
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), width
