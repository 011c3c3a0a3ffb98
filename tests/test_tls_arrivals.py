"""Connections that have proven nothing: order of their handshakes, and who gives way."""

import asyncio
import socket

import pytest

from estune.remote.zenoh import tls_arrivals
from estune.remote.zenoh.tls_arrivals import BEGUN_AT_ONCE, Arrivals


class Door:
    """Arrivals whose handshakes never end, and the client's end of each connection."""

    def __init__(self) -> None:
        self.begun: list[socket.socket] = []
        self.arrivals = Arrivals(asyncio.get_running_loop(), self._begin)
        self.ours: list[socket.socket] = []

    def _begin(self, connection):
        self.begun.append(connection)

        task = asyncio.get_running_loop().create_task(asyncio.Event().wait())
        task.add_done_callback(lambda _: connection.close())  # also if it never ran
        return task

    def arrive(self, host="10.0.0.1") -> tuple[socket.socket, socket.socket]:
        theirs, ours = socket.socketpair()
        theirs.settimeout(0.0)
        self.arrivals.add(theirs, host)
        self.ours.append(ours)
        return theirs, ours

    async def end(self) -> None:
        await asyncio.gather(*self.arrivals.close(), return_exceptions=True)
        for ours in self.ours:
            ours.close()


def through_a_door(scene):
    async def run():
        door = Door()
        try:
            await scene(door)
        finally:
            await door.end()

    asyncio.run(run())


async def turns(count: int) -> None:
    for _ in range(count):
        await asyncio.sleep(0.0)


def test_few_handshakes_begin_in_a_turn_and_the_newest_first():
    async def scene(door):
        came = [door.arrive() for _ in range(3 * BEGUN_AT_ONCE)]
        for _, ours in came:
            ours.send(b"\x16")
        begun = []
        while len(door.begun) < len(came):
            before = len(door.begun)
            await turns(1)
            assert len(door.begun) - before <= BEGUN_AT_ONCE
        begun = [[theirs for theirs, _ in came].index(connection) for connection in door.begun]
        assert begun == list(range(len(came)))[::-1]

    through_a_door(scene)


def test_one_handshake_of_each_address_begins_in_turn():
    async def scene(door):
        flood = [door.arrive("10.0.0.1") for _ in range(30)]
        late = [door.arrive("10.0.0.2") for _ in range(3)]
        for _, ours in [*late, *flood]:  # the flood is the newest
            ours.send(b"\x16")
        while len(door.begun) < 8:
            await turns(1)
        assert {theirs for theirs, _ in late} <= set(door.begun[:8])

    through_a_door(scene)


def test_silent_connection_costs_no_handshake_and_is_closed(monkeypatch):
    monkeypatch.setattr(tls_arrivals, "SAID_WITHIN_S", 0.05)
    monkeypatch.setattr(tls_arrivals, "_SWEEP_S", 0.01)

    async def scene(door):
        theirs, ours = door.arrive()
        while theirs.fileno() >= 0:
            await asyncio.sleep(0.01)
        assert ours.recv(1) == b""
        assert (door.begun, len(door.arrivals)) == ([], 0)

    through_a_door(scene)


@pytest.mark.parametrize("speaks", [False, True])
def test_oldest_of_the_address_with_the_most_gives_way(speaks, monkeypatch):
    monkeypatch.setattr(tls_arrivals, "WAITING_MAX", 10)

    async def scene(door):
        other, _ = door.arrive("10.0.0.2")
        flood = [door.arrive() for _ in range(9)]
        if speaks:
            for _, ours in flood:
                ours.send(b"\x16")
            while len(door.begun) < len(flood):
                await turns(1)
        newcomers = [door.arrive(f"10.0.1.{n}")[0] for n in range(5)]
        await turns(3)
        assert len(door.arrivals) == 10
        assert all(connection.fileno() >= 0 for connection in (other, *newcomers))
        assert [theirs.fileno() < 0 for theirs, _ in flood] == [True] * 5 + [False] * 4

    through_a_door(scene)
