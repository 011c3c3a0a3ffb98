"""The live page in a real browser: a run in processes of its own, and a daemon."""

import shutil
import subprocess
import sys
import tempfile

import pytest
from playwright.sync_api import expect

from estune import tune
from estune.errors import JournalError
from estune.remote import zenoh
from estune.remote.messages.rights import Right
from estune.remote.zenoh.local_endpoints import local_endpoints
from estune.run.journal import Journal
from estune.support.user import user_at_host
from estune.web.board import Board
from estune.web.endpoint_views import EndpointViews
from estune.web.run_folder import RunFolder
from estune.web.server import PageServer
from estune.web.views import View, folder_views, rig_view, run_view
from tests.serve_rig import served
from tests.support_browser import check_forms, needs_browser, opened, serious
from tests.support_daemon import daemon, rig_served, rig_table
from tests.support_runs import ArithmeticRig

pytestmark = needs_browser


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A rig in a process, a run that tunes it in another, and the page of the run."""
    folder = tmp_path_factory.mktemp("runs")
    with served("paced simulated") as rig:
        command = ["tune", rig.endpoint, "--tuner", "safe_bayesian", "--tolerance", "0"]
        options = ["--trials", "500", "--run", "live", "--folder", str(folder), "--quiet"]
        with subprocess.Popen([sys.executable, "-m", "estune", *command, *options]) as process:
            try:
                while not (folder / "live" / "run.sqlite").exists():
                    assert process.poll() is None
                view = run_view_when_there(folder / "live")
                server = PageServer(lambda: [view], right=Right.COMMAND)
                try:
                    yield rig, server, folder
                finally:
                    server.close()
            finally:
                process.kill()


def run_view_when_there(folder):
    while True:
        try:
            return run_view(folder)
        except JournalError:
            continue


AXES = """async (batches) => {
  const { Sections } = await import("./static/sections.js");
  const sections = new Sections(), drawn = [];
  const description = { measurement: "tension, N", command: "effort, N",
    gains: [], gain_labels: [], per_ampere: 20, step_at_s: 0.2, duration_s: 1,
    measurement_limits: [null, null], command_limits: [null, null] };
  sections.take({ values: { description, live: { trial_id: "run-1" } }, tables: {} });
  for (const rows of batches) {
    sections.take({ values: {}, tables: { samples: { restart: !drawn.length, rows } } });
    sections.draw();
    await new Promise(requestAnimationFrame);
    const { x, y } = sections.charts.response.plot.scales;
    drawn.push({ x: [x.min, x.max], y: [y.min, y.max] });
  }
  return drawn;
}"""
"""Axes of the chart after each batch of samples of one trial."""


def trials(page) -> int:
    text = page.locator("#facts").inner_text()
    return int(text.split(" done")[0].split()[-1])


def test_page_of_a_run_follows_it_in_both_forms_without_faults(chromium, run):
    _, server, _ = run
    with opened(chromium, server.address) as page:
        expect(page.locator("#state")).to_have_text("running")
        expect(page.locator("#search-text")).to_contain_text("next trial runs")
        first = trials(page)
        expect(page.locator("#facts")).not_to_contain_text(f"{first} done")
        assert trials(page) > first
        assert page.locator("canvas").count() == 7
        check_forms(page)


def test_page_of_a_rig_shows_the_run_that_is_under_way_there(chromium, run):
    rig, _, folder = run
    server = PageServer(lambda: [view])
    view = rig_view(rig.endpoint, "reel", runs=RunFolder(folder))
    try:
        with opened(chromium, server.address) as page:
            expect(page.locator("#facts")).to_contain_text("left")
            expect(page.locator("#facts")).to_contain_text("best cost")
            expect(page.locator("#cost canvas")).to_be_visible()
            expect(page.locator("#response .u-legend")).to_contain_text("best so far")
    finally:
        server.close()


def test_axes_move_within_a_trial_only_for_a_value_beyond_them(chromium):
    tension = [15.0, 15.1, 15.0, 19.0, 45.6, 44.9, 47.1, 45.0, 45.0, 86.2]
    batches = [[[0.1 * k, 15.0, y, 0.75]] for k, y in enumerate(tension)]
    view = View("reel", "rig", Board(), [])
    server = PageServer(lambda: [view])
    try:
        with opened(chromium, server.address) as page:
            expect(page.locator("#title")).to_have_text("reel")
            drawn = page.evaluate(AXES, batches)
    finally:
        server.close()
    assert len(drawn) == len(batches)
    assert all(one["x"] == pytest.approx([-0.2, 0.8]) for one in drawn)
    moved = 0
    for before, after, value in zip(drawn, drawn[1:], tension[1:], strict=False):
        low, high = before["y"]
        assert (after["y"] == before["y"]) == (low <= value <= high), (before, after, value)
        moved += after["y"] != before["y"]
    assert 0 < moved < 5


def test_stop_is_shown_as_done_when_the_rig_confirms(chromium, run):
    rig, server, _ = run
    with opened(chromium, server.address) as page:
        expect(page.locator("#facts")).to_contain_text("held by")
        page.get_by_role("button", name="Emergency stop").click()
        expect(page.locator("#answer")).to_have_text(
            "estop: done; the rig confirms: it is in its safe state"
        )
        expect(page.locator("#state")).to_have_text("emergency stop")
        with zenoh.connect(rig.endpoint) as there:
            assert there.status().latched == f"{user_at_host()} on the live page"


def test_daemon_page_accepts_a_candidate_once_the_rig_has_it(chromium, tmp_path):
    page_table = "[page]\nhttp_port = 0\nallow_commands = true\n"
    with (
        rig_served() as (_, endpoint),
        daemon(tmp_path, rig_table("drum", endpoint), more=page_table) as watched,
    ):
        watched.until_mode("holding")
        with opened(chromium, watched.service.page_address) as page:
            expect(page.locator("#state")).to_have_text("holding")
            page.get_by_role("button", name="Accept").click()
            expect(page.locator("#answer")).to_contain_text("the rig confirms: the accepted gains")
            assert watched.client.status("drum").live == "accepted"
            expect(page.locator("#checks canvas")).to_be_visible()
            expect(page.locator("#checks .u-legend")).to_contain_text("upper alarm limit")
            assert serious(page) == []


def test_one_page_lists_all_on_this_machine_and_marks_what_has_gone(
    chromium, tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # where listeners are noted
    runs = tmp_path / "runs"
    tune(ArithmeticRig(), trials=2, run="first", folder=runs, watch=None)
    folder = RunFolder(runs)
    here, listed = EndpointViews(local_endpoints, runs=folder), folder_views(folder)
    server = PageServer(lambda: [*here(), *listed()], right=Right.COMMAND)
    try:
        with (
            rig_served() as (_, endpoint),
            daemon(tmp_path, rig_table("drum", endpoint)) as watched,
            opened(chromium, server.address) as page,
        ):
            rows = page.locator("#views tbody tr")
            expect(rows).to_have_count(3)  # first the rig and its daemon, then the run
            expect(rows.last).to_contain_text("first")
            with rig_served("spool") as (_, there):
                spool = page.locator("#views tbody tr", has_text="spool")
                expect(spool).to_contain_text("idle")
                spool.get_by_role("link").press("Enter")
                expect(page.locator("#title")).to_have_text(f"spool at {there}")
                expect(page.get_by_role("button", name="Start a tuning")).to_be_visible()
            expect(spool).to_contain_text("gone since")
            expect(spool).to_have_class("stale")
            expect(page.locator("#state")).to_have_text("no link to the rig")
            check_forms(page)
            with rig_served("spool"):
                expect(spool).to_contain_text("idle")
                expect(spool).to_have_count(1)
            page.get_by_role("link", name=f"drum at {watched.service.endpoint}").press("Enter")
            expect(page.get_by_role("button", name="Pause")).to_be_visible()
    finally:
        server.close()
        here.close()


def test_endpoint_of_a_process_that_was_killed_is_not_listed(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with served("scripted") as rig:
        assert local_endpoints() == (rig.endpoint,)
        rig.process.kill()
        while local_endpoints():
            pass
    assert not list(tmp_path.glob("estune-endpoints-*/*"))


def test_folder_of_endpoints_that_others_may_write_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with rig_served():
        (folder,) = tmp_path.iterdir()
        folder.chmod(0o777)
        assert local_endpoints() == ()


def test_page_without_its_server_says_that_it_is_disconnected(chromium):
    with rig_served() as (_, endpoint):
        view = rig_view(endpoint, "drum")
        server = PageServer(lambda: [view])
        page = chromium.new_page()
        page.goto(server.address)
        expect(page.locator("#state")).to_have_text("idle")
        server.close()
        expect(page.locator("#state")).to_have_text("page disconnected")
        page.close()


def test_list_of_runs_is_sorted_and_filtered_by_keyboard(chromium, tmp_path):
    tune(ArithmeticRig(), trials=2, run="first", folder=tmp_path, watch=None)
    for name, begun in (("old", "2026-01-05"), ("new", "2026-12-24")):
        shutil.copytree(tmp_path / "first", tmp_path / name)
        with Journal.open(tmp_path / name, write=True) as journal:
            journal.note(created_at=f"{begun}T12:00:00+00:00")
    server = PageServer(folder_views(RunFolder(tmp_path)))
    with opened(chromium, server.address) as page:
        links = page.locator("#views tbody a")
        expect(links).to_have_text(["new", "first", "old"])
        expect(page.locator("#views tbody tr").first).to_contain_text("no significant improvement")
        page.get_by_role("button", name="name", exact=True).press("Enter")
        expect(links).to_have_text(["first", "new", "old"])
        page.get_by_role("searchbox").press_sequentially("ol")
        expect(links).to_have_text(["old"])
        links.first.press("Enter")
        expect(page.locator("#title")).to_have_text("old")
        assert serious(page) == []
    server.close()
