"""The daemon's process: one supervisor per rig, its server, metrics and notifications."""

import logging
import os
import secrets
import socket
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from estune.daemon.admission import Admission
from estune.daemon.config import DaemonConfig, ServiceTable
from estune.daemon.metrics import (
    DaemonHealth,
    MetricsServer,
    RigFigures,
    daemon_registry,
    write_metrics,
)
from estune.daemon.notifications import Hooks, Notifier, log_event
from estune.daemon.rig_access import HOLDER_PREFIX
from estune.daemon.store import RUNS, DaemonStore
from estune.daemon.supervised_connection import SharedResources
from estune.daemon.supervised_rig import SupervisedRig
from estune.daemon.supervisor import RigSupervisor
from estune.errors import EstuneError, RigError
from estune.remote.messages.daemon import DaemonEvent, DaemonStatus
from estune.remote.security import OPEN, Security, read_security
from estune.remote.zenoh.daemon_service import DaemonServer
from estune.remote.zenoh.listening_session import ListeningSession
from estune.remote.zenoh.network import Network
from estune.support.open_files import allow_open_files

if TYPE_CHECKING:
    from estune.web.server import PageServer

_POLL_S = 0.25
_HOOKS_END_WITHIN_S = 5.0
_LAST_ANSWERS_S = 0.5
"""Time in which the client that stopped the last rig learns its gains; it asks every 0.1 s."""

_log = logging.getLogger(__name__)


class DaemonService:
    """A daemon. `run` returns when every supervisor has ended."""

    def __init__(
        self,
        config: DaemonConfig,
        notifier: Notifier | None = None,
        *,
        security: Security = OPEN,
    ) -> None:
        """Opens the stores and listens; no rig is contacted before `run`.

        Raises:
            InvalidInput: a security file is wrong.
            JournalError: a store cannot be used.
            RigError: another daemon has a store, or an endpoint or port is taken.
        """
        self._config = config
        self._notifier = notifier or Notifier()
        self._stopping = threading.Event()
        self._serving = False
        self._published: dict[str, DaemonStatus] = {}
        self._written_at_s = self._watched_at_s = -float("inf")
        allow_open_files(2**20)  # a rig takes up to ten
        with ExitStack() as opened:
            stores = {}
            for rig in config.rig:
                stores[rig.name] = DaemonStore.open(config.state / rig.name, rig.name)
                opened.callback(stores[rig.name].close)
            self._hooks = Hooks(config.hook)
            opened.callback(self._hooks.close, _HOOKS_END_WITHIN_S)
            instance = secrets.token_hex(4)
            self._server = _listen(config.service, instance)
            opened.callback(self._server.close)
            self.endpoint = self._server.endpoint
            self._supervised = {
                rig.name: SupervisedRig(stores[rig.name], rig, instance, self._publish)
                for rig in config.rig
            }
            network = Network(security)
            self._admission = Admission(network.renewal, len(config.rig), config.rigs_max)
            shared = SharedResources(
                f"{HOLDER_PREFIX} {instance} on {socket.gethostname()}, process {os.getpid()}",
                *(instance, network, self._admission),
                *(self._server if config.shared else None, config.stop_within_s),
            )
            self._supervisors = tuple(
                RigSupervisor(rig, self._supervised[rig.name], shared) for rig in config.rig
            )
            self._metrics = daemon_registry(self._figures, self.health)
            if config.metrics.http_port is not None:
                faults = {
                    "/health": lambda: self.health().fault,
                    "/ready": lambda: self.health().obstacle,
                }
                metrics = MetricsServer(config.metrics.http_port, self._metrics, faults)
                self.metrics_port = metrics.port
                opened.callback(metrics.close)
            self.page_address = ""
            if config.page.http_port is not None:
                page = self._serve_page(security)
                self.page_address = page.address
                opened.callback(page.close)
            self._opened = opened.pop_all()

    def _serve_page(self, security: Security) -> "PageServer":
        from estune.web.run_folder import RunFolder  # noqa: PLC0415  slow to import
        from estune.web.server import PageServer  # noqa: PLC0415  as above
        from estune.web.views import daemon_view  # noqa: PLC0415  as above

        views = [
            daemon_view(
                rig.name,
                self._supervised[rig.name],
                target=rig.target,
                runs=RunFolder(self._config.state / rig.name / RUNS),
                security=security,
            )
            for rig in self._config.rig
        ]
        page = self._config.page
        return PageServer(lambda: views, port=page.http_port or 0, right=page.right)

    def statuses(self) -> list[DaemonStatus]:
        """Status of each rig."""
        return [rig.status() for rig in self._supervised.values()]

    def _figures(self) -> list[RigFigures]:
        return [RigFigures(rig.status(), rig.counts) for rig in self._supervised.values()]

    def health(self) -> DaemonHealth:
        """State of the daemon itself."""
        stuck = tuple(supervisor.name for supervisor in self._supervisors if supervisor.is_stuck)
        return DaemonHealth(stuck, self._serving and not stuck, self._hooks.failures)

    def stop(self) -> None:
        """Has every rig's nominal gains restored, and `run` return. Any thread may call."""
        self._stopping.set()

    def run(self) -> None:
        """Supervises the rigs until all have ended, each by a verb or all by `stop`.

        Raises:
            RigError: a rig was left alone as another daemon has it, or its gains could not be
                confirmed at the end.
        """
        with self._opened:
            self._server.serve(self._supervised, announced=not self._config.shared)
            for supervisor in self._supervisors:
                supervisor.start()
            self._serving = True
            self._notifier.notify(READY=1, STATUS=_summary(self.statuses()))
            is_stopping = False
            while not all(supervisor.join(0.0) for supervisor in self._supervisors):
                self._report()
                if is_stopping:
                    time.sleep(_POLL_S)
                elif self._stopping.wait(_POLL_S):
                    is_stopping = True
                    self._notifier.notify(STOPPING=1)
                    for rig in self._supervised.values():
                        rig.stop("the daemon is being stopped")
            self._report()
            if not is_stopping:
                time.sleep(_LAST_ANSWERS_S)
        self._check_ends()

    def _report(self) -> None:
        """Adjusts the load, publishes changed states, writes metrics, feeds the watchdog."""
        self._admission.adjust()
        statuses = self.statuses()
        changed = [s for s in statuses if _lasting(s) != self._published.get(s.rig)]
        for status in changed:
            self._published[status.rig] = _lasting(status)
            self._server.show(status)
        if changed:
            self._notifier.notify(STATUS=_summary(statuses))
        now_s = time.monotonic()
        metrics = self._config.metrics
        if metrics.file is not None and now_s - self._written_at_s >= metrics.every_s:
            self._written_at_s = now_s
            try:
                write_metrics(metrics.file, self._metrics)
            except OSError as error:
                _log.warning("metrics %s not written: %s", metrics.file, error.strerror)
        self._feed_watchdog(now_s)

    def _feed_watchdog(self, now_s: float) -> None:
        """Feeds the watchdog, unless a supervisor makes no progress."""
        stuck = self.health().stuck
        every_s = self._notifier.watchdog_s
        if stuck:
            _log.error("no progress with rig %s; the watchdog is not fed", ", ".join(stuck))
        elif every_s is not None and now_s - self._watched_at_s >= 0.3 * every_s:
            self._watched_at_s = now_s
            self._notifier.notify(WATCHDOG=1)

    def _check_ends(self) -> None:
        faults = []
        for supervisor in self._supervisors:
            rig = self._supervised[supervisor.name]
            fault = rig.refused or ("" if supervisor.confirmed else rig.state.trouble)
            if fault:
                faults.append(f"rig {supervisor.name}: {fault}")
        if faults:
            raise RigError("; ".join(faults))

    def _publish(self, event: DaemonEvent) -> None:
        log_event(event)
        self._hooks.submit(event)
        try:
            self._server.show(event)
        except EstuneError as error:
            _log.debug("event not published: %s", error)


def _lasting(status: DaemonStatus) -> DaemonStatus:
    """A status without the time to the next check, which changes by itself."""
    return status if status.next_check_s is None else replace(status, next_check_s=None)


def _summary(statuses: list[DaemonStatus]) -> str:
    return "; ".join(f"{s.rig}: {s.mode}, {s.live or 'unknown'} gains live" for s in statuses)


def _listen(service: ServiceTable, instance: str) -> DaemonServer:
    session = ListeningSession(
        service.listen,
        instance=instance,
        routers=service.routers,
        allow_remote=service.allow_remote,
        security=read_security(service.security) if service.security else OPEN,
    )
    return DaemonServer(session)
