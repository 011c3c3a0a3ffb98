"""Reports of a daemon: its events in the log, the user's hooks, and systemd."""

import json
import logging
import os
import queue
import signal
import socket
import subprocess
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from estune.daemon.config import HookTable
from estune.daemon.events import EventKind
from estune.remote.messages.daemon import DaemonEvent

QUEUE_MAX = 100
"""Greatest number of events that wait for a hook; further ones are dropped, and that is logged."""

_ERROR_OUTPUT_MAX = 500
_log = logging.getLogger("estune.daemon")


def log_event(event: DaemonEvent) -> None:
    """Logs an event at the level of its kind; the rig and the facts stand beside the sentence."""
    _log.log(
        EventKind(event.kind).level,
        "%s",
        event.sentence,
        extra={"rig": event.rig, "event": event.kind, "facts": event.facts or None},
    )


class Hooks:
    """Runs the user's commands at events, in a thread of its own: the supervision never waits.

    A command gets the event as JSON on its standard input; no shell is involved.

    Attributes:
        failures: Commands so far that failed, were killed or could not be run, and events dropped.
    """

    def __init__(self, hooks: Sequence[HookTable]) -> None:
        self._hooks = tuple(hooks)
        self.failures = 0
        self._waiting: queue.Queue[tuple[HookTable, DaemonEvent] | None] = queue.Queue(QUEUE_MAX)
        self._thread = threading.Thread(target=self._run, name="hooks", daemon=True)
        self._thread.start()

    def submit(self, event: DaemonEvent) -> None:
        """Queues the commands for such an event; returns at once."""
        for hook in self._hooks:
            if not hook.events or event.kind in hook.events:
                try:
                    self._waiting.put_nowait((hook, event))
                except queue.Full:
                    self.failures += 1
                    _log.warning(
                        "hook %s is too slow: event %s was dropped", hook.command[0], event.kind
                    )

    def close(self, within_s: float) -> None:
        """Lets the queued commands finish within a time."""
        try:
            self._waiting.put(None, timeout=within_s)
        except queue.Full:
            _log.warning("the hooks did not finish")
        self._thread.join(within_s)

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            try:
                self.failures += not _has_run(*item)
            except Exception:  # noqa: BLE001  the next event must not suffer
                self.failures += 1
                _log.exception("hook failed")


def _has_run(hook: HookTable, event: DaemonEvent) -> bool:
    """Runs a command at an event; whether it ended as it should."""
    name, data = hook.command[0], json.dumps(asdict(event)).encode()
    try:
        process = subprocess.Popen(  # noqa: S603  the user's own command, from the user's own file
            hook.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,  # so that what it has started can be killed with it
        )
    except OSError as error:
        _log.warning("hook %s cannot be run: %s", name, error.strerror or error)
        return False
    with process:
        try:
            _, errors = process.communicate(data, timeout=hook.timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            _log.warning("hook %s was killed after %g s, at %s", name, hook.timeout_s, event.kind)
            return False
    if code := process.returncode:
        output = errors.decode(errors="replace").strip()[-_ERROR_OUTPUT_MAX:]
        _log.warning("hook %s ended with code %d at %s: %s", name, code, event.kind, output)
    return code == 0


class Notifier:
    """Reports to systemd by datagrams (sd_notify(3)); without systemd it does nothing.

    Attributes:
        watchdog_s: Time within which systemd wants a sign of life; None if it wants none.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # in the abstract name space
            self._address = "\0" + self._address[1:]
        wanted_us = environment.get("WATCHDOG_USEC", "")
        is_ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        is_wanted = is_ours and wanted_us.isdigit() and int(wanted_us) > 0
        self.watchdog_s = int(wanted_us) / 1e6 if is_wanted else None

    def notify(self, **facts: object) -> None:
        """Sends facts, such as `READY=1`; a line break in one would begin another."""
        if not self._address:
            return
        lines = (f"{name}={' '.join(str(value).split())}" for name, value in facts.items())
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            _log.warning("systemd not notified: %s", error)
