"""What does a tuning look like on the live page, and what does it change?

Command: `python -m experiments.first_page --out docs/images`.
Target: an animation of at most 500 kB; a move of a slider is drawn within 50 ms at the median.

A simulated reel in one process, its tuning in another, and the page of the rig in headless
Chromium: the animation is of that page, and the numbers are those of that run.
"""

import statistics
import sys
import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Page

import plants
from estune import load, tune
from estune.run.results.result import TuneResult
from experiments.live_page.browser import new_page
from experiments.live_page.commands import command, printed
from experiments.results import Target, at_most, command_line, print_results

WIDTH, HEIGHT = 760, 860
EVERY_MS = 400.0
LIVE_FRAMES = 34
SHOWN_MS = 350
"""Time for which a frame is shown, ms; the last one of each part three times as long."""
COLOURS = 96
MOVES = (1.5, 1.4, 1.3, 1.3, 1.45, 1.6, 1.75, 1.9, 1.6)
"""Limits of Ms to which the slider is moved at the end."""


def frame(page: Page) -> Image.Image:
    """The page as it looks now."""
    return Image.open(BytesIO(page.screenshot())).convert("RGB")


def watched(page: Page) -> list[tuple[Image.Image, int]]:
    """The page while the tuning runs, then while its slider is moved, with times in ms."""
    frames = [(frame(page), SHOWN_MS)]
    for _ in range(LIVE_FRAMES):
        page.wait_for_timeout(EVERY_MS)
        frames.append((frame(page), SHOWN_MS))
    page.locator("#heading").wait_for(state="visible")
    page.wait_for_timeout(EVERY_MS)
    frames.append((frame(page), 3 * SHOWN_MS))
    page.locator("#tuning summary").click()
    slider = page.get_by_label("robustness: largest Ms")
    slider.wait_for()
    page.evaluate(TO_THE_SLIDERS)
    for Ms in MOVES:
        slider.evaluate(MOVE, Ms)
        page.wait_for_timeout(EVERY_MS)
        frames.append((frame(page), SHOWN_MS))
    return [*frames[:-1], (frames[-1][0], 3 * SHOWN_MS)]


TO_THE_SLIDERS = """() => {
  document.querySelector("header").style.position = "static";
  document.getElementById("tuning").scrollIntoView();
}"""
MOVE = "(s, v) => { s.value = v; s.dispatchEvent(new Event('input')); }"


def write_animation(frames: list[tuple[Image.Image, int]], path: Path) -> float:
    """Writes the frames as GIF with the colours of all parts; returns its size, kB."""
    parts = [one for one, shown_ms in frames if shown_ms > SHOWN_MS]
    parts.append(frames[len(frames) // 2][0])
    together = Image.new("RGB", (WIDTH, HEIGHT * len(parts)))
    for n, one in enumerate(parts):
        together.paste(one, (0, HEIGHT * n))
    colours = together.quantize(COLOURS, dither=Image.Dither.NONE)
    images = [one.quantize(palette=colours, dither=Image.Dither.NONE) for one, _ in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [shown_ms for _, shown_ms in frames]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True
    )
    return path.stat().st_size / 1e3


def film(folder: Path, path: Path) -> dict[str, Any]:
    """Films a tuning into a file; its run is `folder/first`."""
    with command("serve", "--pace", 0.5, "--ledger", "memory") as rig:
        endpoint = printed(rig, "rig reel at ")
        with (
            command("watch", endpoint, "--port", 0, "--folder", folder) as watch,
            new_page(viewport={"width": WIDTH, "height": HEIGHT}) as page,
        ):
            page.goto(printed(watch, "page at "))
            with command("tune", endpoint, "--run", "first", "--folder", folder, "--quiet"):
                page.locator("#trial").wait_for(state="visible")
                frames = watched(page)
                redraws_ms = page.evaluate("document.getElementById('tuner').tuner.times")
    return {
        "animation_kB": write_animation(frames, path),
        "redraw_median_ms": statistics.median(redraws_ms),
    }


def numbers(result: TuneResult) -> dict[str, Any]:
    """What the tuning changed."""
    figures: dict[str, Any] = {"trials": result.nfev, "unsafe": result.unsafe}
    for name, at in (("before", result.start), ("after", result.tuned)):
        if at is not None and at.metrics is not None:
            figures |= {
                f"rise_{name}_ms": 1e3 * at.metrics.rise_time_s,
                f"overshoot_{name}": at.metrics.overshoot,
                f"cost_{name}": at.cost,
            }
    margins = result.claim.margins
    return figures | {"Ms_after": margins.sensitivity.value if margins else None}


def main() -> int:
    """Prints the numbers, and writes the animation."""
    parser = command_line(__doc__, quick="the numbers, without the animation", out="the animation")
    options = parser.parse_args()
    targets: dict[str, Target] = {}
    with tempfile.TemporaryDirectory() as at:
        folder = Path(at)
        figures: dict[str, Any] = {}
        if options.quick:
            tune(plants.reference_reel(), run="first", folder=folder, watch=None)
        else:
            figures |= film(folder, options.out / "live_page.gif")
            targets["animation_kB"] = at_most(figures["animation_kB"], 500.0)
            targets["redraw_median_ms"] = at_most(figures["redraw_median_ms"], 50.0)
        figures |= numbers(load(folder / "first"))
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
