"""How long does a newcomer take from a clone to tuned gains that are live, by one command?

Command: `python -m experiments.first_steps`.
Target: at most 120 s from the command to live gains, once the environment is made.

The command is `./dev estune demo --page` in a fresh clone of this repository; everything else is
done on the page, in headless Chromium: start a tuning, move a slider, try the gains once, apply.
The time a person takes to read is not in it.
"""

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, expect, sync_playwright

from experiments.live_page.browser import CHROMIUM, QUIET
from experiments.live_page.commands import printed
from experiments.results import at_most, command_line, print_results

ROOT = Path(__file__).parents[1]
PAGE = ("demo", "--page", "--port", "0")
WITHIN_MS = 300_000.0


def cloned(folder: Path) -> Path:
    """The command `dev` of a clone of this repository, whose first call makes the environment."""
    made = folder / "estune"
    clone = ["git", "clone", "--quiet", "--depth", "1", f"file://{ROOT}", str(made)]
    subprocess.run(clone, check=True)  # noqa: S603  git, of this repository
    ready = [str(made / "dev"), "estune", "--version"]
    subprocess.run(ready, check=True, stdout=subprocess.DEVNULL)  # noqa: S603  our own script
    return made / "dev"


@contextmanager
def running(*command: str) -> Iterator["subprocess.Popen[str]"]:
    """A command, stopped as by Ctrl-C at the end."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, text=True, **pipes)  # noqa: S603  our own command
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


def walked(page: Page, address: str) -> dict[str, float]:
    """Times of day at the end of each step on the page, s."""
    page.set_default_timeout(WITHIN_MS)
    expect.set_options(timeout=WITHIN_MS)
    page.goto(address)
    page.get_by_role("button", name="Start a tuning").click()
    ends = {"page_shown_s": time.monotonic()}
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.locator("#events")).to_contain_text("the tuning has ended with code 0")
    ends["tuned_s"] = time.monotonic()
    page.locator("#tuning summary").click()
    page.get_by_role("slider", name="P, N/N").press("ArrowLeft")
    page.get_by_role("button", name="Try these gains once").click()
    expect(page.locator("#answer")).to_contain_text("the rig has its live gains again")
    ends["tried_s"] = time.monotonic()
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Apply").click()
    expect(page.locator("#answer")).to_contain_text("these gains are live")
    ends["applied_s"] = time.monotonic()
    return ends


def main() -> int:
    """Prints the time of each step."""
    parser = command_line(__doc__, quick="the clone: the command runs from this environment")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as at:
        began = time.monotonic()
        command = [sys.executable, "-P", "-m", "estune"]
        if not options.quick:
            command = [str(cloned(Path(at))), "estune"]
            figures["clone_and_environment_s"] = time.monotonic() - began
        began = time.monotonic()
        with (
            running(*command, *PAGE, "--folder", at) as demo,
            sync_playwright() as playwright,
            playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET) as browser,
        ):
            address = printed(demo, "page at ")
            figures["page_served_s"] = time.monotonic() - began
            ends = walked(browser.new_page(), address)
            figures |= {step: end - began for step, end in ends.items()}
    targets = {"applied_s": at_most(figures["applied_s"], 120.0)}
    return print_results(figures, targets, as_json=options.json, tables=True)


if __name__ == "__main__":
    sys.exit(main())
