"""A store on PostgreSQL behind PgBouncer, with a standby, and beside clients that hold transactions open."""

import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.database import health
from storage.errors import StorageError, Unavailable
from storage.maintenance.verify import verify
from storage.records import TIMELINE, Job
from storage.store import Store
from tests.faults.servers import Bouncer, Pair, Server, programs
from tests.storage.conftest import fill, match

needs_server = pytest.mark.skipif(programs() is None, reason="no PostgreSQL is installed here")


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """A folder that PostgreSQL's user reaches."""
    made = Path(tempfile.mkdtemp(prefix="poolers-"))
    made.chmod(0o755)
    yield made
    shutil.rmtree(made, ignore_errors=True)


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    server = Server(folder / "server")
    yield server
    server.stop()


@pytest.mark.slow  # a server is made
@pytest.mark.usefixtures("pgbouncer")
@pytest.mark.parametrize("drops_options", [False, True])
def test_a_store_works_through_a_pooler_whose_clients_exchange_sessions(
    server: Server, folder: Path, drops_options: bool
):
    ignored = {"ignore_startup_parameters": "options"} if drops_options else {}
    pool = Bouncer(folder / f"pool-{drops_options}", server.port, default_pool_size="2", **ignored)
    blobs, direct = str(folder / f"blobs-{drops_options}"), server.url(f"pooled_{drops_options}")
    url = server.url(f"pooled_{drops_options}", pool.port)
    try:
        with Store.open(url, create=True, blobs=blobs) as one, Store.open(url, blobs=blobs) as other:
            fill(one)
            one.queue([Job("cup", "any", str(i)) for i in range(30)])
            for i in range(30):  # psycopg would prepare a statement at its sixth use
                store = (one, other)[i % 2]
                claimed = store.claim("cup", ["any"], "me", 60)
                assert claimed
                assert store.renew(claimed[0], 60)
                store.finish(claimed[0], matches=[match(i)])
            assert one.job_counts("cup") == {"done": 30}
            assert [m.seed for m in other.matches("cup")] == list(range(30))
            dumped = {}
            one.dump(["cup"], lambda table, rows: dumped.update({table: len(list(rows))}))  # by server-side cursors
            assert dumped["matches"] == 30
            with one._db.writing() as db:
                assert db.scalar(sa.text("SHOW lock_timeout")) == "1min"
            assert one._db.rows(sa.text("SHOW lock_timeout")) == [("0",)]  # nothing stays for the session's next client
            assert one._db.rows(sa.text("SELECT count(*) FROM pg_prepared_statements")) == [(0,)]
        found, expected = verify(url, blobs), verify(direct, blobs)
        assert found.findings == expected.findings
        assert found.rows == expected.rows > 30
    finally:
        pool.stop()


@pytest.mark.slow  # a server is made
@pytest.mark.usefixtures("pgbouncer")
def test_a_pooler_is_refused_in_statement_mode_or_with_options_that_it_drops(server: Server, folder: Path):
    for mode, options, complaint in (
        ("statement", "", "statement mode.*needs pool_mode = transaction or session"),
        ("transaction", "?options=-csearch_path%3Dmine", "drops options='-csearch_path=mine'.*ALTER ROLE"),
    ):
        pool = Bouncer(folder / mode, server.port, mode)
        try:
            with pytest.raises(StorageError, match=complaint) as caught:
                Store.open(server.url("refused", pool.port) + options, create=True, blobs=folder / "refused")
            assert not isinstance(caught.value, Unavailable)
            assert "\n" not in str(caught.value)
        finally:
            pool.stop()


@pytest.mark.slow  # two servers are made, and a third
@needs_server
def test_a_store_of_two_hosts_goes_on_with_the_standby_that_is_promoted(folder: Path):
    pair = Pair(folder / "pair", synchronous=True)
    try:
        hosts = ",".join(f"127.0.0.1:{each.port}" for each in (pair.standby, pair.primary))
        pair.primary.url("league")
        with Store.open(f"postgresql://league@{hosts}/league", create=True, blobs=folder / "two") as store:
            fill(store)
            store.queue([Job("cup", "any", "a")])
            claimed = store.claim("cup", ["any"], "me", 60)
            assert claimed
            store.finish(claimed[0], matches=[match(1)])
            before = store.revision("cup")
            _await_copy(pair.standby, before % TIMELINE)
            with Store.open(pair.standby.url("league"), blobs=folder / "two") as copy:
                assert [m.seed for m in copy.matches("cup")] == [1]
                with pytest.raises(Unavailable, match="takes no writes now: is it a standby"):
                    copy.queue([Job("cup", "any", "b")])
            pair.fail_over()
            assert [m.seed for m in store.matches("cup")] == [1]
            assert store.revision("cup") == before + TIMELINE  # whoever has read the league before reads it again
            assert store.queue([Job("cup", "any", "b")]) == 1
        assert verify(f"postgresql://league@{hosts}/league", str(folder / "two")).rows > 3
    finally:
        pair.stop()


def _await_copy(standby: Server, revision: int) -> None:
    """Wait until a standby shows a revision of the league."""
    import psycopg

    until = time.monotonic() + 60
    while time.monotonic() < until:
        with psycopg.connect(f"postgresql://league@127.0.0.1:{standby.port}/league") as db:
            if db.execute("SELECT revision FROM leagues").fetchone() == (revision,):
                return
        time.sleep(0.05)
    raise TimeoutError("the standby does not follow")


def test_an_old_transaction_and_a_wrong_clock_are_named(server_url: str, tmp_path: Path, monkeypatch):
    with Store.open(server_url, create=True, blobs=tmp_path) as store:
        fill(store)
        assert store.troubles() == []
        monkeypatch.setattr(health, "OPEN_SECONDS", -1.0)
        url = sa.make_url(server_url).update_query_dict({"application_name": "nightly dump"})
        other = sa.create_engine(url)
        with other.connect() as db:
            pid = db.scalar(sa.text("SELECT pg_backend_pid()"))
            (line,) = store.troubles()
            assert f"(nightly dump, idle in transaction, pid {pid})" in line
        other.dispose()
        monkeypatch.setattr(health, "OPEN_SECONDS", 300.0)
        true = time.time
        monkeypatch.setattr(time, "time", lambda: true() + 7200)
        (line,) = store.troubles()
        assert "the database's clock is 120 min behind this machine's" in line


def test_a_store_in_a_file_has_no_such_troubles(tmp_path: Path):
    with Store.open(tmp_path, create=True) as store:
        assert store.troubles() == []
