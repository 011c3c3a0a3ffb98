"""Endpoints: their form, their reach, and why a client cannot connect to one."""

import difflib
import ipaddress
import re
import socket
import ssl

from estune.errors import InvalidInput
from estune.remote.certificate_faults import fault_found, fault_told, own_fault
from estune.remote.security import OPEN, Security, Tls

_PROBE_WITHIN_S = 2.0  # only to explain a connection that has failed already


def intended_endpoint(text: str) -> str:
    """The endpoint that a malformed one stands for, such as `127.0.0.1:7447`; empty if none."""
    form = r"(?:([a-z]{3,5})(?::/*|/+))?(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+):(\d{1,5})/?"
    match = re.fullmatch(form, text)
    if match is None or int(match[3]) > 65535:
        return ""
    scheme = difflib.get_close_matches(match[1] or "tcp", ("tcp", "tls", "quic"), 1) or ["tcp"]
    return f"{scheme[0]}/{match[2]}:{match[3]}"


def check_endpoint(endpoint: str) -> None:
    """Raises `InvalidInput` if an endpoint is malformed."""
    form = r"(tcp|tls|quic)/(\[[0-9a-fA-F:.]+\]|[^\s/:\[\]]+):(\d{1,5})|unixsock-stream/\S+"
    match = re.fullmatch(form, endpoint)
    if match is None or int(match[3] or 0) > 65535:
        intended = intended_endpoint(endpoint)
        raise InvalidInput(
            f"endpoint {endpoint!r} is malformed; "
            + (f"did you mean {intended}?" if intended else "write it as tcp/host:port, ")
            + ("" if intended else "for example tcp/127.0.0.1:7447")
        )


def check_loopback(endpoint: str) -> None:
    """Raises `InvalidInput` if other machines could connect to a listener."""
    if endpoint.startswith("unixsock-stream/"):
        return
    host, _ = host_and_port(endpoint)
    try:
        addresses = {info[4][0] for info in socket.getaddrinfo(host, None)}
    except OSError as error:
        raise InvalidInput(
            f"endpoint {endpoint!r}: host {host!r} is unknown; check its name"
        ) from error
    if not all(ipaddress.ip_address(str(address)).is_loopback for address in addresses):
        raise InvalidInput(
            f"listening at {endpoint} would let any machine on the network move the rig; listen "
            "at 127.0.0.1, or on a network you trust allow it with --allow-remote (in Python and "
            "TOML: allow_remote)"
        )


def check_listener(endpoint: str, security: Security, *, allow_remote: bool) -> None:
    """Raises `InvalidInput` if a server may not listen at an endpoint, before it does."""
    check_endpoint(endpoint)
    security.check_endpoint(endpoint)
    if not allow_remote:
        check_loopback(endpoint)


def with_port(endpoint: str) -> str:
    """The endpoint with a free port in place of port 0: Zenoh does not report its choice."""
    if endpoint.startswith("unixsock-stream/"):
        return endpoint
    host, port = host_and_port(endpoint)
    if port != 0:
        return endpoint
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.bind((host, 0))
        return f"{endpoint.rpartition(':')[0]}:{probe.getsockname()[1]}"


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint that is no socket of Unix."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def connection_fault(endpoint: str, security: Security) -> tuple[str, bool]:
    """Why a client cannot connect, found by a connection without Zenoh, which gives no reason.

    Returns:
        The reason with its remedy, and whether nothing listens there.
    """
    silent = f"nothing that speaks Zenoh listens at {endpoint}"
    rejection = "requires authentication" if security == OPEN else "rejects this client"
    if endpoint.startswith("quic/") and security.tls is not None:
        return _quic_fault(endpoint, security.tls), True
    if not endpoint.startswith(("tcp/", "tls/")):
        return f"{silent}, or the listener {rejection}: see --security", True
    host, port = host_and_port(endpoint)
    try:
        with socket.create_connection((host, port), _PROBE_WITHIN_S) as connection:
            fault = None if security.tls is None else _tls_fault(connection, host, security.tls)
    except OSError:
        return silent, True
    where = f"the listener at {endpoint}"
    return (
        f"{where} and this client do not accept each other's certificates: {fault}; check both "
        "(estune docs security), and see --security"
        if fault
        else f"{where} does not speak Zenoh, does not reply, or {rejection}: see --security"
    ), False


def _quic_fault(endpoint: str, tls: Tls) -> str:
    """Why a client cannot connect by QUIC, whose handshake is Zenoh's own and gives no reason."""
    try:
        if own := own_fault(tls, listens=False):
            return f"no listener at {endpoint} accepts {tls.certificate}: it {own}"
    except InvalidInput as error:
        return str(error)
    return (
        f"nothing that speaks Zenoh listens at {endpoint}, or it and this client do not accept "
        "each other's certificates; a rig at tls/ says which, see --security"
    )


def _tls_fault(connection: socket.socket, host: str, tls: Tls) -> str:
    """Faults of the certificates of either side; empty if there are none."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        tls.load_into(context)
        own = own_fault(tls, listens=False)
    except InvalidInput as error:
        return str(error)
    if own:
        return f"{tls.certificate} {own}"
    try:
        with context.wrap_socket(connection, server_hostname=host) as encrypted:
            encrypted.settimeout(_PROBE_WITHIN_S)
            encrypted.recv(1)  # an objection to the client's certificate comes after the handshake
    except ssl.SSLError as error:
        if found := fault_found(error):
            return f"the listener's {found}"
        told = fault_told(error) or f"was rejected, {error.reason or error}"
        return f"the listener says that {tls.certificate} {told}"
    except OSError:
        pass  # it waits for this client to speak
    return ""
