"""The end of a turn on a server: how long it keeps the league's row, and what waits for it meanwhile."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from sqlalchemy import event

from storage.maintenance.thinning import RetentionPolicy
from storage.records import Checkpoint, CurvePoint, Job, Lease, Meeting, Snapshot
from storage.store import Store
from tests.storage.conftest import fill

LOCK = "UPDATE leagues SET revision"


def turn(store: Store, key: str) -> Lease:
    store.queue([Job("cup", "train", key)])
    claimed = store.claim("cup", ["train"], "me", 600)
    assert claimed
    return claimed[0]


def results(store: Store, i: int, keep: int = 1) -> dict[str, Any]:
    digest = store.blobs.put(f"blue {i}".encode())
    return {
        "checkpoints": [Checkpoint("cup", "blue", digest, 100 * i, i, float(i))],
        "snapshots": [Snapshot("cup", f"blue@{i}", digest, "rover", "blue", iteration=i)],
        "curves": [CurvePoint("cup", "blue", i, 100 * i, float(i), {"score": 0.5})],
        "meetings": [Meeting("cup", "blue", i, "red", 3, 2, 1)],
        "keep": keep,
    }


def test_after_the_league_is_locked_only_numbered_rows_are_written(place: tuple[str, str]):
    with Store.open(place[0], create=True, blobs=place[1]) as store:
        fill(store)
        store.finish(turn(store, "first"), **results(store, 1))
        lease, sent = turn(store, "second"), list[str]()
        event.listen(store._db.engine, "before_cursor_execute", lambda _, __, statement, *___: sent.append(statement))
        store.finish(lease, bases={"blue": store.blobs.put(b"blue 1")}, **results(store, 2))
        (at,) = [i for i, statement in enumerate(sent) if statement.startswith(LOCK)]
        assert [statement.partition(" (")[0] for statement in sent[at + 1 :]] == ["INSERT INTO meetings"]
        written = [s.split()[2] for s in sent[:at] if s.startswith(("INSERT", "DELETE"))]
        assert written == ["snapshots", "checkpoints", "checkpoints", "dropped", "curves"]
        assert [c.iteration for c in store.checkpoints("cup")] == [2]


def test_thinning_does_not_wait_for_the_end_of_a_turn_that_waits_for_it(server_url: str, tmp_path: Path):
    with Store.open(server_url, create=True, blobs=str(tmp_path)) as store, ThreadPoolExecutor(1) as pool:
        fill(store)
        store.finish(turn(store, "first"), **results(store, 1, keep=2))
        store.finish(turn(store, "second"), **results(store, 2, keep=2))
        found = store.find_removable(RetentionPolicy(0.0, {"cup": 1}))
        assert len(found.checkpoints) == 1
        lease, removed, go_on = turn(store, "third"), threading.Event(), threading.Event()

        def stop_at_the_lock(_, __, statement: str, *___) -> None:
            if statement.startswith(LOCK) and threading.current_thread() is not threading.main_thread():
                removed.set()  # the first checkpoint, which thinning would remove too
                assert go_on.wait(60)

        event.listen(store._db.engine, "before_cursor_execute", stop_at_the_lock)
        ended = pool.submit(store.finish, lease, **results(store, 3))
        assert removed.wait(60)
        assert store.thin(found).checkpoints == 0
        assert not ended.done()
        go_on.set()
        ended.result(60)
        assert [c.iteration for c in store.checkpoints("cup")] == [3]
