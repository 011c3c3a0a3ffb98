"""The page of `estune explain`: from a dropped file to the verdict, in a real browser."""

import http.client
import json
from urllib.parse import quote

import pandas as pd
import pytest
from playwright.sync_api import expect

import plants
from estune.cli import run
from estune.errors import InvalidInput
from estune.run.results.export import write_record
from estune.trial import TrialRequest
from plants.explain_page import workbook as module
from plants.explain_page.server import ExplainPage
from plants.explain_page.workbook import Workbook, form
from plants.models.model_tables import KINDS
from tests.support_browser import browser, needs_browser, opened, serious

SEARCH_MS = 400_000.0
"""Time within which a search must end; far more than it takes on a busy machine."""
NAMES = {"time_s": "t", "setpoint_N": "target", "current_A": "amps", "tension_N": "pull"}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A record of the reference reel as somebody's own log: other names, ms and mA."""
    rig = plants.reference_reel().rig(seed=5)
    there = rig.describe()
    record = rig.run(TrialRequest("log", 0, there.gains, there.step))
    folder = tmp_path_factory.mktemp("log")
    table = pd.read_csv(write_record(record, folder))
    table = table[[*NAMES, "angle_rad"]].rename(columns=NAMES)
    table["t"], table["amps"] = 1e3 * table["t"], 1e3 * table["amps"]
    path = folder / "given" / "my log.csv"
    path.parent.mkdir()
    table.to_csv(path, index=False)
    return path


@pytest.fixture
def page(tmp_path):
    made = ExplainPage(Workbook(tmp_path / "work"))
    yield made
    made.close()


@pytest.mark.slow
@needs_browser
def test_dropped_log_is_mapped_by_hand_and_explained_with_a_model_by_form(page, log, tmp_path):
    narrow = {"viewport": {"width": 400, "height": 800}, "color_scheme": "dark"}
    with browser() as chromium, opened(chromium, page.address, **narrow) as shown:
        shown.set_input_files("#files", log)
        expect(shown.locator("#fault")).to_contain_text("the file has t, target, amps, pull")
        for name, source in NAMES.items():
            shown.get_by_label(f"from of {name}").select_option(source)
        shown.get_by_label("unit of time_s").select_option("ms")
        shown.get_by_label("unit of current_A").select_option("mA")
        shown.get_by_role("button", name="Read again").press("Enter")
        expect(shown.locator("#list")).to_contain_text("632")
        expect(shown.locator("#curves canvas")).to_have_count(4)
        shown.locator("#described summary").press("Enter")
        shown.get_by_label("drum_inertia_kg_m2").fill("0.002")
        expect(shown.locator("#toml")).to_have_value("[reel]\ndrum_inertia_kg_m2 = 0.002\n")
        assert serious(shown) == []
        shown.get_by_role("button", name="Use this model").click()
        expect(shown.locator("#model")).to_contain_text("model.toml")
        shown.get_by_role("button", name="Explain", exact=True).click()
        expect(shown.locator("#progress")).to_contain_text("%")
        expect(shown.locator("#heading")).to_contain_text("prediction error", timeout=SEARCH_MS)
        again = shown.locator("#again").inner_text()
        assert again.startswith("estune explain --model ")
        assert "--map " in again
        report = shown.frame_locator("#report")
        expect(report.locator("h1")).to_have_text("Where simulation and measurement disagree")
        assert shown.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert serious(shown) == []
    improved = plants.load_model(str(tmp_path / "work" / "improved.toml"))
    assert improved.drum_inertia_kg_m2 == pytest.approx(0.002, rel=0.1)


@pytest.mark.slow
@needs_browser
def test_lists_of_numbers_need_no_brackets_and_a_fault_stands_beside_its_field(page):
    with browser() as chromium, opened(chromium, page.address) as shown:
        shown.locator("#described summary").click()
        shown.get_by_label("Kind").select_option("linear plant")
        for text in ("[45.8]", "45.8", " [ 45.8 ] "):
            shown.get_by_label("numerator").fill(text)
            expect(shown.locator("#toml")).to_have_value("[linear_plant]\nnumerator = [45.8]\n")
        shown.get_by_label("denominator").fill("0.1, one")
        shown.get_by_role("button", name="Use this model").click()
        wrong = shown.locator("#key-denominator + .wrong")
        expect(wrong).to_have_text('this is "one"; it must be a number')
        expect(shown.locator("#message")).to_be_empty()
        shown.get_by_label("denominator").fill("[0.1, 1]")
        shown.get_by_role("button", name="Use this model").click()
        expect(shown.locator("#model")).to_contain_text("model.toml")
        expect(shown.locator(".wrong")).to_have_count(0)


def asked(page, path, method="GET", body=b"", key=None):
    """Status and content of an answer."""
    address, _, token = page.address.partition("#key=")
    port = int(address.rpartition(":")[2].strip("/"))
    server = http.client.HTTPConnection("127.0.0.1", port)
    token = token if key is None else key
    server.request(method, path, body, {"Authorization": f"Bearer {token}"})
    answer = server.getresponse()
    text = answer.read()
    server.close()
    return answer.status, json.loads(text) if answer.status != 404 else {}


@pytest.mark.parametrize("path", ["/api/records", "/api/state", "/api/form"])
def test_nothing_is_read_or_done_without_the_key(page, tmp_path, path):
    assert asked(page, path, key="wrong")[0] == 403
    assert asked(page, "/api/file/a.csv", "POST", b"x", key="")[0] == 403
    assert asked(page, "/api/act/folder", "POST", b'{"path": "/"}', key="")[0] == 403
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(
    ("name", "reason"),
    [("../a.csv", "no name of a file"), (".a.csv", "no name of a file"), ("a.exe", "no record")],
)
def test_files_of_other_names_are_refused(page, tmp_path, name, reason):
    status, answer = asked(page, f"/api/file/{quote(name, safe='')}", "POST", b"x")
    assert status == 404 or reason in answer["error"]
    assert not list(tmp_path.rglob("*.csv"))


def test_a_file_above_the_limit_is_refused_and_nothing_of_it_is_kept(page, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "FILE_MAX_BYTES", 1000)
    _, answer = asked(page, "/api/file/a.csv", "POST", bytes(1001))
    assert "open its folder by its path" in answer["error"]
    assert list((tmp_path / "work" / "data").iterdir()) == []


def test_mistakes_are_sentences(page, log):
    def error(act, **given):
        return asked(page, f"/api/act/{act}", "POST", json.dumps(given))[1].get("error", "")

    assert "does not exist" in error("folder", path="/nowhere")
    assert "give records" in error("begin")
    assert not error("folder", path=str(log))
    assert "give a model" in error("begin")
    assert "is not a number" in error("columns", columns={"time_s": {"scale": "x"}})
    assert "no column tim" in error("columns", columns={"tim": {"from": "t"}})
    assert "drum_inertia" in error("model", toml="[reel]\ndrum_inertia = 1")
    assert "cannot be used" in asked(page, "/api/act/begin", "POST", b"{")[1]["error"]


def test_search_can_be_stopped_and_begun_again(tmp_path, log):
    work = Workbook(tmp_path)
    work.use(str(log))
    work.map_columns({name: {"from": source} for name, source in NAMES.items()})
    work.use_model(reference="plants:reference_reel")
    work.begin()
    with pytest.raises(InvalidInput, match="under way"):
        work.begin()
    work.search.stop()
    assert work.state() == {"state": "stopped"}
    work.begin()
    work.search.stop()


@pytest.mark.slow
def test_failed_search_says_why(tmp_path):
    (tmp_path / "empty.csv").write_text("time_s,tension_N\n")
    work = Workbook(tmp_path / "work")
    work.use(str(tmp_path / "empty.csv"))
    work.use_model(reference="plants:reference_reel")
    work.begin()
    work.search._process.wait()
    state = work.state()
    assert state["state"] == "failed"
    assert "no record that can be used" in state["reason"]


def test_command_refuses_records_and_models_that_are_not_there(capsys):
    assert run(["explain-page", "/nowhere"]) == 2
    assert run(["explain-page", "--model", "nothing.toml"]) == 2
    said = capsys.readouterr().err
    assert "/nowhere does not exist" in said
    assert "nothing.toml" in said


def test_form_has_every_kind_of_model_with_its_keys():
    kinds = form()
    assert [kind["table"] for kind in kinds] == [kind.table for kind in KINDS]
    reel = next(kind for kind in kinds if kind["table"] == "reel")
    key = {"name": "cable_length_m", "form": "number", "default": 0.8}
    assert key in reel["keys"]
