"""A proxy before an S3 server that answers as a bad server or network does: late, never, wrongly, not at all, or stale.

It runs in a thread of the process that uses it. Requests pass unchanged, so that their signatures stay valid.
"""

import asyncio
import random
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any

from aiohttp import ClientSession, TCPConnector, web
from yarl import URL

ERROR = '<?xml version="1.0" encoding="UTF-8"?><Error><Code>{code}</Code><Message>an injected fault</Message></Error>'
HOP = {"transfer-encoding", "connection", "keep-alive", "expect", "content-length"}
PIECE = 1 << 14
_OBJECT = re.compile(rb"<Contents>.*?<Key>(.*?)</Key>.*?</Contents>", re.DOTALL)


@dataclass
class Faults:
    """Faults of requests. A fault strikes `share` of the requests that it fits."""

    share: float = 1.0
    late: float = 0.0  # seconds before the server is asked
    status: int = 0  # an error in place of an answer, and with `after` the server has done what was asked
    code: str = "InternalError"
    after: bool = False
    silent: bool = False  # never answer
    cut: str = ""  # disconnect amid the body of an "upload" or a "download"
    damage: str = ""  # a body that is "shorter" or "changed", as if nothing had happened
    stale: float = 0.0  # seconds for which the state before a write is shown
    rate: float = 0.0  # bytes per second of a body
    limit: float = 0.0  # requests per second, then 503 SlowDown
    only: str = ""  # a method; "": all
    times: int = 0  # only the first so many requests that it fits; 0: all
    done: int = 0  # times that it has happened


@dataclass
class Answer:
    """An answer of the server."""

    status: int
    headers: dict[str, str]
    body: bytes


@dataclass
class Proxy:
    """A proxy to `server` (http://host:port); its own address is `url` while it runs."""

    server: str
    faults: Faults = field(default_factory=Faults)
    seed: int = 0
    url: str = ""
    requests: Counter[str] = field(default_factory=Counter)  # by method, and by the faults that were injected

    def __post_init__(self) -> None:
        """Prepare what it remembers."""
        self._rng, self._shown, self._hidden = random.Random(self.seed), dict[str, Answer](), dict[str, float]()
        self._times: list[float] = []

    def __enter__(self) -> "Proxy":
        """Start it."""
        self._loop, ready = asyncio.new_event_loop(), threading.Event()
        self._thread = threading.Thread(target=self._run, args=(ready,), daemon=True)
        self._thread.start()
        ready.wait()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop it, and disconnect all clients."""
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()

    def _run(self, ready: threading.Event) -> None:
        self._loop.run_until_complete(self._serve(ready))
        self._loop.close()

    async def _serve(self, ready: threading.Event) -> None:
        self._ended = asyncio.Event()
        async with ClientSession(auto_decompress=False, connector=TCPConnector(limit=0)) as self._client:
            runner = web.AppRunner(_application(self._handle), access_log=None, shutdown_timeout=0.1)
            await runner.setup()
            site = web.TCPSite(runner, "127.0.0.1", 0)
            await site.start()
            self.url = f"http://127.0.0.1:{runner.addresses[0][1]}"
            ready.set()
            await self._ended.wait()
            await runner.cleanup()

    # One request ------------------------------------------------------------------------------------------------------

    async def _handle(self, request: web.Request) -> web.StreamResponse:
        faults = self.faults
        self.requests[request.method] += 1
        if not self._hits(faults, request.method):
            return await self._send(request, await self._asked(request, await request.read(), 0.0), Faults())
        await asyncio.sleep(faults.late)
        if faults.silent:
            self.requests["silent"] += 1
            await self._ended.wait()
            return self._disconnect(request, web.Response())
        if faults.limit and self._too_many(faults.limit):
            return self._error(503, "SlowDown")
        body = await _body(request, faults)
        if body is None:
            return self._disconnect(request, web.Response())
        if faults.status and not faults.after:
            return self._error(faults.status, faults.code)
        answer = await self._asked(request, body, faults.stale)
        if faults.status:
            return self._error(faults.status, faults.code)
        return await self._send(request, answer, faults)

    def _hits(self, faults: Faults, method: str) -> bool:
        fits = faults.only in ("", method) and (not faults.times or faults.done < faults.times)
        hit = fits and self._rng.random() < faults.share
        faults.done += hit
        return hit

    def _error(self, status: int, code: str) -> web.Response:
        self.requests[str(status)] += 1
        return web.Response(status=status, body=ERROR.format(code=code).encode(), content_type="application/xml")

    def _too_many(self, limit: float) -> bool:
        now = time.monotonic()
        self._times = [at for at in self._times if at > now - 1.0]
        if len(self._times) >= limit:
            return True
        self._times.append(now)
        return False

    def _disconnect(self, request: web.Request, response: web.StreamResponse) -> web.StreamResponse:
        self.requests["cut"] += 1
        if request.transport is not None:
            request.transport.abort()
        return response

    async def _asked(self, request: web.Request, body: bytes, stale: float) -> Answer:
        """Ask the server, unless the state before the last write is to be shown."""
        key, now = request.path, time.monotonic()
        if request.method in ("GET", "HEAD") and self._hidden.get(key, 0.0) > now:
            self.requests["stale"] += 1
            absent = Answer(404, {"Content-Type": "application/xml"}, ERROR.format(code="NoSuchKey").encode())
            return self._shown.get(f"{request.method} {key}", absent)
        headers = {name: value for name, value in request.headers.items() if name.lower() not in HOP}
        url = URL(self.server + request.raw_path, encoded=True)
        async with self._client.request(request.method, url, headers=headers, data=body or None) as found:
            kept = {n: v for n, v in found.headers.items() if n.lower() not in HOP - {"content-length"}}
            answer = Answer(found.status, kept, await found.read())
        if request.method == "PUT" and stale and answer.status < 300:
            self._hidden[key] = now + stale
        elif request.method in ("GET", "HEAD") and answer.status == 200:
            self._shown[f"{request.method} {key}"] = answer
        if request.method == "GET" and "list-type" in request.query:
            answer.body = _OBJECT.sub(lambda each: b"" if self._is_hidden(request, each[1]) else each[0], answer.body)
            answer.headers.pop("Content-Length", None)
        return answer

    def _is_hidden(self, request: web.Request, key: bytes) -> bool:
        bucket = request.path.strip("/").partition("/")[0]
        return self._hidden.get(f"/{bucket}/{key.decode()}", 0.0) > time.monotonic()

    async def _send(self, request: web.Request, answer: Answer, faults: Faults) -> web.StreamResponse:
        """Send an answer; a fault of downloads is for answers with a body."""
        body, fits = answer.body, request.method == "GET" and answer.status == 200 and len(answer.body) > 1
        if fits and faults.damage:
            self.requests[faults.damage] += 1
            answer.headers.pop("Content-Length", None)
            middle = len(body) // 2
            rest = bytes([body[middle] ^ 1]) + body[middle + 1 :] if faults.damage == "changed" else b""
            body = body[:middle] + rest
        response = web.StreamResponse(status=answer.status, headers=answer.headers)
        if request.method != "HEAD" and answer.status != 204:
            response.content_length = len(body)
        await response.prepare(request)
        if request.method == "HEAD" or answer.status == 204:
            return response
        if fits and faults.cut == "download":
            await response.write(body[: len(body) // 2])
            return self._disconnect(request, response)
        for at in range(0, len(body), PIECE):
            await response.write(piece := body[at : at + PIECE])
            await asyncio.sleep(len(piece) / faults.rate if faults.rate else 0.0)
        return response


async def _body(request: web.Request, faults: Faults) -> bytes | None:
    """Return a request's body; None where it is to be cut off in the middle."""
    body, size = bytearray(), request.content_length or 0
    while piece := await request.content.read(PIECE):
        body += piece
        await asyncio.sleep(len(piece) / faults.rate if faults.rate else 0.0)
        if faults.cut == "upload" and len(body) >= size / 2:
            return None
    return bytes(body)


def _application(handle: Callable[[web.Request], Coroutine[Any, Any, web.StreamResponse]]) -> web.Application:
    application = web.Application(client_max_size=1 << 30)
    application.router.add_route("*", "/{path:.*}", handle)
    return application
