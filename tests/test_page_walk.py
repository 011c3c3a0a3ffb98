"""The page of a rig from its first tuning on, whatever starts it: the newest run is shown."""

import re
import subprocess
import sys
from contextlib import contextmanager

import pytest
from playwright.sync_api import expect

from tests.serve_rig import served
from tests.support_browser import check_forms, needs_browser, opened, serious

pytestmark = [needs_browser, pytest.mark.slow]

RUNS = "#views:not([hidden]) tbody a"  # hidden while the rig is all there is to list
TUNED = re.compile(r"^tuned|no improvement|a limit is broken$")


def estune(*words: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "estune", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@contextmanager
def watching(endpoint, folder):
    """The address of the page of `estune watch`, as a user starts it."""
    words = ["watch", endpoint, "--allow-commands", "--port", "0", "--folder", str(folder)]
    with estune(*words) as process:
        try:
            yield process.stdout.readline().split()[-1]
        finally:
            process.kill()


def tuned(endpoint, folder, run) -> None:
    with estune("tune", endpoint, "--folder", str(folder), "--run", run, "--quiet") as process:
        _, text = process.communicate()
    assert process.returncode in (0, 7, 11, 12), text


def expect_result(page, run) -> None:
    """The result of this run, under a banner that says how it ended, and when."""
    expect(page.locator("#result-of")).to_have_text(f"Result of {run}")
    expect(page.locator("#state")).to_have_text(TUNED)
    expect(page.locator("#reason")).to_contain_text(" ago")
    expect(page.locator("#trial-text")).to_contain_text(f"of {run}")
    expect(page.locator("#search")).to_be_visible()
    expect(page.locator("#answer")).to_be_empty()
    expect(page.locator(RUNS).get_by_text(run, exact=True)).to_be_visible()


def tune_on_the_page(page) -> str:
    before = set(names(page))
    page.get_by_role("button", name="Start a tuning").click()
    expect(page.locator("#form")).to_contain_text("trials")
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.locator(RUNS)).to_have_count(len(before) + 1)
    (new,) = set(names(page)) - before
    return new


def names(page) -> list[str]:
    return page.locator(RUNS).all_inner_texts()


@pytest.mark.parametrize("kind", ["simulated", "real-time simulated"])
def test_page_shows_the_newest_run_whatever_started_it_and_whenever(chromium, tmp_path, kind):
    folder, ledger = tmp_path / "runs", tmp_path / "ledger"
    with served(kind, ledger=ledger) as rig:
        endpoint = rig.endpoint
        with watching(endpoint, folder) as first, opened(chromium, first) as page:
            expect(page.locator("#state")).to_have_text("idle")
            expect(page.locator("#text")).to_contain_text("controls tension by control effort")
            expect(page.locator("#predicted canvas")).to_be_visible()
            assert page.locator("header").bounding_box()["height"] <= 60
            assert page.locator("button.primary:visible").count() == 1
            tuned(endpoint, folder, "page-first")
            expect_result(page, "page-first")
            made = [tune_and_see(page) for _ in range(3)]
            assert len(set(made)) == 3
            tuned(endpoint, folder, "another-process")
            expect_result(page, "another-process")
            check_forms(page)
            with watching(endpoint, folder) as later, opened(chromium, later) as other:
                expect_result(other, "another-process")
                other.get_by_role("link", name="page-first").click()
                expect_result(other, "page-first")
            tuned(endpoint, tmp_path / "elsewhere", "far")
            expect(page.locator("#reason")).to_contain_text("last held by run far")
            expect(page.locator("#result-of")).to_have_text("Result of another-process")
            rig.process.kill()
            expect(page.locator("#state")).to_have_text("no link to the rig")
            with served(kind, "reel", endpoint, ledger=ledger):
                expect(page.locator("#reason")).to_contain_text("last held by run far")
                tuned(endpoint, folder, "restarted")
                expect_result(page, "restarted")
                make_live(page)


def tune_and_see(page) -> str:
    run = tune_on_the_page(page)
    expect_result(page, run)
    return run


def make_live(page) -> None:
    """Makes the tuned gains live, with the limits in sight."""
    page.locator("#offer").click()
    expect(page.locator("#form")).to_contain_text("Limits: Ms at most 1.6, overshoot at most 5 %.")
    expect(page.locator("#form")).to_contain_text("overshoot (predicted)")
    assert serious(page) == []
    page.get_by_role("button", name="Make live", exact=True).click()
    expect(page.locator("#offered")).to_have_text("These gains are live.")
    expect(page.locator("#reason")).to_contain_text("its gains are live")


def test_curve_follows_the_trial_under_way(chromium, tmp_path):
    with (
        served("real-time simulated") as rig,
        watching(rig.endpoint, tmp_path) as address,
        opened(chromium, address) as page,
    ):
        tune_on_the_page(page)
        expect(page.locator("#trial-text")).to_contain_text("under way")
        seen = set()
        while len(seen) < 3:
            expect(page.locator("#reason")).to_contain_text("trial")
            live = page.evaluate(
                "import('./static/page.js').then(({ sections }) => sections().values.live)"
            )
            done = page.evaluate(
                "import('./static/page.js').then(({ sections }) => sections().values.state.done)"
            )
            if live:
                seen.add(live["number"])
                assert abs(live["number"] - done) <= 1
