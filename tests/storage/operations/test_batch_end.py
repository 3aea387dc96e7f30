"""The end of a batch on a server by one statement, beside the transaction of several by which SQLite ends it."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import sqlalchemy as sa

from storage.errors import LeaseLost, StorageError
from storage.records import Checkpoint, Job, League
from storage.store import Store
from tests.storage.conftest import finish_a_job, match


def test_a_batch_is_ended_by_one_statement_on_a_server(store: Store):
    store.queue([Job("cup", "any", "a")])
    claimed = store.claim("cup", ["any"], "me", 60)
    assert claimed
    said = []
    sa.event.listen(store._db.engine, "before_cursor_execute", lambda *args: said.append(args[2].split()[0]))
    store.finish(claimed[0], matches=[match(1), match(2)])
    on_server = store._db.engine.dialect.name == "postgresql"
    assert said.count("WITH") == (1 if on_server else 0)
    assert "UPDATE" not in said or not on_server
    assert [(m.id, m.seed) for m in store.matches("cup")] == [(1, 1), (2, 2)]


def test_whichever_way_a_job_ends_the_rows_are_equal(store: Store):
    one = replace(match(7), due=0.1 + 0.2, seconds=1 / 3, recording=None, causes=5, voids_a=2**40, purpose="gate")
    finish_a_job(store, matches=[one, match(8)])
    state = store.blobs.put(b"state")
    finish_a_job(
        store, matches=[one, match(8)], bases={"blue": ""}, checkpoints=[Checkpoint("cup", "blue", state, 1, 1, 1.0)]
    )
    rows = [replace(m, id=0, created=0.0) for m in store.matches("cup")]
    assert rows[:2] == rows[2:] == [one, match(8)]
    assert [m.id for m in store.matches("cup")] == [1, 2, 3, 4]


def test_batches_that_end_at_once_are_counted_once_each(store: Store):
    """Each waits for the league's row, which another has changed in the meantime."""
    threads, each = 8, 25
    store.queue([Job("cup", "any", str(i)) for i in range(threads * each)])
    before, together = store.revision("cup"), threading.Barrier(threads)

    def work(name: int) -> None:
        together.wait(60)
        while claimed := store.claim("cup", ["any"], f"here:{name}:any", 600):
            store.finish(claimed[0], matches=[match(2 * claimed[1].id), match(2 * claimed[1].id + 1)])

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, range(threads)))
    assert store.job_counts("cup") == {"done": threads * each}
    found = store.matches("cup")
    assert [m.id for m in found] == list(range(1, 2 * threads * each + 1))
    assert len({m.seed for m in found}) == 2 * threads * each
    assert store.revision("cup") == before + threads * each


@pytest.mark.parametrize("leagues", [("other",), ("cup", "other")])
def test_matches_of_another_league_are_refused(store: Store, leagues):
    store.create_league(League("other", ""))
    store.queue([Job("cup", "any", "a")])
    claimed = store.claim("cup", ["any"], "me", 60)
    assert claimed
    before = store.revision("cup"), store.revision("other")
    with pytest.raises(StorageError, match="a result for league 'other'"):
        store.finish(claimed[0], matches=[replace(match(1), league=league) for league in leagues])
    assert store.matches("cup") == store.matches("other") == []
    assert (store.revision("cup"), store.revision("other")) == before
    store.finish(claimed[0])


def test_a_lost_lease_writes_nothing(store: Store):
    store.queue([Job("cup", "any", "a")])
    claimed = store.claim("cup", ["any"], "me", 60)
    assert claimed
    store.finish(claimed[0])
    before = store.revision("cup")
    with pytest.raises(LeaseLost):
        store.finish(claimed[0], matches=[match(1)])
    assert store.matches("cup") == []
    assert store.revision("cup") == before
