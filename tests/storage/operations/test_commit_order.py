"""Two transactions at once: reading on after the last match known misses none, one manager leads, bases hold."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.errors import Superseded
from storage.records import Checkpoint, Job, Lease
from storage.store import Store
from tests.storage.conftest import fill, match


def claims(store: Store, *keys: str) -> list[Lease]:
    store.queue([Job("cup", "match", key) for key in keys])
    taken = [store.claim("cup", ["match"], "me", 600) for _ in keys]
    return [claimed[0] for claimed in taken if claimed]


class Held:
    """Runs a verb in a thread and stops it just before its commit, until it is let go."""

    def __init__(self, store: Store):
        self.reached, self._go = threading.Event(), threading.Event()
        self._engine, self._thread = store._db.engine, 0

    def start(self, pool: ThreadPoolExecutor, verb, *given, **options) -> Future:
        def run():
            self._thread = threading.get_ident()
            sa.event.listen(self._engine, "commit", self._wait)
            try:
                return verb(*given, **options)
            finally:
                sa.event.remove(self._engine, "commit", self._wait)

        return pool.submit(run)

    def let_go(self) -> None:
        self._go.set()

    def _wait(self, _db: sa.Connection) -> None:
        if threading.get_ident() == self._thread:
            self.reached.set()
            assert self._go.wait(60)


def until_it_waits(store: Store, second: Future) -> None:
    """Return when a transaction on the server waits for a lock of another, or the second verb has ended."""
    waiting = sa.text("SELECT count(*) FROM pg_locks WHERE NOT granted")
    while not second.done():
        with store._db.engine.connect() as db:
            if db.execute(waiting).scalar_one() > 0:
                return
        time.sleep(0.01)


def test_a_match_that_commits_late_is_never_skipped(place: tuple[str, str]):
    with Store.open(place[0], create=True, blobs=place[1]) as store, ThreadPoolExecutor(2) as pool:
        fill(store)
        late, early = claims(store, "late", "early")
        held = Held(store)
        # With a job that follows, a batch ends by a transaction of several statements on a server too.
        first = held.start(pool, store.finish, late, matches=[match(1), match(2)], jobs=[Job("cup", "match", "next")])
        assert held.reached.wait(60)  # its rows are written and numbered, but not committed
        second = pool.submit(store.finish, early, matches=[match(3)])
        if store._db.engine.dialect.name == "postgresql":
            until_it_waits(store, second)
        read = store.matches("cup")  # somebody reads now, and remembers the last id
        held.let_go()
        first.result(60)
        second.result(60)
        read += store.matches("cup", after=read[-1].id if read else 0)
        assert sorted(m.seed for m in read) == [1, 2, 3]
        assert [m.id for m in read] == [1, 2, 3]


def test_readers_beside_eight_writers_miss_no_match(place: tuple[str, str]):
    with Store.open(place[0], create=True, blobs=place[1]) as store, ThreadPoolExecutor(9) as pool:
        fill(store)
        leases = claims(store, *(str(i) for i in range(40)))
        writers = [pool.submit(store.finish, lease, matches=[match(i)]) for i, lease in enumerate(leases)]
        read = []
        while len(read) < 40 and not (all(w.done() for w in writers) and len(read) == len(store.matches("cup"))):
            read += store.matches("cup", after=read[-1].id if read else 0)
        for writer in writers:
            writer.result(60)
        assert [m.id for m in read] == list(range(1, 41))
        assert sorted(m.seed for m in read) == list(range(40))


def test_of_two_turns_that_end_at_once_from_one_checkpoint_one_is_refused(place: tuple[str, str]):
    with Store.open(place[0], create=True, blobs=place[1]) as store, ThreadPoolExecutor(2) as pool:
        fill(store)
        leases = claims(store, "a", "b")
        ends = [Checkpoint("cup", "blue", store.blobs.put(name), 1, 1, 1.0) for name in (b"a", b"b")]
        held = Held(store)
        first = held.start(pool, store.finish, leases[0], bases={"blue": ""}, checkpoints=ends[:1])
        assert held.reached.wait(60)
        second = pool.submit(store.finish, leases[1], bases={"blue": ""}, checkpoints=ends[1:])
        if store._db.engine.dialect.name == "postgresql":
            until_it_waits(store, second)
        held.let_go()
        first.result(60)
        with pytest.raises(Superseded):
            second.result(60)
        assert [c.digest for c in store.checkpoints("cup")] == [ends[0].digest]
        assert [j.state for j in store.jobs("cup")] == ["done", "leased"]


def test_of_many_managers_started_at_once_one_leads(place: tuple[str, str], tmp_path: Path):
    with Store.open(place[0], create=True, blobs=place[1]) as store, ThreadPoolExecutor(8) as pool:
        fill(store)
        for _ in range(5):
            together = threading.Barrier(8)

            def lead(name: str, together: threading.Barrier = together) -> bool:
                together.wait(60)
                return store.acquire_leadership("cup", name, 600)

            names = [f"manager {i}" for i in range(8)]
            led = [name for name, leads in zip(names, pool.map(lead, names), strict=True) if leads]
            assert len(led) == 1
            assert (store.leader("cup") or ("",))[0] == led[0]
            assert store.release_leadership("cup", led[0])


NOTING = """
CREATE TABLE noted (state TEXT, waits TEXT);
CREATE FUNCTION note() RETURNS trigger LANGUAGE plpgsql AS $$
    BEGIN INSERT INTO noted VALUES (NEW.state, current_setting('synchronous_commit')); RETURN NULL; END $$;
CREATE CONSTRAINT TRIGGER noting AFTER INSERT OR UPDATE ON jobs DEFERRABLE INITIALLY DEFERRED
    FOR EACH ROW EXECUTE FUNCTION note();
"""  # on a server: what holds just before a commit


def test_the_disk_is_waited_for_by_results_and_not_by_claims(place: tuple[str, str]):
    with Store.open(place[0], create=True, blobs=place[1]) as store:
        fill(store)
        engine, noted = store._db.engine, []
        if engine.dialect.name == "postgresql":
            with engine.begin() as db:
                db.exec_driver_sql(NOTING)
        else:
            states = {1: "off", 2: "on"}  # NORMAL, FULL

            @sa.event.listens_for(engine, "commit")
            def note(db: sa.Connection) -> None:
                (state,) = db.exec_driver_sql("SELECT state FROM jobs").one()
                noted.append((state, states[db.exec_driver_sql("PRAGMA synchronous").scalar()]))

        (lease,) = claims(store, "a")
        store.finish(lease)
        if engine.dialect.name == "postgresql":
            with engine.connect() as db:
                noted = list(map(tuple, db.exec_driver_sql("SELECT state, waits FROM noted")))
        assert noted == [("queued", "on"), ("leased", "off"), ("done", "on")]
