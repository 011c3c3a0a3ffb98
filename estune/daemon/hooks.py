"""Runs the user's commands at events, in a thread of its own: control never waits for them."""

import json
import logging
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Sequence
from dataclasses import asdict

from estune.daemon.config import HookTable
from estune.daemon.events import Event

WAITING_MAX = 100
"""Events that wait for a hook; more are let go of, and that is said."""

_SAID_MAX = 500
_log = logging.getLogger(__name__)


class Hooks:
    """The user's commands. Each event is JSON on their standard input; no shell is involved."""

    def __init__(self, hooks: Sequence[HookTable]) -> None:
        self._hooks = tuple(hooks)
        self._waiting: queue.Queue[tuple[HookTable, Event] | None] = queue.Queue(WAITING_MAX)
        self._thread = threading.Thread(target=self._run, name="hooks", daemon=True)
        self._thread.start()

    def tell(self, event: Event) -> None:
        """Has the commands that ask for such events run; returns at once."""
        for hook in self._hooks:
            if not hook.events or event.kind in hook.events:
                try:
                    self._waiting.put_nowait((hook, event))
                except queue.Full:
                    _log.warning(
                        "hook %s is too slow: event %s was not told", hook.command[0], event.kind
                    )

    def close(self, within_s: float) -> None:
        """Lets the hooks that wait finish, for so long."""
        try:
            self._waiting.put(None, timeout=within_s)
        except queue.Full:
            _log.warning("the hooks did not come to an end")
        self._thread.join(within_s)

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            try:
                _call(*item)
            except Exception:  # noqa: BLE001  the next event must not suffer
                _log.exception("hook failed")


def _call(hook: HookTable, event: Event) -> None:
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
        return
    with process:
        try:
            _, errors = process.communicate(data, timeout=hook.timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            _log.warning("hook %s was killed after %g s, at %s", name, hook.timeout_s, event.kind)
            return
    if process.returncode:
        said = errors.decode(errors="replace").strip()[-_SAID_MAX:]
        _log.warning(
            "hook %s ended with code %d at %s: %s", name, process.returncode, event.kind, said
        )
