"""A service of pages by HTTP, for this machine, with a key for requests that act."""

import hmac
import secrets
import socket
import threading
from collections.abc import Sequence
from functools import partial
from importlib.resources import files
from ipaddress import ip_address

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from estune.errors import InvalidInput

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
_END_WITHIN_S = 5.0

Folders = Sequence[tuple[str, str]]
"""Folders of files, each by its package and its path in it."""


def usual_port(usual: int, host: str = "127.0.0.1") -> int:
    """The usual port of a page, or 0 where it is taken: by another page, as a rule."""
    try:
        with _listening(host, usual):
            return usual
    except OSError:
        return 0


def _listening(host: str, port: int) -> socket.socket:
    return socket.create_server(
        (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
    )


class HttpService:
    """Serves routes from a thread of its own until `close`.

    Attributes:
        key: What a request must carry to be allowed more than to read; empty where nothing is.
        address: Address of the page, with the key behind `#`, where no server sees it.
        is_ending: Whether the service is about to end, so that streams must.
    """

    def __init__(
        self,
        routes: Sequence[Route],
        folders: Folders,
        *,
        index: str = "index.html",
        host: str = "127.0.0.1",
        port: int = 0,
        with_key: bool = False,
        allow_remote: bool = False,
    ) -> None:
        """Listens; port 0 takes a free one.

        Raises:
            InvalidInput: the port is taken, or other machines could open the page.
        """
        _check_reach(host, allow_remote=allow_remote)
        try:
            self._socket = _listening(host, port)
        except OSError as error:
            raise InvalidInput(
                f"the page cannot be served on port {port} of {host}: {error.strerror}; choose "
                "another --port; 0 takes a free one"
            ) from error
        self.port = self._socket.getsockname()[1]
        self.key = secrets.token_urlsafe(16) if with_key else ""
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self.port}/" + (f"#key={self.key}" if self.key else "")
        names = {shown, "localhost", "127.0.0.1", "[::1]", *_own_names(allow_remote=allow_remote)}
        static = partial(_static, folders)
        app = Starlette(
            routes=[
                Route("/", lambda _: static(index)),
                Route("/static/{name}", lambda request: static(request.path_params["name"])),
                *routes,
            ]
        )
        self._server = uvicorn.Server(
            uvicorn.Config(
                _Guard(app, frozenset(f"{name}:{self.port}" for name in names)),
                log_level="warning",
                access_log=False,
                lifespan="off",
                timeout_graceful_shutdown=1,
                ws="none",
            )
        )
        serve = partial(self._server.run, sockets=[self._socket])
        self._thread = threading.Thread(target=serve, name="page", daemon=True)
        self._thread.start()

    @property
    def is_ending(self) -> bool:
        """Whether `close` was called."""
        return self._server.should_exit

    def allows(self, request: Request) -> bool:
        """Whether a request carries the key."""
        token = request.headers.get("authorization", "").removeprefix("Bearer ")
        return bool(self.key) and hmac.compare_digest(token.encode(), self.key.encode())

    def close(self) -> None:
        """Ends all connections and releases the port."""
        self._server.should_exit = True
        self._thread.join(_END_WITHIN_S)
        self._socket.close()


async def body_of(request: Request, most_bytes: int) -> bytes:
    """The body of a request.

    Raises:
        ValueError: it is longer than allowed.
    """
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > most_bytes:
            raise ValueError(f"the request is longer than {most_bytes} bytes")
    return body


class _Guard:
    """Refuses requests for another host's name and from another site's page.

    A page of another site could else have the reader's browser send commands here, or read the
    answers under a name that it makes resolve to this machine.
    """

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self._app = app
        self._hosts = hosts
        self._origins = frozenset(f"http://{host}" for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = {name: value.decode("latin-1") for name, value in scope["headers"]}
        origin = headers.get(b"origin")
        if headers.get(b"host", "").lower() not in self._hosts:
            answer = Response("this server has another name", 400)
            await answer(scope, receive, send)
        elif origin is not None and origin.lower() not in self._origins:
            answer = Response("not from another site's page", 403)
            await answer(scope, receive, send)
        else:
            await self._app(scope, receive, send)


def _static(folders: Folders, name: str) -> Response:
    places = (files(package).joinpath(folder) for package, folder in folders)
    file = next((one for at in places for one in at.iterdir() if one.name == name), None)
    kind = _TYPES.get(name.rpartition(".")[2])
    if file is None or kind is None:
        return Response("there is no such file", 404)
    return Response(file.read_bytes(), media_type=kind, headers=HEADERS)


def _check_reach(host: str, *, allow_remote: bool) -> None:
    """Refuses an address that other machines can reach, unless that is allowed."""
    try:
        is_local = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        raise InvalidInput(f"host {host!r} is no address; give one, such as 127.0.0.1") from None
    if not is_local and not allow_remote:
        raise InvalidInput(
            f"at {host} any machine on the network could open the page; serve it at 127.0.0.1, "
            "or on a network you trust allow it with --allow-remote"
        )


def _own_names(*, allow_remote: bool) -> set[str]:
    """Further names of this machine by which others may address it."""
    return {socket.gethostname().lower(), socket.getfqdn().lower()} if allow_remote else set()
