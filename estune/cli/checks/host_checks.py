"""Checks on the process that serves a rig, where it runs on this machine (Linux)."""

import ipaddress
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from estune.cli.checks.check_result import CheckResult, fine, fix, unknown

_LISTENS = "0A"
_PROC = Path("/proc")
_NOT_VISIBLE = "the rig's process is not one of this user on this machine"
_RUN_THERE = "run estune doctor on the rig's machine, as its user, at the rig's own endpoint"


@dataclass(frozen=True, slots=True)
class Host:
    """The process that listens at a rig's endpoint.

    Attributes:
        pid: Its process id.
        listens: The addresses it listens at.
        real_time: Whether it or one of its children runs with real-time priority.
        locked: Whether it or one of its children has locked memory.
        ledger: Its ledger, or None.
    """

    pid: int
    listens: tuple[str, ...]
    real_time: bool
    locked: bool
    ledger: Path | None


def find_host(endpoint: str) -> Host | None:
    """The process that listens at the endpoint; None if it is not visible to this user."""
    match = re.fullmatch(r"(?:tcp|tls)/(127\.\d+\.\d+\.\d+|localhost|\[::1\]):(\d+)", endpoint)
    if match is None or not _PROC.joinpath("net/tcp").exists():
        return None
    sockets = dict(_listening())
    wanted = {inode for inode, (_, port) in sockets.items() if port == int(match[2])}
    for folder in _PROC.glob("[0-9]*"):
        links = _links(folder)
        inodes = {int(link[8:-1]) for link in links if link.startswith("socket:[")}
        if inodes & wanted:
            family = (folder, *_children(folder))
            return Host(
                pid=int(folder.name),
                listens=tuple(sorted({sockets[i][0] for i in inodes if i in sockets})),
                real_time=any(map(_is_real_time, family)),
                locked=any(map(_is_locked, family)),
                ledger=_ledger(links),
            )
    return None


def check_permissions(host: Host | None, *, simulated: bool, software: str) -> CheckResult:
    """Whether the real-time loop has its priority and locked memory.

    Only estune's own server is known to run the loop itself; a gateway leaves it to a board.
    """
    if simulated:
        return fine("permissions", "a simulated rig needs none")
    if host is None:
        return unknown("permissions", f"not stated: {_NOT_VISIBLE}", _RUN_THERE)
    granted = {"real-time priority": host.real_time, "locked memory": host.locked}
    missing = [name for name in granted if not granted[name]]
    if not missing:
        return fine("permissions", "real-time priority and locked memory are granted")
    lacking = f"without {' and without '.join(missing)}"
    if software.startswith("estune ") and host.ledger is not None:
        return fix(
            "permissions",
            f"the rig runs {lacking}",
            "grant rtprio and memlock in /etc/security/limits.d or in its service",
        )
    return unknown(
        "permissions",
        f"not stated: process {host.pid} at the endpoint runs {lacking}; the rig does not state "
        "whether its loop runs there",
    )


def check_ports(host: Host | None, endpoint: str, *, authenticated: bool) -> CheckResult:
    """Whether the rig is reachable from the network without authentication."""
    port = endpoint.rpartition(":")[2]
    at = (endpoint,) if host is None else host.listens
    # The process may serve other things than the rig at other ports.
    own = [address for address in at if address.rpartition(":")[2] == port]
    remote = [address for address in own if not _is_loopback(address)]
    if remote and not authenticated:
        return fix(
            "ports",
            f"every client that reaches {', '.join(remote)} can command the rig",
            "listen at 127.0.0.1, or require authentication (--security)",
        )
    if host is None:
        return fine("ports", f"reached at {endpoint}")
    return fine("ports", f"listens at {', '.join(at)}")


def check_ledger(host: Host | None, *, simulated: bool) -> CheckResult:
    """Whether the rig's ledger survives a restart."""
    if host is not None and host.ledger is not None:
        return fine("ledger", f"on disk, {host.ledger}")
    if simulated:
        return fine("ledger", "not stated; a simulated rig needs none on disk")
    if host is None:
        return unknown("ledger", f"not stated: {_NOT_VISIBLE}", _RUN_THERE)
    return unknown(
        "ledger", f"not stated: process {host.pid} at the endpoint has no ledger of estune's kind"
    )


def _is_loopback(address: str) -> bool:
    """Whether an address, alone or in an endpoint, is reached from this machine only."""
    if address.startswith("unixsock-stream/"):
        return True
    host = address.partition("/")[2] or address
    host = host.rpartition(":")[0].strip("[]") or host
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def _listening() -> Iterator[tuple[int, tuple[str, int]]]:
    """Inodes of listening sockets, with address and port."""
    for name in ("tcp", "tcp6"):
        with suppress(OSError):
            for line in (_PROC / "net" / name).read_text(encoding="ascii").splitlines()[1:]:
                words = line.split()
                if words[3] == _LISTENS:
                    host, port = words[1].split(":")
                    # Groups of four bytes in native byte order.
                    raw = bytes.fromhex(host)
                    packed = b"".join(raw[i : i + 4][::-1] for i in range(0, len(raw), 4))
                    number = int(port, 16)
                    address = ipaddress.ip_address(packed)
                    shown = f"[{address}]" if address.version == 6 else str(address)
                    yield int(words[9]), (f"{shown}:{number}", number)


def _links(folder: Path) -> list[str]:
    """Open files of a process; empty for another user's."""
    links = []
    with suppress(OSError):
        for link in (folder / "fd").iterdir():
            with suppress(OSError):
                links.append(str(link.readlink()))
    return links


def _children(folder: Path) -> list[Path]:
    with suppress(OSError):
        pids = (folder / "task" / folder.name / "children").read_text(encoding="ascii").split()
        return [_PROC / pid for pid in pids]
    return []


def _is_real_time(folder: Path) -> bool:
    with suppress(OSError):
        threads = [int(task.name) for task in (folder / "task").iterdir()]
        return any(_policy(thread) in (os.SCHED_FIFO, os.SCHED_RR) for thread in threads)
    return False


def _policy(thread: int) -> int:
    return os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK


def _is_locked(folder: Path) -> bool:
    with suppress(OSError):
        status = (folder / "status").read_text(encoding="utf-8")
        locked = re.search(r"^VmLck:\s+(\d+)", status, re.MULTILINE)
        return locked is not None and int(locked[1]) > 0
    return False


def _ledger(links: list[str]) -> Path | None:
    """The open file whose ledger lock is open, too."""
    ledgers = (link for link in links if f"{link}.lock" in links)
    return next(map(Path, ledgers), None)
