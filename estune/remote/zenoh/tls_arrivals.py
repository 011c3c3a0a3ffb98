"""Connections that have proven nothing yet: what they may cost a listener, and in which order.

One that says nothing costs a file and no handshake, and is closed after `SAID_WITHIN_S`. Of those
that have spoken, a few begin their handshake in each turn of the loop, so that the bytes of open
sessions never wait for many handshakes: one of each address in turn, so that a flood from one of
them delays no other; of an address the newest first, as the oldest in an overload are those that
nobody waits for any more, or a flood. If there are too many, the oldest of the address that has
the most gives way: others are accepted always.
"""

import asyncio
import socket
from collections import defaultdict
from collections.abc import Callable

SAID_WITHIN_S = 5.0
"""Time for the first byte of a handshake."""

WAITING_MAX = 8192
"""Connections that wait at most: half the files that a front asks the system for."""

BEGUN_AT_ONCE = 4
"""Handshakes begun in one turn of the loop: about 2 ms of work, 0.5 ms each."""

_SWEEP_S = 0.5

Handshake = asyncio.Task[None]


class Arrivals:
    """The connections of a listener up to the end of their handshakes; for its loop's thread."""

    def __init__(
        self, loop: asyncio.AbstractEventLoop, begin: Callable[[socket.socket], Handshake]
    ) -> None:
        self._loop, self._begin = loop, begin
        self._hosts: dict[str, dict[socket.socket, Handshake | None]] = defaultdict(dict)
        self._host_of: dict[socket.socket, str] = {}
        self._silent: dict[socket.socket, float] = {}  # until when, the oldest first
        # By address, in the order of their turns; of each the newest last.
        self._spoken: dict[str, dict[socket.socket, None]] = {}
        self._sweep()

    def __len__(self) -> int:
        return len(self._host_of)

    def add(self, connection: socket.socket, host: str) -> None:
        """Takes a connection that was accepted."""
        while len(self) >= WAITING_MAX:
            greediest = max(self._hosts, key=lambda host: len(self._hosts[host]))
            self._end(next(iter(self._hosts[greediest])))
        self._hosts[host][connection] = None
        self._host_of[connection] = host
        self._silent[connection] = self._loop.time() + SAID_WITHIN_S
        self._loop.add_reader(connection, self._speaks, connection)

    def close(self) -> list[Handshake]:
        """Ends all; the handshakes that are being cancelled."""
        self._timer.cancel()
        begun = [task for waiting in self._hosts.values() for task in waiting.values() if task]
        for connection in tuple(self._host_of):
            self._end(connection)
        return begun

    def _speaks(self, connection: socket.socket) -> None:
        self._loop.remove_reader(connection)
        del self._silent[connection]
        if not self._spoken:
            self._loop.call_soon(self._begin_some)
        self._spoken.setdefault(self._host_of[connection], {})[connection] = None

    def _begin_some(self) -> None:
        for _ in range(BEGUN_AT_ONCE):
            if not self._spoken:
                return
            host = next(iter(self._spoken))
            spoken = self._spoken.pop(host)
            connection, _ = spoken.popitem()
            if spoken:
                self._spoken[host] = spoken  # behind the others
            task = self._begin(connection)
            self._hosts[host][connection] = task
            task.add_done_callback(lambda _, done=connection: self._forget(done))  # type: ignore[misc]
        if self._spoken:
            self._loop.call_soon(self._begin_some)

    def _sweep(self) -> None:
        now_s = self._loop.time()
        while self._silent and (oldest := next(iter(self._silent.items())))[1] <= now_s:
            self._end(oldest[0])
        self._timer = self._loop.call_later(_SWEEP_S, self._sweep)

    def _end(self, connection: socket.socket) -> None:
        task = self._hosts[self._host_of[connection]][connection]
        if task is not None:
            task.cancel()
        else:
            if self._silent.pop(connection, None) is not None:
                self._loop.remove_reader(connection)
            self._no_longer_spoken(connection)
            connection.close()
        self._forget(connection)

    def _no_longer_spoken(self, connection: socket.socket) -> None:
        host = self._host_of[connection]
        spoken = self._spoken.get(host, {})
        spoken.pop(connection, None)
        if not spoken:
            self._spoken.pop(host, None)

    def _forget(self, connection: socket.socket) -> None:
        host = self._host_of.pop(connection, None)
        if host is not None:
            del self._hosts[host][connection]
            if not self._hosts[host]:
                del self._hosts[host]
