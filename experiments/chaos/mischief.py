"""Disturbance of messages: delivered twice, late, and in another order."""

import sys
import threading
from collections import deque
from collections.abc import Callable
from random import Random
from typing import NamedTuple

import zenoh

from estune.remote.zenoh.zenoh_session import close_session, open_session
from experiments.chaos.processes import read_command

REMEMBERED = 40
LATE_S = 0.05, 2.5
_TIMEOUT_S = 1.0


class CommandInTransit(NamedTuple):
    """A command in transit."""

    key: str
    payload: bytes


class Mischief:
    """Disturbs the commands of one client, as ordered by words on standard input.

    `double`: the next submit is delivered twice at once. `late`: it is held back, so that its
    sender has no reply, and delivered some time later. `again`: some of the last commands are
    delivered once more, in any order.
    """

    def __init__(self, endpoint: str, seed: int) -> None:
        self._endpoint = endpoint
        self._random = Random(seed)  # noqa: S311  for faults, not for secrets
        self._session: zenoh.Session | None = None
        self._opening = threading.Lock()
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []
        self._past: deque[CommandInTransit] = deque(maxlen=REMEMBERED)
        self._orders: deque[str] = deque()
        threading.Thread(target=self._listen, daemon=True).start()

    def is_held_back(self, message: CommandInTransit) -> bool:
        """Whether a command is held back."""
        self._past.append(message)
        if not message.key.endswith("/submit") or not self._orders:
            return False
        late = self._orders.popleft() == "late"
        self._deliver(message, self._random.uniform(*LATE_S) if late else 0.0)
        return late

    def close(self) -> None:
        """Ends all deliveries.

        Leaves no thread inside Zenoh: the end of the interpreter under it would be an abort.
        """
        self._closed.set()
        for thread in self._threads:
            thread.join()
        if self._session is not None:
            close_session(self._session)

    def _listen(self) -> None:
        while True:
            for order in read_command().split():
                if order == "again":
                    past = list(self._past)
                    for message in self._random.sample(past, min(len(past), 5)):
                        self._deliver(message, self._random.uniform(0.0, 0.5))
                else:
                    self._orders.append(order)

    def _deliver(self, message: CommandInTransit, after_s: float) -> None:
        def deliver() -> None:
            if self._closed.wait(after_s):
                return
            try:
                with self._opening:
                    if self._session is None:
                        self._session = open_session(
                            "client", connect=(self._endpoint,), message_max_bytes=2**24
                        )
                list(self._session.get(message.key, payload=message.payload, timeout=_TIMEOUT_S))
            except zenoh.ZError as error:
                print(f"mischief failed: {error}", file=sys.stderr)

        thread = threading.Thread(target=deliver, daemon=True)
        self._threads.append(thread)
        thread.start()


def disturbed(ask: Callable[..., bytes | None], mischief: Mischief) -> Callable[..., bytes | None]:
    """`RigConnection.ask` with the mischief between it and the network."""

    def disturbed_ask(self: object, key: str, payload: bytes, **options: object) -> bytes | None:
        if "/@cmd/" in key and mischief.is_held_back(CommandInTransit(key, payload)):
            return None
        return ask(self, key, payload, **options)

    return disturbed_ask
