"""The emulated hardware as a process: `python -m plants.emulator ADDRESS [SETTINGS]`.

ADDRESS is the path of the socket it makes; SETTINGS is JSON with `reel`, settings of the reference
reel, `effects` of it, each with its name and parameters, `electronics` and `far_end` (see
`plants.emulator.board`), `seed`, and `waits_s` (see `plants.emulator.clock`); with `device`,
`serial` or `can`, it is behind the protocol of a real device, which never waits (see
`plants.emulator.devices`). It prints the address at which a driver reaches
it, and ends when its standard input is closed.
"""

import contextlib
import gc
import json
import os
import select
import socket
import sys
import time
from pathlib import Path

from estune.errors import EstuneError
from plants.emulator import wire
from plants.emulator.board import EmulatedBoard
from plants.emulator.clock import MachineClock
from plants.emulator.devices import DEVICES, Device
from plants.emulator.settings import make_board, make_clock

_PRIORITY = 60
_IDLE_ms = 5
"""Longest time between two updates of the reel's state without a request."""


def serve(
    board: EmulatedBoard,
    listener: socket.socket,
    clock: MachineClock,
    device: Device | None = None,
) -> None:
    """Answers until standard input is closed."""
    poll = select.poll()
    poll.register(listener, select.POLLIN)
    poll.register(sys.stdin, select.POLLIN)
    clients: dict[int, socket.socket] = {}
    of_device: set[int] = set()
    while True:
        of_device = _registered(poll, of_device, set(device.readable) if device else set())
        events = poll.poll(_IDLE_ms)
        board.advance(clock.now_s())
        for file, _ in events:
            if device and file in of_device:
                device.take(file, time.monotonic())
            elif file == listener.fileno():
                client, _ = listener.accept()
                clients[client.fileno()] = client
                poll.register(client, select.POLLIN)
            elif file == sys.stdin.fileno():
                if not os.read(file, 4096):
                    return
            elif not _answer(board, clients[file], clock):
                poll.unregister(file)
                clients.pop(file).close()
        if device:
            device.tick(time.monotonic())


def _registered(poll: select.poll, known: set[int], files: set[int]) -> set[int]:
    """The files, registered in place of those known before."""
    for file in files - known:
        poll.register(file, select.POLLIN)
    for file in known - files:
        poll.unregister(file)
    return files


def _answer(board: EmulatedBoard, client: socket.socket, clock: MachineClock) -> bool:
    """Executes one packet; false where the client has gone."""
    try:
        packet = client.recv(wire.COMMAND.size)
        if not packet:
            return False
        verb, number = wire.COMMAND.unpack(packet)
        now = clock.now_s(reading=verb == wire.READ)
        if verb == wire.READ:
            client.send(wire.READING.pack(now, *board.read(now)))
        elif verb == wire.WRITE:
            board.write(now, number)
        elif verb in (wire.ENABLE, wire.DISABLE):
            board.power(now, on=verb == wire.ENABLE)
        elif verb == wire.TRUTH:
            client.send(wire.TRUTH_ANSWER.pack(*board.truth(now)))
    except OSError:
        return False
    return True


def main(address: str, settings: str = "{}") -> int:
    """Makes the hardware and serves it; returns the exit code."""
    try:
        given = json.loads(settings)
        board, clock = make_board(given, time.monotonic()), make_clock(given)
    except EstuneError as error:
        print(f"emulator: {error}", file=sys.stderr)
        return error.exit_code
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(address)
        listener.listen()
        device = DEVICES[given["device"]](board, address) if "device" in given else None
        print(device.address if device else address, flush=True)
        with contextlib.suppress(OSError):  # optional: hardware in real time
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        gc.freeze()
        serve(board, listener, clock, device)
    Path(address).unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
