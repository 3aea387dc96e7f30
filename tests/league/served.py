"""`league dash` as a process of its own, for tests."""

import http.client
import signal
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from email.message import Message
from pathlib import Path
from typing import NamedTuple

from tests.league.conftest import start
from tests.markup import Markup


class Answer(NamedTuple):
    status: int
    headers: Message
    body: str


def _events(stream: http.client.HTTPResponse) -> Iterator[tuple[str, str]]:
    kind = ""
    while line := stream.readline().decode():
        key, _, value = line.strip().partition(": ")
        if key == "event":
            kind = value
        elif key == "data":
            yield kind, value


class Served:
    """A server that runs until it is stopped."""

    def __init__(self, folder: Path, port: int, *args: str):
        self.folder, self.port, self.args = folder, port, args
        self.begin()

    def begin(self) -> None:
        """Start it, and wait until it says where it is."""
        said = self.folder / "out.txt"
        before = len(said.read_text()) if said.exists() else 0
        self.process = start("dash", "--port", str(self.port), *self.args, cwd=self.folder)
        deadline = time.monotonic() + 60
        while f":{self.port}/" not in said.read_text()[before:]:
            assert self.process.poll() is None, said.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def ask(self, path: str, method: str = "GET", encoding: str = "utf-8", **headers: str) -> Answer:
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)) as connection:
            connection.request(method, path, headers=headers)
            answer = connection.getresponse()
            return Answer(answer.status, answer.headers, answer.read().decode(encoding))

    def page(self, path: str = "/") -> Markup:
        answer = self.ask(path)
        assert answer.status == 200
        return Markup(answer.body)

    @contextmanager
    def events(self) -> Iterator[Iterator[tuple[str, str]]]:
        """Server-sent events as they come, kind and data."""
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)) as connection:
            connection.request("GET", "/events")
            with connection.getresponse() as stream:
                assert stream.headers["Content-Type"].startswith("text/event-stream")
                yield _events(stream)

    def kill(self) -> None:
        """End it as a crash would."""
        self.process.kill()
        self.process.wait()

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(30)
