"""The server of a page whose source comes and goes, over HTTP."""

import multiprocessing
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from dashboards.errors import ViewerError
from dashboards.system.ports import listen
from dashboards.web import server
from dashboards.web.document import Page
from dashboards.web.match_links import RecordedMatch
from storage.errors import StorageError


def serve(folder: Path, port: int) -> None:
    """A page whose version stands in a file; without the file its store is away."""

    def version() -> str:
        try:
            return (folder / "version").read_text()
        except FileNotFoundError:
            raise StorageError("The store is\naway.") from None

    def found(number: int) -> RecordedMatch:
        raise StorageError(f"There is no match {number}.")

    def film(name: str) -> Path | None:
        return folder / name if name == "cup.webm" else None

    server.serve(listen(port), version, lambda: Page("Cup", "", [], version()), found, film)


@pytest.fixture
def at(tmp_path) -> Iterator[str]:
    (tmp_path / "version").write_text("1")
    with listen(0) as listener:
        port = listener.getsockname()[1]
    process = multiprocessing.get_context("spawn").Process(target=serve, args=(tmp_path, port))
    process.start()
    address = f"http://127.0.0.1:{port}"
    try:
        while True:
            assert process.is_alive()
            try:
                urllib.request.urlopen(f"{address}/page.js").close()
                break
            except urllib.error.URLError:
                process.join(0.05)
        yield address
    finally:
        process.kill()
        process.join()


def test_a_store_that_is_away_is_told_and_waited_for(at, tmp_path):
    with urllib.request.urlopen(f"{at}/events", timeout=30) as stream:

        def event() -> list[str]:
            lines = [stream.readline().decode().strip() for _ in range(3)]
            assert lines.pop() == ""
            return lines

        assert event() == ["event: revision", "data: 1"]
        (tmp_path / "version").unlink()
        assert event() == ["event: trouble", "data: The store is away."]
        with pytest.raises(urllib.error.HTTPError, match="503") as refused:
            urllib.request.urlopen(f"{at}/main", timeout=30)
        with refused.value as answer:
            assert answer.read().decode().split() == ["The", "store", "is", "away."]
        (tmp_path / "version").write_text("2")
        assert event() == ["event: revision", "data: 2"]
    with urllib.request.urlopen(f"{at}/main", timeout=30) as answer:
        assert answer.headers["X-Version"] == "2"


def test_films_are_sent_in_parts_and_nothing_else_of_their_folder(at, tmp_path):
    (tmp_path / "cup.webm").write_bytes(b"0123456789")
    request = urllib.request.Request(f"{at}/film/cup.webm", headers={"Range": "bytes=2-4"})
    with urllib.request.urlopen(request, timeout=30) as answer:
        assert (answer.status, answer.read()) == (206, b"234")
        assert answer.headers["Content-Type"] == "video/webm"
        assert "media-src 'self'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    for name in ("version", "..%2Fversion"):
        with pytest.raises(urllib.error.HTTPError, match="404") as refused:
            urllib.request.urlopen(f"{at}/film/{name}", timeout=30)
        refused.value.close()


def test_a_port_is_taken_once():
    with listen(0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(ViewerError, match=f"port {port} is taken"):
            listen(port)
