"""A daemon's supervision of one rig on the board: status, events, check trials, commands."""

import dataclasses
import secrets
from collections.abc import Mapping
from typing import Any

from estune.core.gains import Gains
from estune.errors import InvalidInput
from estune.remote.messages.daemon import Command, DaemonStatus, DaemonVerb, Request
from estune.remote.zenoh.daemon_service import Supervised
from estune.web.board import Board
from estune.web.reader import Reader

EVENTS_MAX = 100
CHECKS_MAX = 500
"""Check trials in the control chart."""


class DaemonReader(Reader):
    """Reads the supervision of a rig four times a second."""

    source = "daemon"
    every_s = 0.25

    def __init__(self, board: Board, supervised: Supervised) -> None:
        super().__init__(board)
        self._supervised = supervised
        self._last_event = -1
        self._checks = -1

    def read(self) -> None:
        """Reads the status, and events and check trials where there are new ones."""
        status = self._supervised.status()
        self.board.put("daemon", _shown(status))
        limit = EVENTS_MAX
        events = self._supervised.events(Request(self._last_event, limit)).events
        if events:
            rows = [(e.number, e.at, e.kind, e.sentence) for e in events]
            self.board.extend("events", rows, restart=self._last_event < 0)
            self._last_event = events[-1].number
        if status.checks != self._checks:
            self._checks = status.checks
            checks = self._supervised.history(Request(limit=CHECKS_MAX)).checks
            names = ("number", "told_at", "cost", "sign", "alarm_low", "alarm_high")
            shown = [[check.get(name) for name in names] for check in checks]
            self.board.extend("checks", shown, restart=True)

    def command(self, verb: DaemonVerb, who: str) -> str:
        """Gives a command; returns what is being done.

        Raises:
            InvalidInput: it is refused.
        """
        answer = self._supervised.command(verb, Command(secrets.token_hex(8), who, "by the page"))
        if not answer.done:
            raise InvalidInput(answer.sentence)
        return answer.sentence


def _shown(status: DaemonStatus) -> dict[str, Any]:
    # Without the time to the next check, which changes by itself.
    shown = dataclasses.asdict(dataclasses.replace(status, next_check_s=None))
    gains: dict[str, Gains] = status.gains
    return shown | {"gains": {name: list(one.as_tuple()) for name, one in gains.items()}}


def daemon_row(shown: Mapping[str, Any]) -> dict[str, Any]:
    """What the list of views shows of a supervision on its board: state, trials, cost, Ms."""
    Ms, *ends = shown["sensitivity"] or (None, None, None)
    return {
        "state": f"{shown['mode']}, {shown['live'] or 'unknown'} gains live",
        "trials": shown["trials"],
        "start_cost": shown["baseline_cost"],
        "cost": shown["cost"],
        "Ms": Ms,
        "Ms_interval": ends,
    }
