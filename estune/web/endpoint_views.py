"""Views of all rigs and daemons at some endpoints, as they come and go."""

from collections.abc import Callable, Iterable
from datetime import datetime

from estune.errors import EstuneError
from estune.remote.security import OPEN, Security
from estune.remote.zenoh.daemon_service import DaemonClient
from estune.remote.zenoh.discovery import EndpointPresences
from estune.web.board import Board
from estune.web.reader import Reader
from estune.web.run_folder import RunFolder
from estune.web.views import RemoteSupervision, View, daemon_view, rig_view

CONNECT_S = 1.0
"""Time that a listener has to accept a connection, s."""


class EndpointViews(Reader):
    """Looks for rigs and daemons while a page is open; what has gone stays listed, as gone.

    A rig that comes back at another endpoint takes the place of the one that has gone.

    Args:
        runs: Folder of runs, in which those of a rig are looked for.
        rig: The one rig that is shown; all by default.
        named_alone: Whether a view has the rig's name alone; else with its endpoint.
    """

    source = "endpoints"
    every_s = 1.0

    def __init__(
        self,
        endpoints: Callable[[], Iterable[str]],
        security: Security = OPEN,
        *,
        runs: RunFolder | None = None,
        rig: str | None = None,
        named_alone: bool = False,
    ) -> None:
        super().__init__(Board())
        self._endpoints = endpoints
        self._security = security
        self._runs = runs
        self._rig = rig
        self._named_alone = named_alone
        self._presences: dict[str, EndpointPresences] = {}
        self._clients: dict[str, DaemonClient] = {}
        self._views: dict[tuple[str, str], View] = {}
        self._faults: dict[str, View] = {}

    def __call__(self) -> list[View]:
        """The views that there are now; the same objects each time."""
        self.look()
        return [*self._views.copy().values(), *self._faults.copy().values()]

    def read(self) -> None:
        """Looks once which rigs and daemons are there."""
        endpoints, seen = tuple(self._endpoints()), set[str]()
        for endpoint in [one for one in self._presences if one not in endpoints]:
            self._leave(endpoint)
        there: set[tuple[str, str]] = set()
        for endpoint in endpoints:
            try:
                there |= self._at(endpoint, seen)
            except EstuneError as error:
                self._leave(endpoint)
                self._faults.setdefault(endpoint, View(endpoint, "rig", Board(), []))
                self._faults[endpoint].board.put("fault.rig", str(error))
            else:
                self._faults.pop(endpoint, None)
        for endpoint in self._faults.keys() - set(endpoints):
            del self._faults[endpoint]
        self._mark_gone(there)

    def release(self) -> None:
        """Disconnects; the views stay, and are read for as long as a page shows them."""
        for presences in self._presences.values():
            presences.close()
        self._presences.clear()

    def close(self) -> None:
        """Disconnects, and ends the views."""
        super().close()
        for view in self._views.values():
            view.close()
        for client in self._clients.values():
            client.close()

    def _at(self, endpoint: str, seen: set[str]) -> set[tuple[str, str]]:
        """What is at an endpoint, each with its view; `seen` are instances shown elsewhere."""
        presences = self._presences.get(endpoint)
        if presences is None:
            presences = EndpointPresences(endpoint, CONNECT_S, security=self._security)
            self._presences[endpoint] = presences
        rigs, supervised = presences.rigs(), presences.supervised()
        routed = {p.rig for p in rigs if p.instance in seen}  # by a router
        seen.update(p.instance for p in rigs)
        names = ({p.rig for p in rigs} - routed) | set(supervised)
        there = {(endpoint, name) for name in names if self._rig in (None, name)}
        for key in sorted(there):
            kind = "daemon" if key[1] in supervised else "rig"
            old = self._views.get(key)
            if old is None or old.kind != kind:
                target = endpoint if key[1] in {p.rig for p in rigs} else ""
                self._views[key] = self._view(*key, kind, target)
                if old is not None:
                    old.close()
        return there

    def _view(self, endpoint: str, rig: str, kind: str, target: str) -> View:
        if kind == "daemon":
            if endpoint not in self._clients:
                self._clients[endpoint] = DaemonClient(endpoint, security=self._security)
            supervision = RemoteSupervision(self._clients[endpoint], rig)
            view = daemon_view(
                rig, supervision, target=target, runs=self._runs, security=self._security
            )
        else:
            view = rig_view(endpoint, rig, self._security, runs=self._runs)
        if not self._named_alone:
            view.name = f"{rig} at {endpoint}"  # a run may have the name of a rig
        return view

    def _mark_gone(self, there: set[tuple[str, str]]) -> None:
        back = {(self._views[key].kind, key[1]) for key in there}
        for key, view in tuple(self._views.items()):
            if key in there:
                view.gone = ""
            elif (view.kind, key[1]) in back:
                self._views.pop(key).close()
            elif not view.gone:
                view.gone = f"gone since {datetime.now().astimezone():%H:%M:%S}"

    def _leave(self, endpoint: str) -> None:
        presences = self._presences.pop(endpoint, None)
        if presences is not None:
            presences.close()
