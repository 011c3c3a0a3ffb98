"""Views of a server: runs, rigs and supervised rigs, each with a board and its readers."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

from estune.errors import JournalError
from estune.remote.messages.commands import VERBS
from estune.remote.messages.daemon import (
    DAEMON_VERBS,
    Command,
    CommandAnswer,
    DaemonStatus,
    DaemonVerb,
    Events,
    History,
    Request,
)
from estune.remote.messages.rights import Right
from estune.remote.security import OPEN, Security
from estune.remote.zenoh import RemoteRig, connect
from estune.remote.zenoh.daemon_service import DaemonClient, Supervised
from estune.run.journal import Journal
from estune.run.targets import is_endpoint
from estune.web.banner import show_banner
from estune.web.board import Board, Seen
from estune.web.daemon_reader import DaemonReader
from estune.web.listed_run import ListedRun
from estune.web.reader import Reader
from estune.web.rig_actions import TRIED, RigActions
from estune.web.rig_reader import RigReader, run_of
from estune.web.run_actions import STORED, run_actions
from estune.web.run_folder import RunFolder
from estune.web.run_reader import RunReader
from estune.web.tuning_form import form
from estune.web.tuning_source import TuningSource

LINK_S = 2.0
"""Time that a rig has to answer before the page says that there is no link, s."""

Execute = Callable[[str, Mapping[str, Any]], str]
"""Executes a command for somebody named, with its arguments; returns what is being done."""


class View:
    """One rig or run. It is read while it is looked at.

    Attributes:
        gone: Since when it is no longer there, in words; empty while it is.
        summary: What the list of views shows of it beside its state.
    """

    def __init__(
        self,
        name: str,
        kind: Literal["run", "rig", "daemon"],
        board: Board,
        readers: Iterable[Reader],
        *,
        commands: Mapping[str, Execute] | None = None,
        tuning: TuningSource | None = None,
        actions: RigActions | None = None,
        summary: Callable[[], dict[str, Any]] = dict,
        earlier: Callable[[], Sequence[ListedRun]] = tuple,
    ) -> None:
        self.name = name
        self.summary = summary
        self.gone = ""
        self._earlier = earlier
        self._actions = actions
        self.tuning = tuning or TuningSource()
        self.kind = kind
        self.board = board
        self.commands = dict(commands or {})
        self._readers = list(readers)

    def allowed(self, right: Right) -> list[str]:
        """The commands that a page of a right may give now: its server needs the right, too."""
        at_rig = Right(self.board.get("right") or Right.COMMAND)  # not known yet: the rig refuses
        return sorted(name for name in self.commands if self._allows(name, right, at_rig))

    def _allows(self, name: str, right: Right, at_rig: Right) -> bool:
        needed = VERBS[name].right if name == "estop" else Right.COMMAND
        elsewhere = name in STORED or (self.kind == "daemon" and name != "estop")
        return right.includes(needed) and (elsewhere or at_rig.includes(needed))

    def form(self) -> dict[str, Any]:
        """The form that starts a tuning."""
        return form(self.board.get("description"), self._earlier())

    def look(self) -> None:
        """Has all of it read for a while."""
        for reader in tuple(self._readers):
            reader.look()

    def glance(self) -> None:
        """Has read what the list of views shows; a run is read when it is looked at."""
        if self.kind != "run" and not self.gone:
            for reader in self._readers[:1]:
                reader.look()

    def changes(self, seen: Seen) -> tuple[str, Seen]:
        """Changes of the board that a page has not been sent yet, with what they come to."""
        show_banner(self.board, self.kind)
        return self.board.changes(seen)

    def close(self) -> None:
        """Ends the readers, and a tuning that was started on the page."""
        if self._actions is not None:
            self._actions.close()
        for reader in tuple(self._readers):
            reader.close()


Views = Callable[[], Sequence[View]]
"""The views that there are now; the same objects each time."""


def run_view(listed: ListedRun | Path, security: Security = OPEN) -> View:
    """A run, with the rig at the endpoint it was made on."""
    listed = ListedRun(listed) if isinstance(listed, Path) else listed
    board, folder = Board(), listed.folder
    readers: list[Reader] = [RunReader(board, folder)]
    actions = None
    row = listed.row()
    target, rig = listed.target, str(row.get("rig", ""))
    if "rig" not in row:  # opened again, it says why, or has just begun
        with Journal.open(folder) as journal:
            target, rig = journal.fact("target"), journal.fact("rig")["name"]
    commands: dict[str, Execute] = run_actions(folder, rig)
    if is_endpoint(target):
        connect_rig = _connecting(target, rig, security)
        run, is_wanted = folder.name, partial(_is_running, board)
        reader = RigReader(board, connect_rig, run=run, is_wanted=is_wanted)
        readers.append(reader)
        actions = _actions(board, target, rig, security, folder.parent)
        kept = {name: actions.commands()[name] for name in ("resume", "stop")}
        commands |= {"estop": _stopping(reader), **kept}
    return View(
        folder.name,
        "run",
        board,
        readers,
        commands=commands,
        tuning=TuningSource(lambda: folder),
        actions=actions,
        summary=listed.row,
    )


def folder_views(runs: RunFolder, security: Security = OPEN) -> Views:
    """The newest runs of a folder, also those that are begun later."""
    kept: dict[Path, View] = {}

    def views() -> list[View]:
        newest = {listed.folder: listed for listed in runs.newest()}
        for path, listed in newest.items():
            if path not in kept:
                with suppress(JournalError):  # half-copied, or just being begun: tried again
                    kept[path] = run_view(listed, security)
        for path in kept.keys() - set(newest):  # deleted meanwhile
            kept.pop(path).close()
        return [kept.get(path) or _unreadable(listed) for path, listed in newest.items()]

    return views


def _unreadable(listed: ListedRun) -> View:
    """A run whose journal cannot be read; the page says why."""
    board = Board()
    reader = RunReader(board, listed.folder)
    return View(listed.folder.name, "run", board, [reader], summary=listed.row)


def _is_running(board: Board) -> bool:
    state = board.get("state")
    return state is not None and state["status"] == "running"


def rig_view(
    endpoint: str, rig: str, security: Security = OPEN, *, runs: RunFolder | None = None
) -> View:
    """A rig at an endpoint, with its newest run."""
    board = Board()
    reader = RigReader(board, _connecting(endpoint, rig, security))
    commands: dict[str, Execute] = {"estop": _stopping(reader)}
    actions = None
    newest = NewestRun(board, runs, rig, _run_of_status)
    if runs is not None:
        actions = _actions(board, endpoint, rig, security, runs.path)
        commands |= actions.commands()
    return View(
        *(rig, "rig", board, [reader, RunReader(board, newest)]),
        commands=commands,
        actions=actions,
        tuning=TuningSource(newest),
        summary=lambda: {"rig": rig},
        earlier=newest.listed,
    )


def _stopping(reader: RigReader) -> Execute:
    return lambda who, _given: reader.estop(who)


def _actions(board: Board, endpoint: str, rig: str, security: Security, runs: Path) -> RigActions:
    def connect_for(who: str) -> RemoteRig:
        return connect(endpoint, rig, LINK_S, holder=who, security=security)

    return RigActions(connect_for, board, endpoint, rig, runs, may_tune=security is OPEN)


def _run_of_status(board: Board) -> tuple[str, bool]:
    """The run that a rig says holds it, or held it last, and whether its trial is under way."""
    rig = board.get("rig") or {"trial_id": "", "last": ""}
    return run_of(rig["trial_id"] or rig["last"]), bool(rig["trial_id"])


def _run_of_daemon(board: Board) -> tuple[str, bool]:
    """The run that a daemon says is under way."""
    daemon = board.get("daemon") or {"run": ""}
    return daemon["run"], bool(daemon["run"])


class NewestRun:
    """The newest run of a rig, whatever started it, and whenever.

    That is the one under way, else the one that the rig last ran a trial of, else the one whose
    last trial is the youngest. A run elsewhere is named on the board, under `elsewhere`.

    Args:
        runs: Folder of runs; None where there is none.
        said: The run that the rig or its daemon names on the board, and whether it is under way.
    """

    def __init__(
        self,
        board: Board,
        runs: RunFolder | None,
        rig: str,
        said: Callable[[Board], tuple[str, bool]],
    ) -> None:
        self._board = board
        self._runs = runs
        self._rig = rig
        self._said = said

    def listed(self) -> list[ListedRun]:
        """The runs of the rig in the folder, newest first."""
        return [] if self._runs is None else self._runs.of_rig(self._rig)

    def __call__(self) -> Path | None:
        """The run; None if there is none in the folder."""
        said, is_under_way = self._said(self._board)
        listed = self.listed()
        named = next((run for run in listed if run.folder.name == said), None)
        running = next((run for run in listed if run.is_running), None)
        is_elsewhere = named is None and not said.startswith(TRIED)
        self._board.put("elsewhere", said if is_elsewhere else "")
        first = named if is_under_way else running or named
        newest = [*([first] if first else []), *listed]
        return newest[0].folder if newest else None


def _connecting(endpoint: str, rig: str, security: Security) -> Callable[[], RemoteRig]:
    return partial(
        connect,
        endpoint,
        rig,
        timeout_s=LINK_S,
        patience_s=LINK_S,
        holder="live page",
        security=security,
    )


def daemon_view(
    rig: str,
    supervised: Supervised,
    *,
    target: str = "",
    runs: RunFolder | None = None,
    security: Security = OPEN,
) -> View:
    """A rig that a daemon supervises; `target` is empty where its address is unknown."""
    board = Board()
    reader = DaemonReader(board, supervised)
    newest = NewestRun(board, runs, rig, _run_of_daemon)
    readers: list[Reader] = [reader, RunReader(board, newest, predict=False)]
    commands: dict[str, Execute] = {
        verb: lambda who, _given, verb=verb: reader.command(verb, who)  # type: ignore[misc]
        for verb in DAEMON_VERBS
    }
    if is_endpoint(target):
        samples = RigReader(board, _connecting(target, rig, security))
        readers.append(samples)
        commands["estop"] = _stopping(samples)
    return View(
        *(rig, "daemon", board, readers),
        commands=commands,
        tuning=TuningSource(newest),
        summary=lambda: {"rig": rig},
    )


class RemoteSupervision:
    """The supervision of one rig by a daemon at an endpoint."""

    def __init__(self, client: DaemonClient, rig: str) -> None:
        self._client = client
        self._rig = rig

    def status(self) -> DaemonStatus:
        """Current state, with the live gains."""
        return self._client.status(self._rig)

    def history(self, request: Request) -> History:
        """Past gain sets, commands and check trials."""
        return self._client.history(self._rig, request.limit)

    def events(self, request: Request) -> Events:
        """Past events."""
        return Events(self._client.events(self._rig, request.after, request.limit))

    def command(self, verb: DaemonVerb, command: Command) -> CommandAnswer:
        """Gives a command."""
        return self._client.send(self._rig, verb, command)
