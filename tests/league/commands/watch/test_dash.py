"""`league dash` as a browser meets it: a process of its own, asked over HTTP."""

import socket
from pathlib import Path
from urllib.error import URLError
from urllib.parse import unquote
from urllib.request import urlopen

import pytest
import rerun as rr

from storage.recordings.recording import to_bytes
from storage.store import Store
from tests.dashboards.cars import cars
from tests.league import conftest
from tests.league.conftest import call
from tests.league.leagues import filled, finish, match
from tests.league.served import Served
from tests.markup import Markup


@pytest.fixture
def folder(tmp_path):
    with filled(tmp_path / "league-data", match("blue@4", "red@4", 48, 16)):
        return tmp_path


@pytest.fixture
def served(folder, port):
    running = Served(folder, port)
    yield running
    running.kill()


def games(page: Markup) -> dict[str, str]:
    """Games of each snapshot in the ladder."""
    head, *rows = page.tables["Ladder, best first"]
    at, name = head.index("games"), head.index("snapshot")
    return {row[name]: row[at] for row in rows}


def test_the_page_follows_the_store_and_outlives_a_restart(served, folder, port):
    page = served.page()
    assert games(page)["blue@4"] == "64"
    assert page.scripts == ["", ""]  # both are asked of the server
    for name in ("page.js", "plotly.js"):
        assert served.ask(f"/{name}").status == 200
    with served.events() as events:
        kind, first = next(events)
        assert (kind, first) == ("revision", page.attributes["content"]["data-version"])
        with Store.open(folder / "league-data") as store:
            finish(store, matches=[match("blue@4", "red@4", 20, 12)])
        assert next(e for e in events if e[1] != first)[0] == "revision"
        answer = served.ask("/main")
        assert games(Markup(answer.body))["blue@4"] == "96"
        assert served.stop() == 0  # with a reader who is still there

    again = Served(folder, port)
    try:
        with again.events() as events:
            assert next(events) == ("revision", answer.headers["X-Version"])
        assert games(again.page())["blue@4"] == "96"
    finally:
        assert again.stop() == 0


def test_without_films_none_is_awaited(folder, port):
    running = Served(folder, port, "--films", "0")
    try:
        body = running.ask("/main").body
    finally:
        running.kill()
    assert "Films were left out by --films 0." in body
    assert "is being made" not in body


def test_nothing_can_be_changed_and_nobody_else_can_read_it(served, folder):
    with Store.open(folder / "league-data") as store:
        before = store.revision("cup")
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            assert served.ask("/main", method).status == 405
        answer = served.ask("/")
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["Server"] == "robot-league"
        assert served.ask("/", Host=f"elsewhere.example:{served.port}").status == 400
        assert served.ask("/nothing").status == 404
        assert store.revision("cup") == before
    listening = Path(f"/proc/{served.process.pid}/net/tcp").read_text()
    assert f"0100007F:{served.port:04X} 00000000:0000 0A" in listening


def test_a_match_opens_in_a_viewer_that_may_read_it_and_nobody_else(served, folder, tmp_path):
    with Store.open(folder / "league-data") as store:
        finish(store, matches=[match("blue@4", "red@4", 2, 0, recording=store.blobs.put(to_bytes(cars())))])
    links = Markup(served.ask("/main").body).links
    assert "match/2" in links
    assert "match/1" not in links  # it was not recorded
    assert (
        served.ask("/match/2.rrd", encoding="latin-1").headers["Access-Control-Allow-Origin"] is None
    )  # there is no viewer yet

    answer = served.ask("/match/2")
    viewer, _, about = answer.headers["Location"].partition("/?url=")
    assert answer.status == 303
    assert unquote(about.partition("&")[0]) == f"http://127.0.0.1:{served.port}/match/2.rrd"
    assert b"<canvas" in urlopen(viewer).read()
    assert served.ask("/match/2").headers["Location"] == answer.headers["Location"]  # the same one
    file = served.ask("/match/2.rrd", encoding="latin-1")
    assert file.headers["Access-Control-Allow-Origin"] == viewer
    (tmp_path / "match.rrd").write_bytes(file.body.encode("latin-1"))
    (found,) = rr.chunk.RrdReader(tmp_path / "match.rrd").recordings()
    assert found.application_id == "robot-league"

    for path, says in (("/match/1", "Match 1 was not recorded; recorded near it: 2."), ("/match/9.rrd", "no match 9")):
        told = served.ask(path)
        assert (told.status, told.body.count("\n")) == (404, 1)
        assert says in told.body
    for path in ("/match/2", "/match/2.rrd"):
        assert served.ask(path, **{"Sec-Fetch-Site": "cross-site"}).status == 403
    for path in ("/match/-2", "/match/..%2f2.rrd", "/match/2.rrd/..", "/match/", "/match/" + 5000 * "9"):
        assert served.ask(path).status == 404
    assert served.stop() == 0
    with pytest.raises(URLError):
        urlopen(viewer)


def test_sigterm_leaves_nothing_of_a_viewer(folder, port, monkeypatch):
    (temporary := folder / "temporary").mkdir()
    monkeypatch.setattr(conftest, "ENVIRONMENT", {**conftest.ENVIRONMENT, "TMPDIR": str(temporary)})
    with Store.open(folder / "league-data") as store:
        finish(store, matches=[match("blue@4", "red@4", 2, 0, recording=store.blobs.put(to_bytes(cars())))])
    running = Served(folder, port, "--films", "0")
    try:
        assert running.ask("/match/2").status == 303
        assert list(temporary.iterdir())
        running.process.terminate()
        assert running.process.wait(60) == 0
    finally:
        running.kill()
    assert list(temporary.iterdir()) == []


def refused(folder, *args: str) -> str:
    done = call("dash", *args, cwd=folder, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_a_taken_port_is_told_with_who_has_it_and_the_next(served, folder, port):
    said = refused(folder, "--port", str(port))
    assert f"port {port} is taken by another league dash; port " in said
    free = int(said.rpartition("--port ")[2])
    assert port < free < port + 100
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # an earlier viewer may just have ended there
        other.bind(("127.0.0.1", free))


def test_of_a_silent_holder_nothing_is_said(folder, port):
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        assert f"port {port} is taken; port " in refused(folder, "--port", str(port))


def test_bad_input_is_told_before_anything_is_served(folder, tmp_path):
    assert "--port" in refused(folder, "--port", "70000")
    (tmp_path / "empty").mkdir()
    assert "No league store" in refused(tmp_path / "empty")
