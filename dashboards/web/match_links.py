"""A page's matches in rerun's viewer: each is converted on request, and the first request starts the viewer.

The viewer is rerun's own page, served by a separate process on another port of this machine, which holds no match. It
fetches the match that its address names from the page's server, which lets only that origin read it.
"""

import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING
from urllib.parse import quote

from dashboards.errors import ViewerError
from dashboards.identity import MatchPlayer
from dashboards.system.ports import next_port
from dashboards.system.temporary_folders import temporary_folder
from storage.errors import StorageError
from storage.recordings.recording import Recording

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route

RecordedMatch = tuple[Recording, tuple[MatchPlayer, ...]]
FOREIGN_SITES = ("cross-site",)
"""Values of Sec-Fetch-Site for requests by pages of other sites, which are refused: each would start a conversion."""

MAX_DIGITS = 16  # match numbers have fewer digits


class MatchLinks:
    """Answers at `/match/7`, which redirects to the viewer, and at `/match/7.rrd`, which the viewer draws.

    `found` returns the recording of a match by its number. It raises StorageError where there is nothing to show.
    `port` is that of the page; the viewer has the next one.
    """

    def __init__(self, found: Callable[[int], RecordedMatch], port: int):
        self._port = port
        self._found, self._lock, self._open = found, threading.Lock(), ExitStack()
        self._viewer: tuple[str, Callable[[], bool]] | None = None  # its address, and a check that it still runs

    def close(self) -> None:
        """End the viewer, if there is one."""
        with self._lock:
            self._open.close()
            self._viewer = None

    def address(self, page: str, number: int) -> str:
        """Return the viewer's address for a match of the server at `page`. Raises ViewerError, StorageError."""
        self._found(number)  # a missing match is reported here, not by the viewer
        file = quote(f"{page}match/{number}.rrd", safe="")
        return f"{self._viewer_address()}/?url={file}&theme=dark&hide_welcome_screen"

    def as_rrd(self, number: int) -> bytes:
        """Return a match as the bytes of rerun's file. Raises ViewerError, StorageError."""
        from dashboards.viewer import write_rrd

        recording, players = self._found(number)
        with temporary_folder("robot-league-match-") as folder:
            path = folder / "match.rrd"
            write_rrd(recording, path, players)
            return path.read_bytes()

    @property
    def origin(self) -> str | None:
        """The viewer's origin, as browsers name it; None before its start."""
        return self._viewer and self._viewer[0]

    def _viewer_address(self) -> str:
        from dashboards.viewer import web_viewer

        with self._lock:
            if self._viewer is None or not self._viewer[1]():
                self._open.close()
                self._viewer = self._open.enter_context(web_viewer(next_port(self._port)))
            return self._viewer[0]

    def routes(self, headers: dict[str, str]) -> "list[Route]":
        """Return the routes; `headers` are added to each answer."""
        from starlette.concurrency import run_in_threadpool
        from starlette.responses import PlainTextResponse, RedirectResponse, Response
        from starlette.routing import Route

        async def answered(request: "Request", made: Callable[[int], "Response"]) -> "Response":
            if request.headers.get("Sec-Fetch-Site") in FOREIGN_SITES:
                return PlainTextResponse("The request comes from another site's page.\n", 403, headers=headers)
            number = request.path_params["number"]
            if not (number.isascii() and number.isdigit() and len(number) < MAX_DIGITS):
                return PlainTextResponse("A match is given by its number.\n", 404, headers=headers)
            try:
                return await run_in_threadpool(made, int(number))
            except (StorageError, ViewerError) as error:
                return PlainTextResponse(f"{error}\n", 404, headers=headers)

        async def shown(request: "Request") -> "Response":
            page = str(request.base_url)
            return await answered(
                request, lambda number: RedirectResponse(self.address(page, number), 303, headers=headers)
            )

        async def file(request: "Request") -> "Response":
            def made(number: int) -> "Response":
                mine = {"Access-Control-Allow-Origin": self.origin} if self.origin else {}
                data = self.as_rrd(number)
                return Response(data, media_type="application/octet-stream", headers={**headers, **mine})

            return await answered(request, made)

        return [Route("/match/{number}.rrd", file), Route("/match/{number}", shown)]
