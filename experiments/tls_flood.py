"""Do connections that prove nothing keep others out of a rig that listens with TLS?

Command: `python -m experiments.tls_flood`.
Target: newcomer, emergency stop and reconnecting client within 2 s under every kind of flood; the
stop alone where handshakes come from the address of the others, for nothing tells them apart.

A rig listens with certificates. Another process opens connections to it, all at once, and again
whenever one ends: bare ones, ones that send noise instead of a handshake, ones that complete the
handshake with a certificate and say nothing, and bare ones that leave after 3 s. Or it opens 3 000
connections a second that each begin a handshake and go no further, from the address of the others
(hello) or from another one (hello_elsewhere).
Meanwhile a newcomer connects and queries the rig, an emergency stop comes from a fresh session,
and a client whose connection is cut comes back. Printed is the longest time of each, s, to the
end of the call, without the start of a Python process.
"""

import argparse
import asyncio
import resource
import socket
import ssl
import struct
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from estune.errors import RigError
from estune.hardware.real_time import prioritised
from estune.remote import zenoh
from estune.remote.security import Security, read_security
from estune.support.child_process import child_process, next_line
from experiments.chaos.wire import Wire
from experiments.inert_rig import DESCRIBED, RECORD, InertRig
from experiments.results import Target, at_most, command_line, print_results

LIMIT_S = 2.0
KINDS = ("bare", "noise", "handshake", "leaving")
SIZES = (300, 1000)
HELLOS = {"hello": "127.0.0.1", "hello_elsewhere": "127.0.0.2"}
"""Kinds of connections that begin a handshake, and the address they come from."""
HELLOS_A_SECOND = 3000
HELLO_HELD_S = 0.5
SERVER_PRIORITY = 20
"""Priority of the rig's threads, the default of a rig on hardware."""
HELD_S = 3.0
"""Time after which those leave that leave, s."""
_OPENSSL = """\
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=lab \
  -keyout ca.key -out ca.pem
for name in rig anna; do
  openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj /CN=$name \
    -keyout $name.key -out $name.csr
  printf 'subjectAltName=IP:127.0.0.1\\nbasicConstraints=CA:FALSE\\n' > $name.ext
  openssl x509 -req -in $name.csr -days 2 -extfile $name.ext -CA ca.pem -CAkey ca.key \
    -CAcreateserial -out $name.pem
  printf '[tls]\\nauthority = "ca.pem"\\ncertificate = "%s.pem"\\nkey = "%s.key"\\n' $name $name \
    > $name.toml
done
printf '[access]\\ncommand = ["anna"]\\n' >> rig.toml
chmod 600 *.key
"""


def identities(folder: Path) -> None:
    """Certificates and security files of a rig and of its user anna."""
    subprocess.run(["sh", "-ec", _OPENSSL], cwd=folder, check=True, capture_output=True)  # noqa: S603, S607


# --- the flood, in a process of its own ------------------------------------------------------


async def _one(kind: str, port: int, context: ssl.SSLContext) -> None:
    """One connection after the other, for as long as the process lives."""
    while True:
        with suppress(OSError, ssl.SSLError, asyncio.IncompleteReadError):
            tls = context if kind == "handshake" else None
            reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=tls)
            if kind == "noise":
                writer.write(b"\x16\x03\x01\x02\x00" + bytes(range(256)) * 2)
            with suppress(TimeoutError):
                async with asyncio.timeout(HELD_S if kind == "leaving" else None):
                    await reader.read(1)  # until it is closed
            writer.transport.abort()
        await asyncio.sleep(0.2)


async def flood(kind: str, count: int, port: int, folder: Path) -> None:
    """Keeps so many connections open."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # Python 3.13's default is stricter
    context.load_verify_locations(folder / "ca.pem")
    context.load_cert_chain(folder / "anna.pem", folder / "anna.key")
    await asyncio.gather(*(_one(kind, port, context) for _ in range(count)))


def flood_hellos(rate_Hz: int, source: str, port: int) -> None:
    """Begins so many handshakes a second, and never ends one; prints how many each second."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))
    hello = _client_hello()
    held: deque[tuple[float, socket.socket]] = deque()
    began_s, opened, told_s = time.monotonic(), 0, 1.0
    while True:
        passed_s = time.monotonic() - began_s
        while opened < rate_Hz * passed_s:
            opened += 1
            connection = socket.socket()
            with suppress(OSError):
                connection.bind((source, 0))
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                connection.connect(("127.0.0.1", port))
                connection.send(hello)
            held.append((passed_s + HELLO_HELD_S, connection))
        while held and held[0][0] < passed_s:
            held.popleft()[1].close()
        if passed_s > told_s:
            print(opened / passed_s, file=sys.stderr, flush=True)
            told_s += 1.0
        time.sleep(0.002)


def _client_hello() -> bytes:
    """The first message of a handshake."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    out = ssl.MemoryBIO()
    client = context.wrap_bio(ssl.MemoryBIO(), out, server_hostname="127.0.0.1")
    with suppress(ssl.SSLWantReadError):
        client.do_handshake()
    return out.read()


# --- the others ------------------------------------------------------------------------------


def _seconds(call: Callable[[], object]) -> float:
    began_s = time.monotonic()
    try:
        call()
    except RigError:
        return float("inf")
    return time.monotonic() - began_s


def _join(endpoint: str, security: Security) -> None:
    with zenoh.connect(endpoint, timeout_s=30.0, security=security) as rig:
        rig.status()


def _stop(endpoint: str, security: Security) -> None:
    with zenoh.connect(endpoint, timeout_s=30.0, security=security) as rig:
        rig.estop("flood")


@contextmanager
def _flooded(kind: str, count: int, port: int, folder: Path) -> Iterator[None]:
    words = ["flood", kind, str(count), str(port), str(folder)]
    with child_process("experiments.tls_flood", *words):
        time.sleep(1.0)
        yield


def longest_s(kind: str, count: int, folder: Path, hold_s: float) -> dict[str, float]:
    """The longest time of a newcomer, a stop and a reconnection during a flood, s."""
    security = read_security(folder / "anna.toml")
    longest = dict.fromkeys(("newcomer", "stop", "reconnect"), 0.0)
    with ExitStack() as opened:
        process = opened.enter_context(child_process("experiments.tls_flood", "rig", str(folder)))
        endpoint = next_line(process)
        port = int(endpoint.rpartition(":")[2])
        wire = opened.enter_context(Wire(endpoint.replace("tls/", "tcp/")))
        there = wire.endpoint.replace("tcp/", "tls/")
        client = opened.enter_context(zenoh.connect(there, patience_s=60.0, security=security))
        with _flooded(kind, count, port, folder):
            ends_s = time.monotonic() + hold_s
            while time.monotonic() < ends_s:
                wire.cut()
                calls: dict[str, Callable[[], object]] = {
                    "newcomer": lambda: _join(endpoint, security),
                    "stop": lambda: _stop(endpoint, security),
                    "reconnect": client.status,
                }
                for name, call in calls.items():
                    longest[name] = max(longest[name], _seconds(call))
                time.sleep(0.5)
    return longest


def serve(folder: Path) -> None:
    """Serves the rig until standard input is closed."""
    security = read_security(folder / "rig.toml")
    rig = InertRig(DESCRIBED, RECORD)
    with (
        prioritised(SERVER_PRIORITY),
        zenoh.serve(rig, "tls/127.0.0.1:0", security=security) as server,
    ):
        print(server.endpoint, flush=True)
        sys.stdin.read()


def main() -> int:
    """Runs the experiment."""
    options = _options()
    figures: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        identities(Path(name))
        hold_s = options.seconds or (3.0 if options.quick else 60.0)
        for kind in HELLOS:
            figures[kind] = longest_s(kind, HELLOS_A_SECOND, Path(name), hold_s)
        for kind in KINDS:
            for size in SIZES[: 1 if options.quick else None]:
                found = longest_s(kind, size, Path(name), hold_s)
                figures[f"{kind}_{size}"] = found
    targets: dict[str, Target] = {
        f"{kind}_s": at_most(found["stop"] if kind == "hello" else max(found.values()), LIMIT_S)
        for kind, found in figures.items()
    }
    return print_results(figures, targets, as_json=options.json, tables=True)


def _options() -> argparse.Namespace:
    parser = command_line(__doc__, quick="300 connections, 3 s each")
    parser.add_argument("--seconds", type=float, help="length of each flood, s")
    return parser.parse_args()


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["flood", kind, rate, port, _] if kind in HELLOS:
            flood_hellos(int(rate), HELLOS[kind], int(port))
        case ["flood", kind, count, port, folder]:
            asyncio.run(flood(kind, int(count), int(port), Path(folder)))
        case ["rig", folder]:
            serve(Path(folder))
        case _:
            sys.exit(main())
