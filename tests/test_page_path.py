"""A newcomer's path on the page alone: tune, drag, try, apply, stop; and a rig that dies."""

import json
import re
from functools import partial

import pytest
from playwright.sync_api import expect

from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.messages.rights import Right
from estune.support.user import user_at_host
from estune.trial import TrialRequest
from estune.web.run_folder import RunFolder
from estune.web.server import PageServer
from estune.web.views import rig_view
from tests.serve_rig import served
from tests.support_browser import check_forms, needs_browser, opened, serious

pytestmark = needs_browser

TRIALS = "search at most this many trials"


@pytest.fixture
def emulated(tmp_path):
    """A simulated reel in a process of its own, and the server of its page."""
    with served("paced simulated") as rig:
        view = rig_view(rig.endpoint, "reel", runs=RunFolder(tmp_path))
        server = PageServer(lambda: [view], right=Right.COMMAND)
        try:
            yield rig, server, tmp_path
        finally:
            server.close()


def test_by_keyboard_alone_a_rig_is_tuned_dragged_tried_and_applied(chromium, emulated):
    rig, server, folder = emulated
    with (
        opened(chromium, server.address) as page,
        zenoh.connect(rig.endpoint) as there,
    ):
        before = there.describe().gains
        page.get_by_role("button", name="Start a tuning").press("Enter")
        page.locator("#form summary").press("Enter")
        page.get_by_label(TRIALS).press_sequentially("8")
        page.get_by_role("button", name="Start", exact=True).press("Enter")
        expect(page.locator("#events")).to_contain_text("the tuning has ended with code")
        page.locator("#tuning summary").press("Enter")
        slider = page.get_by_role("slider", name="P, N/N")
        shown = page.locator("#tuner output[for=tune-P]").inner_text()
        slider.press("ArrowLeft")
        expect(page.locator("#tuner output[for=tune-P]")).not_to_have_text(shown)
        page.get_by_role("button", name="Optimum for these limits").press("Enter")
        check_forms(page)
        page.get_by_role("button", name="Try these gains once").press("Enter")
        expect(page.locator("#answer")).to_contain_text("the rig has its live gains again")
        for shown in (page.locator("#answer"), page.get_by_role("button", name="Emergency stop")):
            expect(shown).to_be_in_viewport()
        expect(page.locator("#facts")).not_to_contain_text("not in this folder")
        expect(page.get_by_role("button", name="Stop the tuning")).to_be_hidden()
        assert there.describe().gains == before
        page.locator("#tuner").get_by_role("button", name="Make these gains live").press("Enter")
        asked = page.locator("#form")
        expect(asked).to_contain_text("Measured in one trial")
        expect(asked).to_contain_text("Predicted to keep Ms at most 1.6")
        assert serious(page) == []
        text = asked.inner_text()
        page.get_by_role("button", name="Make live", exact=True).press("Enter")
        expect(page.locator("#answer")).to_contain_text("these gains are live")
        after = there.describe().gains
        assert after != before
        assert f"{before.P:.4g}\t{after.P:.4g}" in text
    actions = [json.loads(line) for line in (folder / "actions.jsonl").read_text().splitlines()]
    assert [one["action"] for one in actions] == ["tune", "tune", "try", "try", "apply", "apply"]
    assert {one["who"] for one in actions} == {f"{user_at_host()} on the live page", "estune"}


def test_tuning_stopped_from_the_page_restores_the_rig_and_can_be_resumed(chromium, emulated):
    rig, server, folder = emulated
    with opened(chromium, server.address) as page, zenoh.connect(rig.endpoint) as there:
        before = there.describe().gains
        page.get_by_role("button", name="Start a tuning").click()
        page.locator("#form summary").click()
        page.get_by_label(TRIALS).fill("400")
        page.get_by_label("end when less than this is left to gain").fill("0")
        page.get_by_role("button", name="Start", exact=True).click()
        expect(page.locator("#facts")).to_contain_text(re.compile("done, (at most|about)"))
        page.get_by_role("button", name="Stop the tuning").click()
        expect(page.locator("#events")).to_contain_text("the tuning has ended with code 130")
        assert there.describe().gains == before
        assert len([*folder.glob("page-*/run.sqlite")]) == 1


def test_emergency_stop_is_in_reach_beside_an_open_form_and_is_reset_when_agreed(
    chromium, emulated
):
    _, server, _ = emulated
    with opened(chromium, server.address) as page:
        start = page.get_by_role("button", name="Start a tuning")
        start.click()
        page.get_by_role("button", name="Emergency stop").click()
        expect(page.locator("#answer")).to_contain_text("it is in its safe state")
        page.keyboard.press("Escape")
        expect(page.locator("#form")).to_be_hidden()
        expect(start).to_be_hidden()
        reset = page.get_by_role("button", name="Reset the emergency stop")
        page.once("dialog", lambda asked: asked.dismiss())
        reset.click()
        expect(page.locator("#state")).to_have_text("emergency stop")
        page.once("dialog", lambda asked: asked.accept())
        reset.click()
        expect(page.locator("#state")).to_have_text("idle")
        expect(start).to_be_visible()


def test_page_with_the_right_to_stop_alone_stops_and_offers_nothing_else(chromium, tmp_path):
    with served("simulated") as rig:
        view = rig_view(rig.endpoint, "reel", runs=RunFolder(tmp_path))
        server = PageServer(lambda: [view], right=Right.STOP)
        try:
            with opened(chromium, server.address) as page, zenoh.connect(rig.endpoint) as there:
                stop = page.get_by_role("button", name="Emergency stop")
                expect(stop).to_be_enabled()
                others = "button:visible:not(#estop)"
                names = {b.inner_text() for b in page.locator(others).all()}
                assert not names & {"Start a tuning", "Clear", "Make these gains live"}, names
                stop.click()
                expect(page.locator("#answer")).to_contain_text("stop")
                about = there.describe()
                with pytest.raises(RigError, match="emergency stop"):
                    there.run(TrialRequest("after", 0, about.gains, about.step))
                assert page.get_by_role("button", name="Clear").count() == 0
        finally:
            server.close()


def test_rig_killed_during_a_tuning_is_shown_as_gone_and_refuses_by_a_sentence(chromium, emulated):
    rig, server, _ = emulated
    with opened(chromium, server.address) as page:
        page.get_by_role("button", name="Start a tuning").click()
        page.get_by_role("button", name="Start", exact=True).click()
        expect(page.locator("#facts")).to_contain_text(re.compile("done, (at most|about)"))
        rig.process.kill()
        expect(page.locator("#state")).to_have_text("no link to the rig")
        expect(page.locator("#age")).to_contain_text("old")
        check_forms(page)


NEW_GAINS = {"P": 0.5, "I": 14.0, "D": 0.011, "setpoint_filter_s": 0.02}


def test_actions_are_refused_while_another_holds_the_rig_and_when_its_gains_have_changed(emulated):
    rig, server, _ = emulated
    act = {
        name: partial(execute, "somebody") for name, execute in server._views()[0].commands.items()
    }
    with zenoh.connect(rig.endpoint) as other:
        other.acquire()
        with pytest.raises(RigError, match="held"):
            act["try"]({"gains": NEW_GAINS})
    with pytest.raises(RigError, match="have changed meanwhile"):
        act["apply"]({"gains": NEW_GAINS, "instead_of": NEW_GAINS})
    with pytest.raises(InvalidInput, match="give a number"):
        act["try"]({"gains": {"P": "x"}})
    with pytest.raises(InvalidInput, match="no setting 'trails'"):
        act["tune"]({"settings": {"trails": "3"}})
    with pytest.raises(InvalidInput, match="no tuning was started"):
        act["stop"]({})
    with zenoh.connect(rig.endpoint) as other:
        assert pytest.approx(0.4) == other.describe().gains.P


def test_page_without_the_key_has_no_button_that_acts(chromium, emulated):
    _, server, _ = emulated
    with opened(chromium, server.address.partition("#")[0]) as page:
        expect(page.locator("#state")).to_have_text("idle")
        expect(page.get_by_role("button")).to_have_count(0)
