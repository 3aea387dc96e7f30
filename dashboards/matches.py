"""A page's matches in rerun's viewer: each is converted when it is asked for, and the first one starts the viewer.

The viewer is rerun's own page, served by a process of its own on another port of this machine, which holds no match: it
fetches the one that its address names from the page's server, which lets that one origin read it and no other.
"""

import tempfile
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from dashboards.cast import Performer
from dashboards.errors import ViewerError
from storage.errors import StorageError
from storage.recording import Recording

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route

Found = tuple[Recording, tuple[Performer, ...]]
OTHERS = ("cross-site",)
"""Who a browser says has asked, when a page that is none of this machine's did: it could have matches converted."""

LONG = 16  # digits that no match's number has


class Matches:
    """Answers at `/match/7`, which leads to the viewer, and at `/match/7.rrd`, which is what that one draws.

    `found` gives what was recorded of a match, by its number; it raises StorageError where there is nothing to show.
    """

    def __init__(self, found: Callable[[int], Found]):
        self._found, self._lock, self._open = found, threading.Lock(), ExitStack()
        self._viewer: tuple[str, Callable[[], bool]] | None = None  # its address, and whether it is still there

    def close(self) -> None:
        """End the viewer, if there is one."""
        with self._lock:
            self._open.close()
            self._viewer = None

    def address(self, page: str, number: int) -> str:
        """Where the viewer shows a match of the server at `page`. Raises ViewerError, StorageError."""
        self._found(number)  # what there is not is told here, and not by the viewer
        return f"{self._served()}/?url={quote(f'{page}match/{number}.rrd', safe='')}&theme=dark&hide_welcome_screen"

    def converted(self, number: int) -> bytes:
        """A match as rerun's file. Raises ViewerError, StorageError."""
        from dashboards.viewer import write_rrd

        recording, cast = self._found(number)
        with tempfile.TemporaryDirectory(prefix="robot-league-match-") as folder:
            path = Path(folder, "match.rrd")
            write_rrd(recording, path, cast)
            return path.read_bytes()

    @property
    def origin(self) -> str | None:
        """The viewer's, as browsers call it."""
        return self._viewer and self._viewer[0]

    def _served(self) -> str:
        from dashboards.viewer import web_viewer

        with self._lock:
            if self._viewer is None or not self._viewer[1]():
                self._open.close()
                self._viewer = self._open.enter_context(web_viewer())
            return self._viewer[0]

    def routes(self, headers: dict[str, str]) -> "list[Route]":
        """The answers; `headers` go with each of them."""
        from starlette.concurrency import run_in_threadpool
        from starlette.responses import PlainTextResponse, RedirectResponse, Response
        from starlette.routing import Route

        async def answered(request: "Request", made: Callable[[int], "Response"]) -> "Response":
            if request.headers.get("Sec-Fetch-Site") in OTHERS:
                return PlainTextResponse("Another site's page asks for this.\n", 403, headers=headers)
            number = request.path_params["number"]
            if not (number.isascii() and number.isdigit() and len(number) < LONG):
                return PlainTextResponse("A match has a number.\n", 404, headers=headers)
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
                data = self.converted(number)
                return Response(data, media_type="application/octet-stream", headers={**headers, **mine})

            return await answered(request, made)

        return [Route("/match/{number}.rrd", file), Route("/match/{number}", shown)]
