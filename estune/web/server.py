"""HTTP server of the live page: static files, events, and commands where they are allowed."""

import asyncio
import hmac
import json
import math
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator
from functools import partial
from importlib.resources import files
from ipaddress import ip_address
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from estune.errors import EstuneError, InvalidInput
from estune.support.user import user_at_host
from estune.web.board import Seen, to_json
from estune.web.rig_actions import form
from estune.web.views import View, Views

UPDATE_S = 0.1
"""Interval at which a page is sent what has changed."""
BEAT_S = 0.5
"""Interval at which a page is told that the server is there, and the age of the data."""
LIST_S = 2.0
"""Age up to which one list of views serves all pages, of which each asks every 3 s."""
PAGES_MAX = 100
"""Pages open at a time; browsers that were left behind are refused beyond it."""
COMMAND_MAX_BYTES = 4096
_LOCAL = ("127.0.0.1", "::1")
_END_WITHIN_S = 5.0

_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
FOLDERS = (
    ("estune.web", "static"),
    ("estune.support", "charts"),
    ("estune.loop_model", "browser"),
)
"""Folders of the page's files, by package."""
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class PageServer:
    """Serves the page from a thread of its own until `close`.

    Attributes:
        port: The port.
        address: Address of the page, with the key that commands need where they are allowed.
    """

    def __init__(
        self,
        views: Views,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        may_command: bool = False,
        allow_remote: bool = False,
    ) -> None:
        """Listens; port 0 takes a free one.

        Raises:
            InvalidInput: the port is taken, or other machines could open the page.
        """
        _check_reach(host, allow_remote=allow_remote)
        try:
            self._socket = socket.create_server(
                (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
            )
        except OSError as error:
            raise InvalidInput(
                f"the page cannot be served on port {port} of {host}: {error.strerror}; choose "
                "another --port; 0 takes a free one"
            ) from error
        self.port = self._socket.getsockname()[1]
        self._views = views
        self._key = secrets.token_urlsafe(16) if may_command else ""
        self._pages = 0
        self._listing = threading.Lock()
        self._list_made = -math.inf, ""
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self.port}/" + (f"#key={self._key}" if self._key else "")
        names = {shown, "localhost", "127.0.0.1", "[::1]", *_own_names(allow_remote=allow_remote)}
        app = _Guard(self._app(), frozenset(f"{name}:{self.port}" for name in names))
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
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

    def close(self) -> None:
        """Ends all pages' connections and releases the port."""
        self._server.should_exit = True
        self._thread.join(_END_WITHIN_S)
        self._socket.close()
        for view in self._views():
            view.close()

    def _app(self) -> Starlette:
        return Starlette(
            routes=[
                Route("/", partial(_static, "index.html")),
                Route("/static/{name}", _named_static),
                Route("/api/views", self._list),
                Route("/api/events", self._events),
                Route("/api/tuning", self._tuning),
                Route("/api/form", _form),
                Route("/api/command", self._command, methods=["POST"]),
            ]
        )

    async def _list(self, _request: Request) -> Response:
        text = await run_in_threadpool(self._listed)
        return Response(text, media_type="application/json", headers=_HEADERS)

    def _listed(self) -> str:
        """The list as JSON, made at most once in `LIST_S` for all pages."""
        with self._listing:
            at_s, text = self._list_made
            if time.monotonic() - at_s < LIST_S:
                return text
            try:
                views = self._views()
                for view in views:
                    view.glance()
                text = to_json({"views": [_row(view) for view in views], "fault": ""})
            except EstuneError as error:
                text = to_json({"views": [], "fault": str(error)})
            self._list_made = time.monotonic(), text
            return text

    async def _view(self, name: str) -> View | None:
        views = await run_in_threadpool(self._views)
        return next((view for view in views if view.name == name), None)

    async def _events(self, request: Request) -> Response:
        view = await self._view(request.query_params.get("view", ""))
        if view is None:
            return Response("there is no such view", 404)
        if self._pages >= PAGES_MAX:
            return Response(f"{PAGES_MAX} pages are open already; close some", 503)
        view.look()
        return StreamingResponse(
            self._stream(view), media_type="text/event-stream", headers=_HEADERS
        )

    async def _tuning(self, request: Request) -> Response:
        view = await self._view(request.query_params.get("view", ""))
        if view is None:
            return Response("there is no such view", 404)
        text = await run_in_threadpool(view.tuning.text)
        return Response(text, media_type="application/json", headers=_HEADERS)

    async def _stream(self, view: View) -> AsyncIterator[str]:
        """Server-sent events: what changed, and a beat with the age of the data."""
        self._pages += 1
        try:
            seen, waited_s = Seen(), BEAT_S
            allowed = sorted(view.commands) if self._key else []
            yield f"event: hello\ndata: {to_json({'kind': view.kind, 'commands': allowed})}\n\n"
            while not self._server.should_exit:
                text, seen = view.board.changes(seen)
                if text:
                    yield f"data: {text}\n\n"
                if waited_s >= BEAT_S:
                    waited_s = 0.0
                    view.look()
                    yield f"event: beat\ndata: {to_json(view.board.ages())}\n\n"
                await asyncio.sleep(UPDATE_S)
                waited_s += UPDATE_S
        finally:
            self._pages -= 1

    async def _command(self, request: Request) -> Response:
        """Executes a command; its effect is shown by the state of the rig alone."""
        token = request.headers.get("authorization", "").removeprefix("Bearer ")
        if not self._key or not hmac.compare_digest(token.encode(), self._key.encode()):
            sentence = "this page may not command; start it with --allow-commands"
            return JSONResponse({"done": False, "sentence": sentence}, 403, headers=_HEADERS)
        try:
            asked = json.loads(await _body(request))
            view = await self._view(asked["view"])
            execute = view.commands[asked["command"]] if view is not None else None
            given = asked.get("arguments") or {}
        except (ValueError, KeyError, TypeError, AttributeError):
            execute, given = None, {}
        if execute is None:
            sentence = "there is no such command"
            return JSONResponse({"done": False, "sentence": sentence}, 400, headers=_HEADERS)
        try:
            client = request.client.host if request.client else "unknown"
            name = client if client not in _LOCAL else user_at_host()
            sentence = await run_in_threadpool(execute, f"{name} on the live page", given)
        except EstuneError as error:
            return JSONResponse({"done": False, "sentence": str(error)}, 409, headers=_HEADERS)
        return JSONResponse({"done": True, "sentence": sentence}, headers=_HEADERS)


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
        """Answers one request."""
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


async def _body(request: Request) -> bytes:
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > COMMAND_MAX_BYTES:
            raise ValueError("the command is too long")
    return body


async def _static(name: str, _request: Request) -> Response:
    content = _content(name)
    if content is None:
        return Response("there is no such file", 404)
    kind = _TYPES[name.rpartition(".")[2]]
    return Response(content, media_type=kind, headers=_HEADERS)


async def _form(_request: Request) -> Response:
    return JSONResponse(form(), headers=_HEADERS)


async def _named_static(request: Request) -> Response:
    return await _static(request.path_params["name"], request)


def _content(name: str) -> bytes | None:
    """A file of the page; None if there is none of that name."""
    folders = (files(package).joinpath(folder) for package, folder in FOLDERS)
    file = next((one for at in folders for one in at.iterdir() if one.name == name), None)
    return None if file is None or name.rpartition(".")[2] not in _TYPES else file.read_bytes()


def _row(view: View) -> dict[str, Any]:
    """A view in the list; the state of a rig is known once it has been looked at."""
    row = {"name": view.name, "kind": view.kind, "state": ""} | view.summary()
    daemon, rig = view.board.get("daemon"), view.board.get("rig")
    if daemon is not None:
        row["state"] = f"{daemon['mode']}, {daemon['live'] or 'unknown'} gains live"
    elif view.kind == "rig" and rig is not None:
        row["state"] = str(rig["mode"])
    return row


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
