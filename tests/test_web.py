"""The server of the live page without a browser: boards, readers, guards, and bad journals."""

import http.client
import json
import re
import shutil
import socket
import threading
from functools import partial
from importlib.resources import files

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estune import tune
from estune.errors import InvalidInput, RigError
from estune.remote.messages.rights import Right
from estune.remote.zenoh import RemoteRig, connect
from estune.run.journal import Journal
from estune.support.user import user_at_host
from estune.web.board import Board, Seen
from estune.web.history import HISTORY_MAX
from estune.web.http_service import usual_port
from estune.web.reader import Reader
from estune.web.rig_reader import RigReader
from estune.web.run_folder import RunFolder
from estune.web.run_reader import RunReader
from estune.web.server import FOLDERS, PageServer
from estune.web.views import View, folder_views, run_view
from tests.serve_rig import hosted
from tests.support_runs import ArithmeticRig

KEY = re.compile(r"#key=(.+)")


class Follower:
    """What a page knows of a board after each change it was sent."""

    def __init__(self) -> None:
        self.seen, self.values, self.tables = Seen(), {}, {}

    def take(self, board: Board) -> None:
        text, self.seen = board.changes(self.seen)
        change = json.loads(text) if text else {"values": {}, "tables": {}}
        self.values |= change["values"]
        for name, table in change["tables"].items():
            kept = [] if table["restart"] else self.tables[name]
            self.tables[name] = kept + table["rows"]


steps = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.sampled_from("ab"), st.integers(0, 2)),
        st.tuples(st.just("add"), st.sampled_from("xy"), st.lists(st.integers(), max_size=3)),
        st.tuples(st.just("restart"), st.sampled_from("xy"), st.lists(st.integers(), max_size=3)),
        st.tuples(st.just("look"), st.none(), st.none()),
    )
)


@given(steps)
def test_page_that_looks_at_any_times_knows_the_board_at_the_end(steps):
    board, often, once = Board(), Follower(), Follower()
    values, tables = {}, {}
    for step, name, value in steps:
        if step == "put":
            board.put(name, value)
            values[name] = value
        elif step == "look":
            often.take(board)
        else:
            board.extend(name, value, restart=step == "restart")
            tables[name] = value if step == "restart" else tables.get(name, []) + value
    for page in (often, once):
        page.take(board)
        assert page.values == values
        assert {name: page.tables.get(name, []) for name in tables} == tables
        assert board.changes(page.seen)[0] == ""


def test_numbers_that_are_not_finite_are_sent_as_null():
    board = Board()
    board.put("limits", [float("inf"), {"a": float("nan")}])
    assert json.loads(board.changes(Seen())[0])["values"] == {"limits": [None, {"a": None}]}


@pytest.fixture
def server():
    done = []
    view = View(
        "reel",
        "rig",
        Board(),
        [],
        commands={"estop": lambda who, _given: done.append(who) or "asked"},
    )
    server = PageServer(lambda: [view], right=Right.COMMAND)
    server.done = done
    yield server
    server.close()


def ask(server, path="/", method="GET", body=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    answer.text = answer.read().decode()
    connection.close()
    return answer


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:{port}"}, 200),
        ({"Host": "evil.example:{port}"}, 400),
        ({"Host": "127.0.0.1:1"}, 400),
        ({"Origin": "http://127.0.0.1:{port}"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "https://127.0.0.1:{port}"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
def test_foreign_host_and_origin_are_refused(server, headers, status):
    given = {name: text.format(port=server.port) for name, text in headers.items()}
    assert ask(server, **given).status == status


def test_command_needs_the_key_and_a_known_name(server):
    key = KEY.search(server.address)[1]
    body = json.dumps({"view": "reel", "command": "estop"})
    with_key = {"Authorization": f"Bearer {key}"}
    assert ask(server, "/api/command", "POST", body).status == 403
    assert ask(server, "/api/command", "POST", body, Authorization="Bearer x").status == 403
    assert ask(server, "/api/command", "POST", "{", **with_key).status == 400
    unknown = json.dumps({"view": "reel", "command": "clear"})
    assert ask(server, "/api/command", "POST", unknown, **with_key).status == 400
    assert ask(server, "/api/command", "POST", " " * 5000, **with_key).status == 400
    assert server.done == []
    answer = ask(server, "/api/command", "POST", body, **with_key)
    assert json.loads(answer.text) == {"done": True, "sentence": "asked"}
    assert server.done == [f"{user_at_host()} on the live page"]


@pytest.mark.parametrize(
    ("page", "at_rig", "allowed"),
    [
        (Right.COMMAND, None, ["apply", "estop", "label"]),  # no link yet
        (Right.COMMAND, Right.STOP, ["estop", "label"]),
        (Right.COMMAND, Right.LOOK, ["label"]),
        (Right.STOP, Right.COMMAND, ["estop"]),
        (Right.LOOK, Right.COMMAND, []),
    ],
)
def test_page_shows_and_does_what_it_and_its_server_have_a_right_to(page, at_rig, allowed):
    commands = dict.fromkeys(("estop", "apply", "label"), lambda *_: "done")
    view = View("reel", "rig", Board(), [], commands=commands)
    view.board.put("right", at_rig)
    server = PageServer(lambda: [view], right=page)
    found = KEY.search(server.address)
    headers = {"Authorization": f"Bearer {found[1] if found else ''}"}
    done = []
    for name in commands:
        body = json.dumps({"view": "reel", "command": name})
        if ask(server, "/api/command", "POST", body, **headers).status == 200:
            done.append(name)
    assert sorted(done) == view.allowed(page) == allowed
    server.close()


def test_server_without_leave_to_command_has_no_key_and_refuses():
    server = PageServer(list)
    assert "#" not in server.address
    body = json.dumps({"view": "reel", "command": "estop"})
    assert ask(server, "/api/command", "POST", body, Authorization="Bearer ").status == 403
    server.close()


def test_page_is_small_and_may_load_its_own_files_alone(server):
    folders = [files(package).joinpath(folder) for package, folder in FOLDERS]
    names = [one.name for at in folders for one in at.iterdir() if one.suffix != ".LICENSE"]
    texts = [ask(server, f"/static/{name}").text for name in names]
    assert ask(server).text in texts
    assert {"uPlot.iife.min.js", "page.js", "tuner.js"} < set(names)
    assert sum(map(len, texts)) < 155_000
    assert "default-src 'self'" in ask(server).headers["Content-Security-Policy"]
    assert ask(server, "/static/../server.py").status == 404
    assert ask(server, "/static/page.py").status == 404
    licence = files("estune.support").joinpath("charts", "uPlot.LICENSE").read_text()
    assert "MIT License" in licence


def test_taken_port_and_reachable_address_are_refused_with_the_remedy(server):
    with pytest.raises(InvalidInput, match="choose another --port"):
        PageServer(list, port=server.port)
    with pytest.raises(InvalidInput, match="--allow-remote"):
        PageServer(list, host="0.0.0.0")  # noqa: S104  refused


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    options = {"tuner": "safe_bayesian", "tolerance": 0.0, "trials": 20, "watch": None}
    return tune(ArithmeticRig(), run="one", folder=folder, **options)


def read_once(folder) -> Board:
    board = Board()
    reader = RunReader(board, folder)
    reader.read()
    reader.release()
    return board


def test_finished_run_shows_its_trials_result_and_expectation(run):
    page = Follower()
    page.take(read_once(run.folder))
    assert [row[:2] for row in page.tables["trials"]] == [[e.number, e.cost] for e in run.entries]
    assert page.values["result"]["heading"] == run.heading()
    assert page.values["state"]["best"]["cost"] == min(e.cost for e in run.entries[:23])
    assert page.values["expected"].keys() >= {"remaining", "intervals", "next_cost"}
    assert page.values["curve.start"]["y"] == pytest.approx(run.first_record.tension_N, rel=1e-5)


def test_page_of_a_finished_run_shows_nothing_of_the_next_one_on_its_rig(tmp_path):
    few = {"trials": 1, "repeats": 2, "watch": None}
    with hosted("paced simulated") as endpoint:
        tune(endpoint, run="first", folder=tmp_path, **few)
        view = run_view(tmp_path / "first")
        run_reader, rig_reader = view._readers
        run_reader.read()
        rig_reader.read()
        assert view.board.get("state")["status"] == "finished"
        assert view.board.get("rig") is None
        connecting = partial(connect, endpoint, "reel")
        own, every = (RigReader(Board(), connecting, run=name) for name in ("first", ""))
        for reader in (own, every):
            reader.read()
        tune(endpoint, run="second", folder=tmp_path, **few)
        assert every.board.get("live")["trial_id"].startswith("second-")
        assert own.board.get("live") is None
        for reader in (run_reader, own, every):
            reader.release()


def test_emergency_stop_reaches_a_rig_that_no_reading_has_a_link_to():
    with hosted("paced simulated") as endpoint:
        RigReader(Board(), partial(connect, endpoint, "reel")).estop("smoke")
        with connect(endpoint) as there:
            assert there.status().latched == "smoke"
            there.clear()
            late = RigReader(Board(), partial(connect, endpoint, "reel"))
            late.read()
            rig = late._rig
            rig.estop = lambda reason: (late.release(), RemoteRig.estop(rig, reason))
            late.estop("fire")
            assert there.status().latched == "fire"
        absent = RigReader(Board(), partial(connect, endpoint, "other", timeout_s=0.1))
        with pytest.raises(RigError, match="cut its power"):
            absent.estop("smoke")


def test_running_journal_is_followed_from_trial_to_trial(tmp_path):
    board, counts, readers = Board(), [], []

    def look(progress):
        if not readers:
            readers.append(RunReader(board, tmp_path / "two"))
        readers[0].read()
        counts.append((board.get("state")["done"], progress.session.number))

    tune(ArithmeticRig(), trials=4, run="two", folder=tmp_path, watch=look, tuner="safe_bayesian")
    readers[0].release()
    assert all(shown == done for shown, done in counts)


def test_long_history_is_thinned_to_the_best_and_worst_of_each_stretch(run, tmp_path):
    shutil.copytree(run.folder, tmp_path / "long")
    with Journal.open(tmp_path / "long", write=True) as journal:
        rows = (
            (100 + n, 0, f"x{n}", "search", 1.0, 1.0, 1.0, 1.0, "", "done", 1.0 + n % 997, 1.0)
            for n in range(20_000)
        )
        journal._file.write_many(
            "INSERT INTO trial (number, attempt, trial_id, phase, P, I, D, setpoint_filter_s,"
            " asked_at, outcome, cost, margin) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            rows,
        )
        journal.note(status="stopped")
    page = Follower()
    page.take(read_once(tmp_path / "long"))
    shown = page.tables["trials"]
    assert len(shown) <= HISTORY_MAX + 2
    assert min(row[1] for row in shown) == min(e.cost for e in run.entries)
    assert page.values["state"]["done"] == 20_000 + len(run.entries)


def test_page_open_for_days_is_sent_a_thinned_history_now_and_then(tmp_path, monkeypatch):
    monkeypatch.setattr("estune.web.history.HISTORY_MAX", 10)
    board, page, lengths = Board(), Follower(), []
    readers = []

    def look(_progress):
        if not readers:
            readers.append(RunReader(board, tmp_path / "days"))
        readers[0].read()
        page.take(board)
        lengths.append(len(page.tables["trials"]))

    tune(ArithmeticRig(), trials=40, run="days", folder=tmp_path, watch=look, tolerance=0.0)
    readers[0].release()
    assert len(lengths) > 40
    assert max(lengths) <= 22
    assert page.tables["trials"][-1][0] == len(lengths) - 1


def test_run_that_a_full_disk_ended_says_so(run, tmp_path, monkeypatch):
    shutil.copytree(run.folder, tmp_path / "full")
    with Journal.open(tmp_path / "full", write=True) as journal:
        journal.note(status="running")
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=0))
    status = read_once(tmp_path / "full").get("state")["status"]
    assert status.startswith("interrupted: its process has ended; the disk is full; make room")
    assert status.endswith(f"estune resume {tmp_path / 'full'}")


def test_source_is_read_while_a_page_shows_it_and_again_later(monkeypatch):
    monkeypatch.setattr("estune.web.reader.LINGER_S", 0.05)
    read, released = threading.Event(), threading.Event()
    reader = Reader(Board())
    reader.read, reader.release = read.set, released.set
    for _ in range(3):
        read.clear()
        released.clear()
        reader.look()
        assert read.wait(60.0)
        assert released.wait(60.0)
    reader.close()


def test_damaged_and_missing_journals_are_shown_as_faults_and_left_as_they_are(run, tmp_path):
    folder = tmp_path / "runs" / "torn"
    folder.mkdir(parents=True)
    whole = (run.folder / "run.sqlite").read_bytes()
    torn = whole[: len(whole) // 2]
    (folder / "run.sqlite").write_bytes(torn)
    board = Board()
    reader = RunReader(board, folder)
    reader.look()
    while not board.get("fault.run"):
        pass
    reader.close()
    assert "torn" in board.get("fault.run") or "damaged" in board.get("fault.run")
    assert (folder / "run.sqlite").read_bytes() == torn


def test_folder_lists_its_runs_and_those_begun_later(run, tmp_path):
    views = folder_views(RunFolder(tmp_path))
    assert views() == []
    shutil.copytree(run.folder, tmp_path / "copy")
    assert [view.name for view in views()] == ["copy"]
    assert views()[0] is views()[0]
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "run.sqlite").write_bytes(b"SQLite format 3")
    assert {view.name for view in views()} == {"copy", "torn"}


def test_usual_port_is_left_to_the_page_that_has_it():
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        assert usual_port(taken) == 0
    assert usual_port(taken) == taken
