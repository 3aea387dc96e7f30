"""Server of a page for browsers of this machine, with notice of changes. Nothing can be changed through it."""

import asyncio
import socket
import threading
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from dashboards.system.ports import HOST, NAME
from dashboards.untrusted_text import visible_lines
from dashboards.web.document import Page, body, document, missing_library, script
from dashboards.web.match_links import MatchLinks, RecordedMatch
from storage.errors import StorageError

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

POLL_SECONDS = 0.5  # between two checks of the version
KEEPALIVE_SECONDS = 15.0  # between messages on an open connection without changes
SHUTDOWN_SECONDS = 2  # time for open connections when the server stops
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; connect-src 'self';"
    " img-src data: blob:; media-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin", "Cache-Control": "no-store",
}  # fmt: skip


def serve(
    listener: socket.socket, version: Callable[[], str], read: Callable[[], Page],
    found: Callable[[int], RecordedMatch], film: Callable[[str], Path | None],
) -> None:  # fmt: skip
    """Answer requests until the process is told to stop.

    Args:
        listener: the socket to serve, see `dashboards.system.ports.listen`.
        version: returns a value that changes whenever the page does. May raise StorageError, while the store cannot be
            read.
        read: returns the current page.
        found: returns the recording of a match, by its number, and its players.
        film: returns the file of a film on the page, by its name. All four are called in threads.

    Raises:
        ViewerError: Starlette, uvicorn or Plotly is not installed.
    """
    try:
        import uvicorn
    except ImportError as error:
        raise missing_library("uvicorn", error) from error
    script("plotly.js")  # otherwise its absence would only show at a browser's request
    server: uvicorn.Server | None = None
    matches = MatchLinks(found, listener.getsockname()[1])
    app = application(version, read, matches, film, lambda: server is not None and server.should_exit)
    config = uvicorn.Config(
        app, log_level="warning", access_log=False, lifespan="off", server_header=False, headers=[("Server", NAME)],
        timeout_graceful_shutdown=SHUTDOWN_SECONDS,
    )  # fmt: skip
    server = uvicorn.Server(config)
    try:
        server.run(sockets=[listener])
    finally:
        matches.close()


def application(
    version: Callable[[], str], read: Callable[[], Page], matches: MatchLinks, film: Callable[[str], Path | None],
    stopping: Callable[[], bool],
) -> "Starlette":  # fmt: skip
    """Return the server's routes: the page at `/`, its newer content at `/main`, change events at `/events`, films, and
    matches.

    Raises ViewerError where Starlette is not installed.
    """
    try:
        from starlette.applications import Starlette
        from starlette.concurrency import run_in_threadpool
        from starlette.middleware import Middleware
        from starlette.middleware.trustedhost import TrustedHostMiddleware
        from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response, StreamingResponse
        from starlette.routing import Route
    except ImportError as error:
        raise missing_library("starlette", error) from error
    newest = _Newest(version, read)

    async def whole(_: "Request") -> "Response":
        return HTMLResponse(document(await run_in_threadpool(newest.page), live=True), headers=HEADERS)

    async def main(_: "Request") -> "Response":
        page = await run_in_threadpool(newest.page)
        title = quote(visible_lines(page.title))  # headers have no letters beyond Latin-1
        shown = {"X-Version": page.version, "X-Title": title}
        return HTMLResponse(body(page.sections), headers={**HEADERS, **shown})

    async def events(_: "Request") -> "Response":
        async def look() -> tuple[str, str]:
            try:
                return "revision", await run_in_threadpool(version)
            except StorageError as error:
                return "trouble", " ".join(str(error).split())

        return StreamingResponse(_events(look, stopping), media_type="text/event-stream", headers=HEADERS)

    async def file(name: str, _: "Request") -> "Response":
        return Response(script(name), media_type="text/javascript", headers=HEADERS)

    async def moving(request: "Request") -> "Response":
        path = await run_in_threadpool(film, request.path_params["name"])
        if path is None or not path.is_file():
            return PlainTextResponse("There is no such film.\n", 404, headers=HEADERS)
        return FileResponse(path, media_type="video/webm", headers=HEADERS)  # in parts, as players ask for it

    async def away(_: "Request", error: Exception) -> "Response":
        return PlainTextResponse(f"{error}\n", 503, headers=HEADERS)

    routes = [Route("/", whole), Route("/main", main), Route("/events", events), Route("/film/{name}", moving)]
    routes += [Route(f"/{name}", partial(file, name)) for name in ("page.js", "plotly.js")]
    routes += matches.routes(HEADERS)
    # A foreign host name may resolve to this machine: such a page must not read this one.
    ours = Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])
    return Starlette(routes=routes, middleware=[ours], exception_handlers={StorageError: away})


class _Newest:
    """The page, read once for each version, however many clients ask for it."""

    def __init__(self, version: Callable[[], str], read: Callable[[], Page]):
        self._version, self._read = version, read
        self._lock = threading.Lock()
        self._page: Page | None = None

    def page(self) -> Page:
        with self._lock:
            if self._page is None or self._page.version != self._version():
                self._page = self._read()
            return self._page


async def _events(look: Callable, stopping: Callable[[], bool]) -> AsyncIterator[str]:
    """Yield changes as server-sent events; the first event has the current state."""
    sent, silent = None, 0.0
    while not stopping():
        seen = await look()
        if seen != sent:
            kind, value = sent = seen
            silent = 0.0
            yield f"event: {kind}\ndata: {value}\n\n"
        elif silent >= KEEPALIVE_SECONDS:
            silent = 0.0
            yield ": nothing new\n\n"
        await asyncio.sleep(POLL_SECONDS)
        silent += POLL_SECONDS
