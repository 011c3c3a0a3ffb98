"""The daemon's process: a keeper for each rig, and all who are told of what they do."""

import logging
import secrets
import threading
import time
from contextlib import ExitStack
from dataclasses import replace

from estune.daemon.check_trials import CheckTrials
from estune.daemon.config import DaemonConfig
from estune.daemon.events import Event
from estune.daemon.hooks import Hooks
from estune.daemon.logs import log_event
from estune.daemon.metrics import MetricsServer, write_metrics
from estune.daemon.store import DaemonStore
from estune.daemon.supervised_rig import SupervisedRig
from estune.daemon.supervisor import RigSupervisor
from estune.daemon.systemd import Notifier
from estune.daemon.tuning_runs import TuningRuns
from estune.errors import EstuneError, RigError
from estune.remote.messages.daemon import DaemonStatus, EventMessage
from estune.remote.security import OPEN, Security, read_security
from estune.remote.zenoh.daemon_service import DaemonServer

TURN_S = 0.25
"""How often the process looks after its keepers."""
END_WITHIN_S = 5.0
"""How much longer than a rig may take to be made safe the process waits for its keeper."""

_log = logging.getLogger(__name__)


class DaemonService:
    """A daemon. `run` returns when every keeper has ended."""

    def __init__(
        self,
        config: DaemonConfig,
        notifier: Notifier | None = None,
        *,
        security: Security = OPEN,
    ) -> None:
        """Opens the stores and listens; nothing is done with a rig before `run`.

        Args:
            config: What to do.
            notifier: Who is told of it; systemd, where there is one, by default.
            security: Who this is, where a rig asks.

        Raises:
            InvalidInput: a security file is wrong.
            JournalError: another daemon has a store, or it cannot be used.
            RigError: an endpoint or port is taken.
        """
        self._config = config
        self._notifier = notifier or Notifier()
        self._instance = secrets.token_hex(4)
        self._stopping = threading.Event()
        self._shown: dict[str, DaemonStatus] = {}
        self._written_at_s = -float("inf")
        self._watched_at_s = -float("inf")
        with ExitStack() as opened:
            stores = {}
            for rig in config.rig:
                stores[rig.name] = DaemonStore.open(config.state / rig.name, rig.name)
                opened.callback(stores[rig.name].close)
            self._hooks = Hooks(config.hook)
            opened.callback(self._hooks.close, END_WITHIN_S)
            self._server = DaemonServer(
                config.service.listen,
                instance=self._instance,
                routers=config.service.routers,
                allow_remote=config.service.allow_remote,
                security=read_security(asks) if (asks := config.service.security) else OPEN,
            )
            opened.callback(self._server.close)
            self.endpoint = self._server.endpoint
            self._supervised = {
                rig.name: SupervisedRig(
                    stores[rig.name],
                    TuningRuns(stores[rig.name], rig),
                    CheckTrials(stores[rig.name], rig),
                    self._instance,
                    self._tell,
                )
                for rig in config.rig
            }
            self._keepers = tuple(
                RigSupervisor(
                    *(rig, self._supervised[rig.name]),
                    stop_within_s=config.stop_within_s,
                    security=security,
                )
                for rig in config.rig
            )
            if config.metrics.http_port is not None:
                metrics = MetricsServer(config.metrics.http_port, self.statuses)
                self.metrics_port = metrics.port
                opened.callback(metrics.close)
            self._opened = opened.pop_all()

    def statuses(self) -> list[DaemonStatus]:
        """Where each rig stands."""
        return [supervision.status() for supervision in self._supervised.values()]

    def stop(self) -> None:
        """Has every rig put back to its home gains, and `run` return. Any thread may call."""
        self._stopping.set()

    def run(self) -> None:
        """Supervises the rigs until all have ended: told to by a verb, or all at once by `stop`.

        Raises:
            RigError: a rig was left alone as another daemon has it, or its gains could not be
                confirmed at the end.
        """
        with self._opened:
            self._server.serve(self._supervised)
            for keeper in self._keepers:
                keeper.start()
            self._notifier.tell(READY=1, STATUS=self._summary())
            told = False
            while not all(keeper.join(0.0) for keeper in self._keepers):
                self._look_after()
                if self._stopping.wait(TURN_S if not told else 0.0) and not told:
                    told = True
                    self._notifier.tell(STOPPING=1)
                    for supervision in self._supervised.values():
                        supervision.stop("the daemon is being stopped")
                elif told:
                    time.sleep(TURN_S)
            self._look_after()
        self._check_ends()

    def _look_after(self) -> None:
        """Shows what has changed, writes the metrics, and tells systemd that all goes on."""
        statuses = self.statuses()
        changed = [s for s in statuses if _lasting(s) != self._shown.get(s.rig)]
        for status in changed:
            self._shown[status.rig] = _lasting(status)
            self._server.show(status)
        if changed:
            self._notifier.tell(STATUS=self._summary())
        now_s = time.monotonic()
        metrics = self._config.metrics
        if metrics.file is not None and now_s - self._written_at_s >= metrics.every_s:
            self._written_at_s = now_s
            try:
                write_metrics(metrics.file, statuses)
            except OSError as error:
                _log.warning("metrics %s not written: %s", metrics.file, error.strerror)
        self._feed_watchdog(now_s)

    def _feed_watchdog(self, now_s: float) -> None:
        """A sign of life, so long as every keeper makes progress."""
        stuck = [keeper.name for keeper in self._keepers if keeper.is_stuck]
        every_s = self._notifier.watchdog_s
        if stuck:
            _log.error("the keeper of rig %s is stuck; no sign of life is given", ", ".join(stuck))
        elif every_s is not None and now_s - self._watched_at_s >= 0.3 * every_s:
            self._watched_at_s = now_s
            self._notifier.tell(WATCHDOG=1)

    def _summary(self) -> str:
        return "; ".join(
            f"{s.rig}: {s.mode}, {s.live or 'unknown'} gains live" for s in self.statuses()
        )

    def _check_ends(self) -> None:
        faults = []
        for keeper in self._keepers:
            supervision = self._supervised[keeper.name]
            if said := supervision.refused or (
                "" if keeper.confirmed else supervision.life.trouble
            ):
                faults.append(f"rig {keeper.name}: {said}")
        if faults:
            raise RigError("; ".join(faults))

    def _tell(self, event: Event) -> None:
        log_event(event)
        self._hooks.tell(event)
        kind = event.kind.value
        message = EventMessage(
            event.rig, event.number, event.at, kind, event.sentence, event.facts
        )
        try:
            self._server.show(message)
        except EstuneError as error:
            _log.debug("event not shown: %s", error)


def _lasting(status: DaemonStatus) -> DaemonStatus:
    """The status without what changes by itself."""
    return replace(status, next_check_s=None)
