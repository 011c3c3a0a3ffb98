"""Sliders of the tuning page that are dragged by the mouse in headless Chromium."""

from pathlib import Path

from playwright.sync_api import Page

import plants
from estune import tune
from estune.web.server import PageServer
from estune.web.views import run_view
from experiments.live_page.browser import SIZES, new_page

SLIDERS = ("Ms", "P", "setpoint_filter_s")
"""A limit, which moves all gains, and two gains."""
SHARE = 0.15
"""Share of a slider's length over which it is dragged, to and fro."""
EVERY_MS = 30.0
"""Time between two moves of the mouse."""


def redraws_ms(folder: Path, moves: int) -> dict[int, list[float]]:
    """Times from the mouse's move until the page has painted what follows from it, by width, ms.

    The page takes them itself.
    """
    tune(plants.reference_reel(), run="dragged", folder=folder, watch=None)
    view = run_view(folder / "dragged")
    server = PageServer(lambda: [view])
    try:
        found = {}
        for width, height in SIZES:
            with new_page(viewport={"width": width, "height": height}) as page:
                page.goto(f"{server.address}?tune")
                for name in SLIDERS:
                    _drag(page, name, moves)
                found[width] = page.evaluate("document.getElementById('tuner').tuner.times")
        return found
    finally:
        server.close()


def _drag(page: Page, name: str, moves: int) -> None:
    slider = page.locator(f"#tune-{name}")
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    assert box is not None  # noqa: S101  it was scrolled into view
    share = page.evaluate(AT, name)
    middle, y = box["x"] + share * box["width"], box["y"] + box["height"] / 2
    length = SHARE * box["width"] * (1 if share < 0.5 else -1)
    page.mouse.move(middle, y)
    page.mouse.down()
    for n in range(moves):
        away = 1.0 - abs(2.0 * (n + 1) / moves - 1.0)
        page.mouse.move(middle + away * length, y)
        page.wait_for_timeout(EVERY_MS)
    page.mouse.up()


AT = """(name) => {
  const { min, max, value } = document.getElementById(`tune-${name}`);
  return (value - min) / (max - min);
}"""
