"""TLS in front of a listening session: no connection reaches it before its certificate is checked.

Zenoh's own TLS listener rests 100 ms after every handshake that fails, so that 300 idle
connections keep newcomers out for half a minute. Here a handshake delays no other, and the session
knows nothing of a client before it has spoken under a certificate that has a right.
"""

import asyncio
import logging
import socket
import ssl
import tempfile
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import cast

from estune.errors import InvalidInput, RigError
from estune.remote.certificate_faults import fault_found, fault_told, own_fault
from estune.remote.security import Security, Tls, common_name, has_version_3
from estune.remote.zenoh.endpoints import host_and_port
from estune.remote.zenoh.tls_arrivals import Arrivals, Handshake
from estune.support.open_files import allow_open_files
from estune.support.printable import printable

HANDSHAKE_WITHIN_S = 5.0
"""Time for a handshake that has begun."""

SPOKEN_WITHIN_S = 10.0
"""Time from the handshake to the first message, s."""

OPEN_FILES = 16384
"""Files that a process with a front asks the system for: connections that may wait."""

TOLD_AGAIN_S = 60.0
"""Time for which a fault of one host's certificate is not logged again."""

_TOLD_MAX = 1000  # hosts remembered: a flood from many takes no more memory
_WAITING_BYTES_MAX = 2**16  # what a client may send before the session is open
_ACCEPT_AGAIN_S = 0.1  # without a free file the socket would wake the loop on and on
_ACCEPTED_AT_ONCE = 32  # the bytes of open sessions wait for no flood
_END_WITHIN_S = 2.0

_log = logging.getLogger(__name__)


class InnerEndpoints:
    """Where the session of each right listens: sockets in a folder of this user's own."""

    def __init__(self, security: Security) -> None:
        self._security = security
        self._folder = tempfile.TemporaryDirectory(prefix="estune-")
        self.paths = {right: Path(self._folder.name) / right for right in security.rights}

    def for_client(self, name: str) -> Path | None:
        """The socket of the client whose certificate has a name; None without any right."""
        right = self._security.right_of(name)
        return self.paths[right] if right else None

    def close(self) -> None:
        """Removes the folder."""
        self._folder.cleanup()


class TlsFront:
    """Accepts TLS connections at an endpoint and passes their bytes on to the session's own.

    Attributes:
        inner: Where the sessions listen.
        ends: The ends of connections that are open.
    """

    def __init__(self, endpoint: str, tls: Tls, inner: InnerEndpoints) -> None:
        """Listens, in a thread of its own; port 0 selects a free port.

        Raises:
            RigError: the endpoint is in use, or the certificate cannot be used.
        """
        self.inner = inner
        try:
            self._context = listener_context(endpoint, tls)
            self._socket = _listening_socket(endpoint)
        except BaseException:
            inner.close()
            raise
        allow_open_files(OPEN_FILES)
        self.endpoint = f"{endpoint.rpartition(':')[0]}:{self._socket.getsockname()[1]}"
        self._loop = asyncio.new_event_loop()
        self._told_s: dict[str, float] = {}
        self._ending = asyncio.Event()
        self.ends: set[_End] = set()
        self._thread = threading.Thread(target=self._run, name="TLS", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Closes the endpoint and all connections. May be called again."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(_END_WITHIN_S)
        self.inner.close()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        self._loop.set_exception_handler(lambda _, found: _log.debug("TLS: %s", found["message"]))
        arrivals = Arrivals(self._loop, self._begin)
        self._loop.add_reader(self._socket, self._accept, arrivals)
        await self._ending.wait()
        self._loop.remove_reader(self._socket)
        self._socket.close()
        await asyncio.gather(*arrivals.close(), return_exceptions=True)
        for end in tuple(self.ends):
            end.transport.abort()
        while self.ends:
            await asyncio.sleep(0.0)

    def _accept(self, arrivals: Arrivals) -> None:
        for _ in range(_ACCEPTED_AT_ONCE):
            try:
                connection, address = self._socket.accept()
            except BlockingIOError:
                return
            except OSError as error:  # gone already, or no file is left
                _log.debug("TLS: %s", error)
                self._loop.remove_reader(self._socket)
                self._loop.call_later(_ACCEPT_AGAIN_S, self._accept_again, arrivals)
                return
            connection.settimeout(0.0)  # for asyncio
            arrivals.add(connection, address[0])

    def _accept_again(self, arrivals: Arrivals) -> None:
        if not self._ending.is_set():
            self._loop.add_reader(self._socket, self._accept, arrivals)

    def _begin(self, connection: socket.socket) -> Handshake:
        task = self._loop.create_task(self._shake_hands(connection))
        task.add_done_callback(partial(_close_if_cancelled, connection))
        return task

    async def _shake_hands(self, connection: socket.socket) -> None:
        host = _peer_host(connection)
        try:
            await self._loop.connect_accepted_socket(
                lambda: _Client(self, self._loop),
                connection,
                ssl=self._context,
                ssl_handshake_timeout=HANDSHAKE_WITHIN_S,
                ssl_shutdown_timeout=_END_WITHIN_S,
            )
        except ssl.SSLError as error:
            self._tell(error, host)
        except OSError as error:
            _log.debug("TLS: %s", error)

    def _tell(self, error: ssl.SSLError, host: str) -> None:
        """Logs a fault of a certificate: a line, however often that client tries again."""
        found, told = fault_found(error), fault_told(error)
        if not (found or told):
            _log.debug("TLS: %s", error)  # noise, or no certificate at all
            return
        who = (
            "the client's certificate" if found else "the client says that this rig's certificate"
        )
        line, now_s = f"{host}: {who} {found or told}", self._loop.time()
        if now_s - self._told_s.get(line, -TOLD_AGAIN_S) < TOLD_AGAIN_S:
            return
        if len(self._told_s) >= _TOLD_MAX:
            self._told_s.clear()
        self._told_s[line] = now_s
        _log.warning("%s", line)


def _peer_host(connection: socket.socket) -> str:
    """Address of the other end, for the log; `gone` if it has closed."""
    try:
        return str(connection.getpeername()[0])
    except OSError:
        return "gone"


def _close_if_cancelled(connection: socket.socket, task: Handshake) -> None:
    if task.cancelled():  # perhaps before it began, so that no transport has the socket
        connection.close()


class _End(asyncio.Protocol):
    """One end of a passage: its bytes go to the other end, as fast as that takes them."""

    transport: asyncio.Transport
    other: "_End | None" = None

    def __init__(self, ends: "set[_End]") -> None:
        self._ends = ends

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        self._ends.add(self)

    def data_received(self, data: bytes) -> None:
        if self.other is not None:
            self.other.transport.write(data)

    def pause_writing(self) -> None:
        if self.other is not None:
            self.other.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.other is not None:
            self.other.transport.resume_reading()

    def connection_lost(self, _: Exception | None) -> None:
        self._ends.discard(self)
        if self.other is not None:
            self.other.transport.close()


class _Client(_End):
    def __init__(self, front: TlsFront, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__(front.ends)
        self._front, self._loop = front, loop
        self._way: Path | None = None
        self._waiting = b""
        self._opening: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Finds the way of the client by the name in its certificate."""
        super().connection_made(transport)
        certificate = transport.get_extra_info("ssl_object").getpeercert(binary_form=True)
        name = common_name(transport.get_extra_info("peercert"))
        self._way = self._front.inner.for_client(name) if has_version_3(certificate) else None
        if self._way is None:
            _log.warning("client %r has a certificate and no right", printable(name))
            self.transport.abort()
            return
        self._loop.call_later(SPOKEN_WITHIN_S, self._close_if_silent)

    def data_received(self, data: bytes) -> None:
        """Passes bytes on; opens the way with the first."""
        if self.other is not None:
            self.other.transport.write(data)
            return
        self._waiting += data
        if len(self._waiting) > _WAITING_BYTES_MAX:
            self.transport.abort()
        elif self._opening is None:
            self._opening = self._loop.create_task(self._open())

    async def _open(self) -> None:
        made = partial(_End, self._front.ends)
        try:
            _, end = await self._loop.create_unix_connection(made, str(self._way))
        except OSError as error:
            _log.warning("the session does not take a connection: %s", error)
            self.transport.abort()
            return
        end.other, self.other = self, end
        end.transport.write(self._waiting)
        if self.transport.is_closing():
            end.transport.close()

    def _close_if_silent(self) -> None:
        if self._opening is None:
            self.transport.abort()


def listener_context(endpoint: str, tls: Tls) -> ssl.SSLContext:
    """The context of a listener; a certificate that no client will accept is logged.

    Raises:
        RigError: the certificate cannot be used.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.num_tickets = 0
    try:
        tls.load_into(context)
    except InvalidInput as error:
        raise RigError(
            f"cannot listen at {endpoint} with the certificate of --security: {error}"
        ) from error
    if fault := own_fault(tls, listens=True):
        _log.warning("no client will accept this rig: %s %s", tls.certificate, fault)
    return context


def _listening_socket(endpoint: str) -> socket.socket:
    host, port = host_and_port(endpoint)
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family, backlog=socket.SOMAXCONN)
    except OSError as error:
        cause = (error.strerror or str(error)).lower()
        raise RigError(
            f"cannot listen at {endpoint}: {cause}; choose another port, or port 0 for any free "
            "one"
        ) from error
    listening.settimeout(0.0)  # for asyncio
    return listening
