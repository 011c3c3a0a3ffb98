"""All mistakes of the daemon's file at once, and what it names outside itself."""

import os
import shutil
import socket
from collections.abc import Callable, Iterator
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from estune.daemon.config import config_from
from estune.errors import InvalidInput
from estune.proof.patch import read_proven
from estune.remote.security import read_security
from estune.remote.zenoh.endpoints import check_endpoint, host_and_port
from estune.run.targets import check_reference, is_endpoint
from estune.support.toml_file import read_toml


def check_file(path: Path) -> int:
    """Finds all mistakes of the daemon's file, of every kind; no rig is contacted.

    Returns:
        The number of rigs.

    Raises:
        InvalidInput: there are mistakes; the message has a line for each: keys and values,
            targets and routers that cannot exist, hooks that cannot be run, files and folders
            that cannot be read or written.
    """
    data, beside = read_toml(path), path.parent
    faults: list[str] = []
    try:
        config_from(data, str(path), beside)
    except InvalidInput as error:
        faults += str(error).splitlines()
    # What the tables name is looked for even where other values in them are wrong.
    for place, check, value in _named(data, beside):
        try:
            check(value)
        except InvalidInput as error:
            faults.append(f"{path}: {place}: {error}")
    if faults:
        raise InvalidInput("\n".join(faults))
    return len(data["rig"])


def _named(
    data: dict[str, Any], beside: Path
) -> Iterator[tuple[str, Callable[[Any], object], Any]]:
    """What the tables name outside the file: its place, how it is checked, and its value."""
    service = _table(data, "service")
    for router in service.get("routers", ()):
        yield "service: routers", _check_address, router
    if isinstance(security := service.get("security"), str):
        yield "service: security", read_security, beside / security
    if isinstance(file := _table(data, "metrics").get("file"), str):
        yield "metrics: file", _check_writable, (beside / file).parent
    if isinstance(state := data.get("state", "estune-state"), str):
        yield "state", _check_writable, beside / state
    for number, hook in enumerate(_tables(data, "hook"), 1):
        for program in _texts(hook, "command")[:1]:
            yield f"hook {number}: command", _check_program, program
    for number, rig in enumerate(_tables(data, "rig"), 1):
        place = f"rig {rig.get('name', number)}"
        if isinstance(target := rig.get("target"), str):
            yield f"{place}: target", _check_target, target
        for path in _texts(rig, "remedies"):
            yield f"{place}: remedies", read_proven, beside / path


def _table(data: dict[str, Any], name: str) -> dict[str, Any]:
    table = data.get(name)
    return table if isinstance(table, dict) else {}


def _tables(data: dict[str, Any], name: str) -> list[dict[str, Any]]:
    tables = data.get(name)
    return [t for t in tables if isinstance(t, dict)] if isinstance(tables, list) else []


def _texts(data: dict[str, Any], name: str) -> list[str]:
    texts = data.get(name)
    return [t for t in texts if isinstance(t, str)] if isinstance(texts, list) else []


def _check_target(target: str) -> None:
    if is_endpoint(target):
        check_endpoint(target)
        _check_address(target)
    else:
        check_reference(target)


def _check_program(program: str) -> None:
    """Refuses a hook's program that is not there or may not be run."""
    if shutil.which(program) is None:
        raise InvalidInput(f"there is no program {program}, or it is not executable")


def _check_writable(folder: Path) -> None:
    """Refuses a folder in which this user can neither write nor make it."""
    nearest = folder
    while not nearest.exists() and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InvalidInput(f"{folder} cannot be written by this user: see {nearest}")


def _check_address(endpoint: str) -> None:
    """Refuses a port or an address at which nothing can listen."""
    check_endpoint(endpoint)
    if endpoint.startswith("unixsock-stream/"):
        return
    host, port = host_and_port(endpoint)
    if port == 0:
        raise InvalidInput(f"{endpoint}: nothing listens at port 0; give the port that it printed")
    if host.replace(".", "").isdigit():
        try:
            ip_address(host)
        except ValueError:
            raise InvalidInput(f"{endpoint}: {host} is no IP address") from None
    try:
        socket.getaddrinfo(host, port)
    except (OSError, UnicodeError):  # a label of a name may be too long to be encoded
        raise InvalidInput(
            f"{endpoint}: this machine cannot resolve the host name {host}; correct it, or give "
            "the host's IP address"
        ) from None
