"""Serves a page to browsers of this machine and tells them when it has changed. Nothing can be changed through it."""

import asyncio
import http.client
import socket
import threading
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import TYPE_CHECKING

from dashboards.errors import ViewerError
from dashboards.matches import Found, Matches
from dashboards.page import Page, body, document, missing, script
from storage.errors import StorageError

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

HOST = "127.0.0.1"
NAME = "robot-league"  # as the server calls itself
LOOK = 0.5  # seconds between two looks at the version
SILENT = 15.0  # seconds after which an open connection is told that nothing has happened
LEAVE = 2  # seconds that open connections are given when the server stops
NEAR = 100  # ports after a taken one that are tried
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; connect-src 'self';"
    " img-src data: blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store",
}  # fmt: skip


def bound(port: int) -> socket.socket:
    """A socket on a port of this machine that no other can reach.

    Raises ViewerError where it is taken, with who has it as far as that can be told, and the next that is free.
    """
    try:
        return _bound(port)
    except PermissionError as error:
        raise ViewerError(f"this user may not listen on port {port}: give one above 1023, as in --port 8710") from error
    except OSError as error:
        free = next((near for near in range(port + 1, min(port + NEAR, 65_536)) if _is_free(near)), None)
        advice = f"port {free} is free: --port {free}" if free else "give another with --port"
        raise ViewerError(f"port {port} is taken{_holder(port)}; {advice}") from error


def serve(
    listener: socket.socket, version: Callable[[], str], read: Callable[[], Page], found: Callable[[int], Found]
) -> None:  # fmt: skip
    """Answer until the process is told to stop.

    Args:
        listener: where to, see `bound`.
        version: what changes whenever the page does. May raise StorageError, while the store cannot be read.
        read: the page as it is now.
        found: what was recorded of a match, by its number, and who played. All are called in threads.

    Raises:
        ViewerError: Starlette, uvicorn or Plotly is not installed.
    """
    try:
        import uvicorn
    except ImportError as error:
        raise missing("uvicorn", error) from error
    script("plotly.js")  # or it would be missed only when a browser asks for it
    server: uvicorn.Server | None = None
    matches = Matches(found)
    app = application(version, read, matches, lambda: server is not None and server.should_exit)
    config = uvicorn.Config(
        app, log_level="warning", access_log=False, lifespan="off", server_header=False, headers=[("Server", NAME)],
        timeout_graceful_shutdown=LEAVE,
    )  # fmt: skip
    server = uvicorn.Server(config)
    try:
        server.run(sockets=[listener])
    finally:
        matches.close()


def application(
    version: Callable[[], str], read: Callable[[], Page], matches: Matches, stopping: Callable[[], bool]
) -> "Starlette":  # fmt: skip
    """The server's answers: the page at `/`, its newer content at `/main`, at `/events` when there is any, and matches.

    Raises ViewerError where Starlette is not installed.
    """
    try:
        from starlette.applications import Starlette
        from starlette.concurrency import run_in_threadpool
        from starlette.middleware import Middleware
        from starlette.middleware.trustedhost import TrustedHostMiddleware
        from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
        from starlette.routing import Route
    except ImportError as error:
        raise missing("starlette", error) from error
    newest = _Newest(version, read)

    async def whole(_: "Request") -> "Response":
        return HTMLResponse(document(await run_in_threadpool(newest.page), live=True), headers=HEADERS)

    async def main(_: "Request") -> "Response":
        page = await run_in_threadpool(newest.page)
        return HTMLResponse(body(page.sections), headers={**HEADERS, "X-Version": page.version})

    async def events(_: "Request") -> "Response":
        async def look() -> tuple[str, str]:
            try:
                return "revision", await run_in_threadpool(version)
            except StorageError as error:
                return "trouble", " ".join(str(error).split())

        return StreamingResponse(_events(look, stopping), media_type="text/event-stream", headers=HEADERS)

    async def file(name: str, _: "Request") -> "Response":
        return Response(script(name), media_type="text/javascript", headers=HEADERS)

    async def away(_: "Request", error: Exception) -> "Response":
        return PlainTextResponse(f"{error}\n", 503, headers=HEADERS)

    routes = [Route("/", whole), Route("/main", main), Route("/events", events)]
    routes += [Route(f"/{name}", partial(file, name)) for name in ("page.js", "plotly.js")]
    routes += matches.routes(HEADERS)
    # A name that somebody else lets point to this machine is none of ours: their page must not read this one.
    ours = Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])
    return Starlette(routes=routes, middleware=[ours], exception_handlers={StorageError: away})


class _Newest:
    """The page, read once for each version, however many ask for it."""

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
    """What is new, as server-sent events; first how it is."""
    told, silent = None, 0.0
    while not stopping():
        seen = await look()
        if seen != told:
            kind, value = told = seen
            silent = 0.0
            yield f"event: {kind}\ndata: {value}\n\n"
        elif silent >= SILENT:
            silent = 0.0
            yield ": nothing new\n\n"
        await asyncio.sleep(LOOK)
        silent += LOOK


def _bound(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # at once after one that has just ended
        listener.bind((HOST, port))
        listener.listen()  # only now is it known that nobody else does
    except OSError:
        listener.close()
        raise
    return listener


def _is_free(port: int) -> bool:
    try:
        _bound(port).close()
    except OSError:
        return False
    return True


def _holder(port: int) -> str:
    """By whom a port is taken, where that can be told by asking it."""
    connection = http.client.HTTPConnection(HOST, port, timeout=1)
    try:
        connection.request("GET", "/page.js")
        ours = connection.getresponse().headers.get("Server") == NAME
    except (OSError, http.client.HTTPException):
        return ""
    finally:
        connection.close()
    return " by another league dash" if ours else " by another web server"
