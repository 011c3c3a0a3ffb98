"""The live page's server: the list of views, their changes as a stream, and commands."""

import asyncio
import hashlib
import math
import threading
import time
from collections.abc import AsyncIterator
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from estune.errors import EstuneError
from estune.remote.messages.rights import Right
from estune.support.file_limits import parse_json
from estune.support.user import user_at_host
from estune.web.board import Seen, to_json
from estune.web.daemon_reader import daemon_row
from estune.web.http_service import HEADERS, HttpService, body_of
from estune.web.tuning_form import FormFault
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

FOLDERS = (
    ("estune.web", "static"),
    ("estune.support", "charts"),
    ("estune.loop_model", "browser"),
)
"""Folders of the page's files, by package."""


class PageServer:
    """Serves the page from a thread of its own until `close`.

    Attributes:
        address: Address of the page, with the key that commands need where they are allowed.
    """

    def __init__(
        self,
        views: Views,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        right: Right = Right.LOOK,
        allow_remote: bool = False,
    ) -> None:
        """Listens; port 0 takes a free one.

        Raises:
            InvalidInput: the port is taken, or other machines could open the page.
        """
        self._views = views
        self._right = right
        self._pages = 0
        self._listing = threading.Lock()
        self._list_made = -math.inf, "", ""
        self._rows: dict[str, tuple[dict[str, Any], str]] = {}
        routes = [
            Route("/api/views", self._list),
            Route("/api/events", self._events),
            Route("/api/tuning", self._tuning),
            Route("/api/form", self._form),
            Route("/api/command", self._command, methods=["POST"]),
        ]
        self._http = HttpService(
            *(routes, FOLDERS),
            host=host,
            port=port,
            with_key=right is not Right.LOOK,
            allow_remote=allow_remote,
        )
        self.port, self.address = self._http.port, self._http.address

    def close(self) -> None:
        """Ends all pages' connections and releases the port."""
        self._http.close()
        for view in self._views():
            view.close()

    async def _list(self, request: Request) -> Response:
        """The list, unless the page has it."""
        text, tag = await run_in_threadpool(self._listed)
        headers = {**HEADERS, "ETag": tag}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        return Response(text, media_type="application/json", headers=headers)

    def _listed(self) -> tuple[str, str]:
        """The list as JSON with its digest, made at most once in `LIST_S` for all pages."""
        with self._listing:
            at_s, text, tag = self._list_made
            if time.monotonic() - at_s < LIST_S:
                return text, tag
            try:
                views = self._views()
                for view in views:
                    view.glance()
                made = [(view.name, self._row(view)) for view in views]
                self._rows = dict(made)
                rows = ",".join(row for _, (_, row) in made)
                text = f'{{"views":[{rows}],"fault":""}}'
            except EstuneError as error:
                text = to_json({"views": [], "fault": str(error)})
            tag = f'"{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}"'
            self._list_made = time.monotonic(), text, tag
            return text, tag

    def _row(self, view: View) -> tuple[dict[str, Any], str]:
        """What a view says of itself, and its row as JSON; made anew if that is another object."""
        summary = view.summary()
        known = self._rows.get(view.name)
        if view.kind == "run" and known is not None and known[0] is summary:
            return known
        return summary, to_json(_row(view, summary))

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
            self._stream(view), media_type="text/event-stream", headers=HEADERS
        )

    async def _tuning(self, request: Request) -> Response:
        view = await self._view(request.query_params.get("view", ""))
        if view is None:
            return Response("there is no such view", 404)
        text = await run_in_threadpool(view.tuning.text)
        return Response(text, media_type="application/json", headers=HEADERS)

    async def _form(self, request: Request) -> Response:
        view = await self._view(request.query_params.get("view", ""))
        if view is None:
            return Response("there is no such view", 404)
        return JSONResponse(await run_in_threadpool(view.form), headers=HEADERS)

    async def _stream(self, view: View) -> AsyncIterator[str]:
        """Server-sent events: what changed, and a beat with the age of the data."""
        self._pages += 1
        try:
            seen, waited_s = Seen(), BEAT_S
            yield f"event: hello\ndata: {to_json({'kind': view.kind})}\n\n"
            allowed: list[str] | None = None
            while not self._http.is_ending:
                if (now := view.allowed(self._right)) != allowed:
                    allowed = now
                    yield f"event: commands\ndata: {to_json(allowed)}\n\n"
                text, seen = view.changes(seen)
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
        if not self._http.allows(request):
            sentence = "this page may not command; start it with --allow-commands"
            return JSONResponse({"done": False, "sentence": sentence}, 403, headers=HEADERS)
        try:
            asked = parse_json(await body_of(request, COMMAND_MAX_BYTES))
            view = await self._view(asked["view"])
            name = asked["command"]
            allowed = view is not None and name in view.allowed(self._right)
            execute = view.commands[name] if view is not None and allowed else None
            given = asked.get("arguments") or {}
        except (ValueError, KeyError, TypeError, AttributeError):
            execute, given = None, {}
        if execute is None:
            sentence = "there is no such command, or this page has no right to it"
            return JSONResponse({"done": False, "sentence": sentence}, 400, headers=HEADERS)
        try:
            client = request.client.host if request.client else "unknown"
            name = client if client not in _LOCAL else user_at_host()
            sentence = await run_in_threadpool(execute, f"{name} on the live page", given)
        except EstuneError as error:
            fields = error.fields if isinstance(error, FormFault) else {}
            refused = {"done": False, "sentence": str(error), "fields": fields}
            return JSONResponse(refused, 409, headers=HEADERS)
        return JSONResponse({"done": True, "sentence": sentence}, headers=HEADERS)


def _row(view: View, summary: dict[str, Any]) -> dict[str, Any]:
    """A view in the list; the state of a rig is known once it has been looked at."""
    row = {"name": view.name, "kind": view.kind, "state": ""} | summary
    if view.kind == "run":
        return row
    rig, daemon = view.board.get("rig"), view.board.get("daemon")
    if daemon is not None:
        row |= daemon_row(daemon)
    elif rig is not None:
        row["state"] = str(rig["mode"])
    if view.gone or view.board.get(f"fault.{view.kind}"):
        row |= {"state": view.gone or "no link", "stale": True}
    return row
