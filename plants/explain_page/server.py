"""The server of the page: every request needs its key, for it reads files of this machine."""

import secrets
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from estune.errors import EstuneError, InvalidInput
from estune.support.file_limits import parse_json
from estune.web.http_service import HEADERS, HttpService, body_of
from plants.explain_page.workbook import REPORT, Workbook, form

FOLDERS = (
    ("plants.explain_page", "static"),
    ("estune.web", "static"),
    ("estune.support", "charts"),
)
"""Folders of the page's files, by package."""
REQUEST_MAX_BYTES = 100_000
_REPORT_HEADERS = HEADERS | {
    # A report has its style and its figures inside; it needs no more than that.
    "Content-Security-Policy": "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "frame-ancestors 'self'; sandbox allow-downloads allow-popups"
}

Act = Callable[[Workbook, dict[str, Any]], None]


def _stop(workbook: Workbook, _given: dict[str, Any]) -> None:
    workbook.search.stop()


ACTS: dict[str, Act] = {
    "folder": lambda workbook, given: workbook.use(str(given.get("path", ""))),
    "clear": lambda workbook, _given: workbook.remove_files(),
    "columns": lambda workbook, given: workbook.map_columns(given.get("columns") or {}),
    "model": lambda workbook, given: workbook.use_model(
        toml=str(given.get("toml") or ""), reference=str(given.get("reference") or "")
    ),
    "begin": lambda workbook, _given: workbook.begin(),
    "stop": _stop,
}
"""What the page may ask for, by name."""


class ExplainPage:
    """Serves the page of a workbook from a thread of its own until `close`.

    Attributes:
        address: Address of the page, with its key.
    """

    def __init__(self, workbook: Workbook, port: int = 0) -> None:
        """Listens on this machine alone; port 0 takes a free one.

        Raises:
            InvalidInput: the port is taken.
        """
        self._workbook = workbook
        self._report = secrets.token_urlsafe(16)
        routes = [
            Route("/api/file/{name}", self._file, methods=["POST"]),
            Route("/api/act/{name}", self._act, methods=["POST"]),
            Route("/api/form", self._reading(form)),
            Route("/api/records", self._reading(workbook.understood)),
            Route("/api/state", self._reading(self._state)),
            Route(f"/report/{self._report}", self._shown_report),
        ]
        self._http = HttpService(routes, FOLDERS, index="explain.html", port=port, with_key=True)
        self.address = self._http.address

    def close(self) -> None:
        """Stops a search under way, and the server."""
        self._workbook.search.stop()
        self._http.close()

    def _state(self) -> dict[str, Any]:
        workbook = self._workbook
        given = {"model": workbook.model, "data": workbook.data and str(workbook.data)}
        return workbook.state() | given | {"report": f"report/{self._report}"}

    def _reading(self, read: Callable[[], Any]) -> Callable[[Request], Awaitable[Response]]:
        async def answer(request: Request) -> Response:
            return await self._answered(request, lambda: run_in_threadpool(read))

        return answer

    async def _act(self, request: Request) -> Response:
        async def act() -> Any:
            try:
                given = parse_json(await body_of(request, REQUEST_MAX_BYTES) or b"{}")
                name = ACTS[request.path_params["name"]]
            except (ValueError, KeyError) as error:
                raise InvalidInput(f"the request cannot be used: {error}") from error
            await run_in_threadpool(name, self._workbook, given)
            return {}

        return await self._answered(request, act)

    async def _file(self, request: Request) -> Response:
        async def store() -> Any:
            path = self._workbook.file_for(request.path_params["name"])
            await _write(request, path, self._workbook.room_bytes())
            return {}

        return await self._answered(request, store)

    async def _answered(self, request: Request, answer: Callable[[], Awaitable[Any]]) -> Response:
        """The answer to a request with the key; a mistake as a sentence."""
        if not self._http.allows(request):
            sentence = "open the page by the address that was printed, with its key"
            return JSONResponse({"error": sentence}, 403, headers=HEADERS)
        try:
            return JSONResponse(await answer(), headers=HEADERS)
        except EstuneError as error:
            return JSONResponse({"error": str(error)}, headers=HEADERS)

    async def _shown_report(self, _request: Request) -> Response:
        path = self._workbook.folder / REPORT
        if not path.exists():
            return Response("there is no report yet", 404)
        return Response(path.read_bytes(), media_type="text/html", headers=_REPORT_HEADERS)


async def _write(request: Request, path: Path, most_bytes: int) -> None:
    """Writes the body of a request as a file, whole or not at all."""
    partial = path.with_name(f".{path.name}.part")
    written = 0
    try:
        with partial.open("wb") as file:
            async for part in request.stream():
                written += len(part)
                if written > most_bytes:
                    raise InvalidInput(
                        f"{path.name} is larger than the {most_bytes / 1e6:.0f} MB that the page "
                        "takes; open its folder by its path instead"
                    )
                file.write(part)
        partial.replace(path)
    except OSError as error:
        raise InvalidInput(f"{path} cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
