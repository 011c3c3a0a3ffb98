"""Views of a server: runs, rigs and supervised rigs, each with a board and its readers."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

from estune.errors import InvalidInput, JournalError
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
from estune.remote.security import OPEN, Security
from estune.remote.zenoh import RemoteRig, connect
from estune.remote.zenoh.daemon_service import DaemonClient, Supervised
from estune.run.journal import FILE_NAME, Journal
from estune.run.targets import is_endpoint
from estune.web.board import Board
from estune.web.daemon_reader import DaemonReader
from estune.web.listed_run import ListedRun
from estune.web.reader import Reader
from estune.web.rig_actions import RigActions
from estune.web.rig_reader import RigReader
from estune.web.run_actions import run_actions
from estune.web.run_reader import RunReader
from estune.web.tuning_source import TuningSource

LINK_S = 2.0
"""Time that a rig has to answer before the page says that there is no link, s."""
RUNS_MAX = 2000
"""Newest runs of a folder that are listed."""

Execute = Callable[[str, Mapping[str, Any]], str]
"""Executes a command for somebody named, with its arguments; returns what is being done."""


class View:
    """One rig or run. It is read while it is looked at.

    Attributes:
        name: Identifies it in addresses.
        kind: What it shows.
        board: Its values.
        commands: What a page may command, by name.
        tuning: What its tuning page shows.
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
    ) -> None:
        self.name = name
        self.summary = summary
        self.gone = ""
        self._actions = actions
        self.tuning = tuning or TuningSource()
        self.kind = kind
        self.board = board
        self.commands = dict(commands or {})
        self._readers = list(readers)

    def look(self) -> None:
        """Has all of it read for a while."""
        for reader in tuple(self._readers):
            reader.look()

    def glance(self) -> None:
        """Has read what the list of views shows; a run is read when it is looked at."""
        if self.kind != "run" and not self.gone:
            for reader in self._readers[:1]:
                reader.look()

    def replace(self, old: Reader | None, new: Reader) -> None:
        """Has a reader in the place of another."""
        if old is None:
            self._readers.append(new)
        else:
            self._readers[self._readers.index(old)] = new
            old.end()

    def close(self) -> None:
        """Ends the readers, and a tuning that was started on the page."""
        if self._actions is not None:
            self._actions.close()
        for reader in tuple(self._readers):
            reader.close()


Views = Callable[[], Sequence[View]]
"""The views that there are now; the same objects each time."""


def run_view(folder: Path, security: Security = OPEN) -> View:
    """A run, with the rig at the endpoint it was made on."""
    board = Board()
    readers: list[Reader] = [RunReader(board, folder)]
    actions = None
    listed = ListedRun(folder)
    row = listed.row()
    target, rig = listed.target, str(row.get("rig", ""))
    if not target:  # opened again, it says why, or has just begun
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
        tuning=TuningSource(folder),
        actions=actions,
        summary=listed.row,
    )


def folder_views(folder: Path, security: Security = OPEN) -> Views:
    """The newest runs of a folder, also those that are begun later."""
    kept: dict[Path, View] = {}

    def views() -> list[View]:
        newest = _newest_runs(folder)
        for path in newest:
            if path not in kept:
                with suppress(JournalError):  # half-copied, or just being begun: tried again
                    kept[path] = run_view(path, security)
        for path in kept.keys() - set(newest):  # deleted meanwhile
            kept.pop(path).close()
        return [kept.get(path) or _unreadable(path) for path in newest]

    return views


def _newest_runs(folder: Path) -> list[Path]:
    """At most `RUNS_MAX` runs of a folder, the one written last first."""
    written: dict[str, float] = {}
    with suppress(FileNotFoundError), os.scandir(folder) as entries:
        for entry in entries:
            with suppress(OSError):
                written[entry.path] = Path(entry.path, FILE_NAME).stat().st_ctime
    newest = sorted(written, key=lambda path: written[path], reverse=True)
    return [Path(path) for path in newest[:RUNS_MAX]]


def _unreadable(folder: Path) -> View:
    """A run whose journal cannot be read; the page says why."""
    board = Board()
    summary = ListedRun(folder).row
    return View(folder.name, "run", board, [RunReader(board, folder)], summary=summary)


def _is_running(board: Board) -> bool:
    """Whether the run on a board is under way."""
    state = board.get("state")
    return state is not None and state["status"] == "running"


def rig_view(
    endpoint: str, rig: str, security: Security = OPEN, *, runs: Path | None = None
) -> View:
    """A rig at an endpoint, with the run whose trials it does where that is in a folder here.

    Args:
        endpoint: Endpoint of the rig.
        rig: Its name.
        security: Credentials for it.
        runs: Folder of runs; None where there is none.
    """
    board = Board()
    follow = _Follower(runs, rig)
    reader = RigReader(board, _connecting(endpoint, rig, security), on_run=follow)
    commands: dict[str, Execute] = {"estop": _stopping(reader)}
    actions = None
    if runs is not None:
        actions = _actions(board, endpoint, rig, security, runs)
        commands |= actions.commands()
    follow.view = View(
        *(rig, "rig", board, [reader]),
        commands=commands,
        actions=actions,
        summary=lambda: {"rig": rig},
    )
    return follow.view


def _stopping(reader: RigReader) -> Execute:
    return lambda who, _given: reader.estop(who)


def _actions(board: Board, endpoint: str, rig: str, security: Security, runs: Path) -> RigActions:
    """Actions on a rig by whoever has the page's key."""

    def connect_for(who: str) -> RemoteRig:
        return connect(endpoint, rig, LINK_S, holder=who, security=security)

    return RigActions(connect_for, board, endpoint, rig, runs, may_tune=security is OPEN)


class _Follower:
    """Shows the run under way on the page of its rig.

    Attributes:
        view: The page's view; set once it is made.
    """

    view: View

    def __init__(self, runs: Path | None, rig: str) -> None:
        self._runs = runs
        self._rig = rig
        self._shown: tuple[str, Reader | None] = "", None

    def __call__(self, run: str) -> None:
        """Shows this run from now on; one that is not in the folder is named only."""
        name, reader = self._shown
        if not run or run == name:
            return
        folder = None if self._runs is None else self._runs / run
        if folder is None or not (folder / FILE_NAME).is_file() or not self._is_of_rig(folder):
            self.view.board.put("elsewhere", run)
            return
        following = RunReader(self.view.board, folder)
        self.view.tuning.folder = folder
        self.view.replace(reader, following)
        self._shown = run, following
        self.view.board.put("elsewhere", "")

    def _is_of_rig(self, folder: Path) -> bool:
        try:
            with Journal.open(folder) as journal:
                return bool(journal.fact("rig")["name"] == self._rig)
        except JournalError:  # just being begun: tried again with its next trial
            return False


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
    runs: Path | None = None,
    security: Security = OPEN,
) -> View:
    """A rig that a daemon supervises.

    Args:
        rig: The rig.
        supervised: Its supervision.
        target: Endpoint of the rig, for live samples and the emergency stop; empty if unknown.
        runs: Folder of its tuning runs; None if it cannot be reached from here.
        security: Credentials for the rig.
    """
    board = Board()
    shown: dict[str, Reader] = {}

    def follow(run: str) -> None:
        if runs is None or not (runs / run / FILE_NAME).is_file() or run in shown:
            return
        old = next(iter(shown.values()), None)
        shown.clear()
        shown[run] = RunReader(board, runs / run, predict=False)
        view.replace(old, shown[run])
        view.tuning.folder = runs / run

    reader = DaemonReader(board, supervised, follow)
    readers: list[Reader] = [reader]
    commands: dict[str, Execute] = {
        verb: lambda who, _given, verb=verb: reader.command(verb, who)  # type: ignore[misc]
        for verb in DAEMON_VERBS
    }
    if is_endpoint(target):
        samples = RigReader(board, _connecting(target, rig, security))
        readers.append(samples)
        commands["estop"] = _stopping(samples)
    view = View(rig, "daemon", board, readers, commands=commands, summary=lambda: {"rig": rig})
    return view


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
        try:
            sentence = self._client.command(self._rig, verb, command.who, command.why)
        except InvalidInput as error:
            return CommandAnswer(done=False, sentence=str(error))
        return CommandAnswer(done=True, sentence=sentence)
