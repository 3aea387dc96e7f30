"""A store that is away for a while: every verb says so, does nothing, and works again when it is back."""

import contextlib
import secrets
import selectors
import socket
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.database import engines, lock_wait
from storage.errors import StorageError, Unavailable
from storage.records import Job, League, Phase
from storage.store import Store
from tests.storage.conftest import fill, match


class Line:
    """A line to a server that can be cut, with all that goes over it, and mended: to its clients, a restart of it."""

    def __init__(self, host: str, port: int):
        self._server = (host, port)
        self._address = ("127.0.0.1", 0)
        self._threads: list[threading.Thread] = []
        self._sockets: list[socket.socket] = []
        self.mend()

    @property
    def port(self) -> int:
        return self._address[1]

    def mend(self) -> None:
        listener = socket.create_server(self._address)
        self._address = listener.getsockname()
        self._sockets.append(listener)
        self._start(self._accept, listener)

    def cut(self) -> None:
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for one in self._sockets:
            one.close()
        self._threads.clear()
        self._sockets.clear()

    def _start(self, what: Callable[..., None], *given: socket.socket) -> None:
        thread = threading.Thread(target=what, args=given)
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                server = socket.create_connection(self._server)
                self._sockets += [client, server]
                self._start(self._carry, client, server)

    def _carry(self, client: socket.socket, server: socket.socket) -> None:
        other = {client: server, server: client}
        with selectors.DefaultSelector() as ready, contextlib.suppress(OSError):
            for one in other:
                ready.register(one, selectors.EVENT_READ)
            while True:
                for key, _ in ready.select():
                    if not (data := key.fileobj.recv(65536)):  # type: ignore[union-attr]
                        other[key.fileobj].shutdown(socket.SHUT_RDWR)  # type: ignore[index]
                        return
                    other[key.fileobj].sendall(data)  # type: ignore[index]


@pytest.fixture
def line(server_url: str) -> Iterator[Line]:
    url = sa.make_url(server_url)
    line = Line(url.host or "127.0.0.1", url.port or 5432)
    yield line
    line.cut()


@pytest.fixture
def far(server_url: str, line: Line, tmp_path: Path) -> Iterator[Store]:
    url = sa.make_url(server_url).set(host="127.0.0.1", port=line.port).render_as_string(hide_password=False)
    with Store.open(url, create=True, blobs=str(tmp_path)) as store:
        fill(store)
        store.queue([Job("cup", "match", "a"), Job("cup", "match", "b")])
        yield store


def test_a_server_that_restarts_is_waited_for(far: Store, line: Line):
    claimed = far.claim("cup", ["match"], "me", 600)
    assert claimed
    before = far.jobs("cup")
    line.cut()
    for verb in (
        far.now,
        far.leagues,
        lambda: far.matches("cup"),
        lambda: far.claim("cup", ["match"], "me", 60),
        lambda: far.renew(claimed[0], 60),
        lambda: far.finish(claimed[0], matches=[match(1)]),
        lambda: far.heartbeat("a:1:0", "cup", "match", 1, "a", {}),
        lambda: far.acquire_leadership("cup", "me", 60),
        lambda: Store.open(far._db.engine.url.render_as_string(hide_password=False), blobs="blobs"),
    ):
        with pytest.raises(Unavailable, match="wait and try again") as caught:
            verb()
        assert "\n" not in str(caught.value)
    line.mend()
    assert far.jobs("cup") == before
    far.finish(claimed[0], matches=[match(1)])
    assert [m.seed for m in far.matches("cup")] == [1]


def test_connections_that_a_restart_has_cut_are_replaced_unseen(server_url: str, tmp_path: Path):
    name = f"league {secrets.token_hex(6)}"
    own = sa.make_url(server_url).update_query_dict({"application_name": name})
    with Store.open(own.render_as_string(hide_password=False), create=True, blobs=str(tmp_path)) as store:
        fill(store)
        admin = sa.create_engine(sa.make_url(server_url))
        end = sa.text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = :name")
        with admin.begin() as db:  # as the server does to all its clients when it stops
            assert db.execute(end, {"name": name}).all()
        admin.dispose()
        assert [p.name for p in store.players("cup")] == ["blue", "red"]
        assert store.queue([Job("cup", "match", "a")]) == 1


def test_a_server_that_goes_away_in_the_middle_of_a_verb_has_changed_nothing(far: Store, line: Line):
    claimed = far.claim("cup", ["match"], "me", 600)
    assert claimed
    before = (far.jobs("cup"), far.revision("cup"))
    engine = far._db.engine

    def stop(db: sa.Connection, _cursor: object, statement: str, *_: object) -> None:
        if statement.startswith("INSERT INTO matches"):
            sa.event.remove(engine, "before_cursor_execute", stop)
            line.cut()

    sa.event.listen(engine, "before_cursor_execute", stop)
    with pytest.raises(Unavailable):
        far.finish(claimed[0], matches=[match(1)], jobs=[Job("cup", "match", "c")])
    line.mend()
    assert (far.jobs("cup"), far.revision("cup"), far.matches("cup")) == (*before, [])
    far.finish(claimed[0], matches=[match(1)], jobs=[Job("cup", "match", "c")])
    assert [m.id for m in far.matches("cup")] == [1]


@pytest.mark.parametrize("change", [{"username": "nobody_of_this_name"}, {"database": "no_such_database"}])
def test_what_no_waiting_mends_is_not_called_away(server_url: str, tmp_path: Path, change: dict[str, str]):
    url = sa.make_url(server_url).set(**change).render_as_string(hide_password=False)  # type: ignore[arg-type]
    with pytest.raises(StorageError, match=r"does not exist|authentication failed") as caught:
        Store.open(url, create=True, blobs=str(tmp_path))
    assert not isinstance(caught.value, Unavailable)
    assert "\n" not in str(caught.value)


def test_a_server_row_kept_locked_for_too_long_is_waited_for(server_url: str, tmp_path: Path):
    impatient = server_url.replace("options=", "options=-c%20lock_timeout%3D100ms%20")
    with Store.open(impatient, create=True, blobs=str(tmp_path)) as store:
        fill(store)
        with (
            store._db.changing(["cup"]),
            pytest.raises(Unavailable, match=r"another process kept it locked for 60 s; wait and try"),
        ):
            store.queue([Job("cup", "match", "a")])
        assert store.queue([Job("cup", "match", "a")]) == 1


def test_a_file_kept_locked_for_too_long_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(engines, "BUSY_SECONDS", 0.1)
    with Store.open(tmp_path, create=True) as store:
        store.create_league(League("cup", ""))
        other = sqlite3.connect(tmp_path / "league.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(Unavailable, match=r"another process kept it locked for 60 s; wait and try again"):
            store.set_config("cup", "x")
        other.execute("ROLLBACK")
        other.close()
        store.set_config("cup", "x")
        assert store.league("cup").config == "x"


def test_a_disk_that_is_not_mounted_is_waited_for(tmp_path: Path):
    with Store.open(tmp_path / "disk", create=True) as store:
        store.create_league(League("cup", ""))
        store.close()
        (tmp_path / "disk").rename(tmp_path / "unplugged")
        with pytest.raises(Unavailable, match="wait and try again"):
            store.leagues()
        (tmp_path / "unplugged").rename(tmp_path / "disk")
        assert [league.name for league in store.leagues()] == ["cup"]


DAMAGE = {
    "jobs": ("UPDATE jobs SET payload = '{\"seed\": '", lambda store: store.jobs("cup")),
    "players": ("UPDATE players SET roster = CAST(x'ff' AS TEXT)", lambda store: store.players("cup")),
    "phases": ("UPDATE phases SET since = '7'", lambda store: store.phases("cup")),
    "workers": ("UPDATE workers SET status = 'null'", lambda store: store.workers("cup", 60)),
}


@pytest.mark.parametrize("table", DAMAGE)
def test_a_damaged_row_is_told_and_not_waited_for(tmp_path: Path, table: str):
    damage, read = DAMAGE[table]
    with Store.open(tmp_path, create=True) as store:
        fill(store)
        store.queue([Job("cup", "match", "a")], [Phase("cup", "1", 0, ("blue",), {"blue": 0})])
        store.heartbeat("a:1:0", "cup", "match", 1, "a", {})
        with store._db.engine.connect() as db:
            db.exec_driver_sql("COMMIT")
            db.exec_driver_sql("PRAGMA foreign_keys = OFF")
            db.exec_driver_sql(damage)
        store.close()
        with pytest.raises(StorageError) as caught:
            read(store)
        assert not isinstance(caught.value, Unavailable)
        assert "\n" not in str(caught.value)
        assert len(store.snapshots("cup")) == 2


def test_a_damaged_file_is_told_and_not_waited_for(tmp_path: Path):
    with Store.open(tmp_path, create=True) as store:
        fill(store)
        store.add_snapshots([])
    file = tmp_path / "league.db"
    data = bytearray(file.read_bytes())
    data[4096:] = b"\xa5" * (len(data) - 4096)  # all but the first page
    file.write_bytes(data)
    with pytest.raises(StorageError, match="malformed") as caught:
        Store.open(tmp_path)
    assert not isinstance(caught.value, Unavailable)


def test_who_waits_for_another_process_to_write_says_so_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(lock_wait, "REPORT_SECONDS", 0.05)
    with Store.open(tmp_path, create=True) as store:
        fill(store)
        other, heard = sqlite3.connect(tmp_path / "league.db", isolation_level=None), []
        other.execute("BEGIN IMMEDIATE")

        def listen(what: str) -> None:
            heard.append(what)
            if len(heard) == 2:
                other.execute("ROLLBACK")

        monkeypatch.setattr(lock_wait, "report_wait", listen)
        assert store.locked(0.05)
        assert store.queue([Job("cup", "any", "late")]) == 1
        assert heard == ["other processes have kept the store locked for 0 s"] * 2
        assert not store.locked(0.05)
        other.close()


def test_who_waits_for_a_lock_on_a_server_says_so_and_goes_on(server_url: str, tmp_path: Path, monkeypatch):
    with Store.open(server_url, create=True, blobs=str(tmp_path)) as store:
        fill(store)
        heard, twice = [], threading.Event()

        def listen(what: str) -> None:
            heard.append(what)
            if len(heard) == 2:
                twice.set()

        monkeypatch.setattr(lock_wait, "REPORT_SECONDS", 0.05)
        monkeypatch.setattr(lock_wait, "report_wait", listen)
        monkeypatch.setattr(lock_wait.SERVER_WATCH, "_thread", None)  # one that looks so often
        with store._db.engine.connect() as other, ThreadPoolExecutor(1) as pool:
            other.execute(sa.text("SELECT name FROM leagues FOR UPDATE"))  # and then its process is stopped
            late = pool.submit(store.queue, [Job("cup", "any", "late")])
            assert twice.wait(60)
            assert not late.done()
            other.rollback()
            assert late.result(60) == 1
        assert set(heard[:2]) == {"the server has not answered for 0 s; does another process keep a lock?"}
        assert not lock_wait.SERVER_WATCH._since
