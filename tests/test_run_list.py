"""The list of runs on the page: columns, runs laid over each other, labels, and deletion."""

import http.client
import json
import shutil

import pytest
from playwright.sync_api import expect

from estune import api, tune
from estune.cli import run as estune
from estune.errors import InvalidInput
from estune.remote.messages.rights import Right
from estune.run.journal import Journal
from estune.run.labels import (
    LABELS,
    NUMBERS,
    Labels,
    ListedNumbers,
    read_labels,
    read_numbers,
    write_labels,
)
from estune.web.listed_run import ListedRun
from estune.web.run_folder import RunFolder
from estune.web.server import PageServer
from estune.web.views import folder_views
from tests.support_browser import needs_browser, opened, serious
from tests.support_runs import ArithmeticRig

NAMES = ("first", "second", "third")


@pytest.fixture
def runs(tmp_path):
    folder = tmp_path / "runs"
    tune(ArithmeticRig(), trials=2, run=NAMES[0], folder=folder, watch=None)
    for name in NAMES[1:]:
        shutil.copytree(folder / NAMES[0], folder / name)
    return folder


@needs_browser
def test_runs_are_laid_over_each_other_labelled_and_deleted_by_keyboard(chromium, runs):
    (runs / "first" / NUMBERS).write_text('{"rise_time_s": 0.0303, "overshoot": 0.05, "Ms": 1.6}')
    server = PageServer(folder_views(RunFolder(runs)), right=Right.COMMAND)
    try:
        with opened(chromium, server.address) as page:
            row = page.locator("#views tbody tr", has_text="first")
            expect(row).to_contain_text("30.3 ms")
            expect(row).to_contain_text("5.0 %")
            page.locator("#views tbody a", has_text="first").press("Enter")
            expect(page.locator("#title")).to_have_text("first")
            for name in NAMES[1:]:
                page.get_by_label(f"Lay {name} over the shown run").press("Space")
                expect(page.locator("#response .u-legend")).to_contain_text(name)
            expect(page.get_by_label("Lay first over the shown run")).to_be_disabled()
            page.get_by_label("Tags").fill("hose, cold , hose")
            page.get_by_label("Note").fill("after the bearing was changed")
            page.get_by_role("button", name="Store").press("Enter")
            expect(row).to_contain_text("hose, cold")
            assert serious(page) == []
            assert read_labels(runs / "first") == Labels(
                ("hose", "cold"), "after the bearing was changed"
            )
            page.once("dialog", lambda dialog: dialog.dismiss())
            page.get_by_role("button", name="Delete this run").press("Enter")
            assert (runs / "first").exists()
            asked = []
            page.once("dialog", lambda dialog: (asked.append(dialog.message), dialog.accept()))
            page.get_by_role("button", name="Delete this run").press("Enter")
            expect(page.locator("#answer")).to_contain_text("run first is deleted")
            expect(row).to_have_count(0)
            assert "first with all of its trials" in asked[0]
    finally:
        server.close()
    assert sorted(path.name for path in runs.iterdir()) == ["actions.jsonl", "second", "third"]
    actions = [json.loads(text) for text in (runs / "actions.jsonl").read_text().splitlines()]
    assert [one["action"] for one in actions] == ["label", "delete"]
    assert all(one["who"].endswith("on the live page") for one in actions)


@needs_browser
def test_list_that_changes_leaves_the_focus_where_it_is_and_sorts(chromium, runs):
    server = PageServer(folder_views(RunFolder(runs)))
    try:
        with opened(chromium, server.address) as page:
            box = page.get_by_label("Lay first over the shown run")
            box.focus()
            for name in NAMES:  # the focused row among them
                write_labels(runs / name, Labels(("cold",)))
            expect(page.locator("#views td", has_text="cold")).to_have_count(len(NAMES))
            expect(box).to_be_focused()
            for first in ("first", "third"):
                page.get_by_role("button", name="name").press("Enter")
                expect(page.locator("#views tbody tr").first).to_contain_text(first)
    finally:
        server.close()


def test_labels_and_deletion_are_refused_without_the_key_and_without_the_name(runs):
    server = PageServer(folder_views(RunFolder(runs)), right=Right.COMMAND)
    key = server.address.partition("#key=")[2]
    try:
        for token, arguments, status in (
            ("", {"confirmed": "first"}, 403),
            (key, {}, 409),
            (key, {"confirmed": "second"}, 409),
        ):
            link = http.client.HTTPConnection("127.0.0.1", server.port)
            asked = {"view": "first", "command": "delete", "arguments": arguments}
            link.request(
                "POST", "/api/command", json.dumps(asked), {"Authorization": f"Bearer {token}"}
            )
            answer = link.getresponse()
            assert answer.status == status, answer.read()
            answer.read()
            link.close()
    finally:
        server.close()
    assert (runs / "first").exists()


def test_a_run_that_is_being_written_is_not_deleted(runs):
    (view, *_) = [view for view in folder_views(RunFolder(runs))() if view.name == "first"]
    with (
        Journal.open(runs / "first", write=True),
        pytest.raises(InvalidInput, match="stop it first"),
    ):
        view.commands["delete"]("somebody", {"confirmed": "first"})
    assert (runs / "first").exists()


def test_finished_run_stores_its_numbers_and_the_list_shows_them(runs, capsys, monkeypatch):
    assert estune(
        ["tune", "plants:reference_reel", "--quiet", "--run", "reel", "--folder", str(runs)]
    ) in (0, 11)
    numbers = read_numbers(runs / "reel")
    assert None not in numbers
    capsys.readouterr()
    result = api.load(runs / "reel")
    assert (numbers.ending, numbers.cost) == (result.ending, result.fun)
    with Journal.open(runs / "second", write=True) as journal:
        journal.note(status="stopped")
    monkeypatch.setattr(api, "load", None)  # no run is replayed or identified for a list
    assert estune(["list", "--folder", str(runs), "--json"]) == 0
    listed = {row["run"]: row for row in json.loads(capsys.readouterr().out)}
    shown = [listed["reel"][name] for name in ListedNumbers._fields if name != "ending"]
    assert [*shown, listed["reel"]["state"]] == [*numbers]
    assert (listed["second"]["state"], listed["second"]["Ms"]) == ("stopped", None)
    assert listed["second"]["Ms"] is None


def test_listing_leaves_nothing_beside_a_finished_run_and_follows_a_running_one(runs):
    first = ListedRun(runs / "first")
    files = sorted((runs / "first").iterdir())
    assert first.row()["state"] == "finished"
    assert sorted((runs / "first").iterdir()) == files
    with Journal.open(runs / "first", write=True) as journal:
        for status in ("running", "stopped: by hand"):
            journal.note(status=status)
            assert first.row()["state"] == status.partition(":")[0]
    kept = first.row()
    assert first.row() is kept
    write_labels(runs / "first", Labels(("hose",)))
    assert first.row()["tags"] == ("hose",)


def test_page_that_has_the_list_is_not_sent_it_again(runs, monkeypatch):
    monkeypatch.setattr("estune.web.server.LIST_S", 0.0)
    server = PageServer(folder_views(RunFolder(runs)))

    def ask(tag: str) -> tuple[int, str, bytes]:
        link = http.client.HTTPConnection("127.0.0.1", server.port)
        link.request("GET", "/api/views", headers={"If-None-Match": tag})
        answer = link.getresponse()
        body = answer.read()
        link.close()
        return answer.status, answer.getheader("ETag"), body

    try:
        _, tag, first = ask("")
        assert ask(tag) == (304, tag, b"")
        write_labels(runs / "second", Labels(("cold",)))
        status, changed, second = ask(tag)
        assert status == 200
        assert changed != tag
        assert [row["tags"] for row in json.loads(second)["views"] if row["tags"]] == [["cold"]]
        assert len(json.loads(first)["views"]) == len(NAMES)
    finally:
        server.close()


@needs_browser
def test_many_runs_are_drawn_in_part_until_all_are_asked_for_and_filtered_as_a_whole(
    chromium, runs
):
    for n in range(110):
        shutil.copytree(runs / "first", runs / f"copy {n}")
    server = PageServer(folder_views(RunFolder(runs)))
    try:
        with opened(chromium, server.address) as page:
            rows = page.locator("#views tbody tr")
            expect(rows).to_have_count(100)
            page.get_by_role("searchbox").fill("copy 10")
            expect(rows).to_have_count(11)
            page.get_by_role("searchbox").fill("")
            page.get_by_role("button", name="Show all 113").press("Enter")
            expect(rows).to_have_count(113)
            expect(rows.nth(100).get_by_role("link")).to_be_focused()
            assert serious(page) == []
    finally:
        server.close()


@pytest.mark.parametrize("text", ["", "[]", "{", '{"tags": 3, "rise_time_s": "x", "Ms": NaN}'])
def test_damaged_labels_are_none(tmp_path, text):
    (tmp_path / LABELS).write_text(text)
    (tmp_path / NUMBERS).write_text(text)
    assert read_labels(tmp_path) == Labels()
    assert read_numbers(tmp_path) == ListedNumbers()


@pytest.mark.parametrize(
    "labels", [Labels(("x",) * 21), Labels(("x" * 41,)), Labels((), "x" * 2001)]
)
def test_labels_have_limits(tmp_path, labels):
    with pytest.raises(InvalidInput):
        write_labels(tmp_path, labels)
    assert not list(tmp_path.iterdir())
