"""Jobs and leases: what is claimed, by whom, and that a result is written exactly once; for every database."""

import math
import multiprocessing
import os
import signal
import time
from dataclasses import replace
from multiprocessing.synchronize import Event

import pytest
import sqlalchemy as sa

from storage.database import schema
from storage.errors import LeaseLost, StorageError
from storage.records import Checkpoint, CurvePoint, Job, League, Lease
from storage.store import Store
from tests.storage.conftest import match, snapshot

SPAWN = multiprocessing.get_context("spawn")


def job(key: str, kind: str = "match", priority: int = 0) -> Job:
    return Job("cup", kind, key, {"seed": len(key)}, priority)


def take(store: Store, holder: str = "me", seconds: float = 3600, **options: object) -> tuple[Lease, Job]:
    claimed = store.claim("cup", ["match"], holder, seconds, **options)  # type: ignore[arg-type]
    assert claimed is not None
    return claimed


def test_a_key_is_queued_once(store: Store):
    assert store.queue([job("a"), job("b")]) == 2
    assert store.queue([job("b", priority=9), job("c"), job("c")]) == 1
    assert [(j.key, j.priority, j.payload) for j in store.jobs("cup")] == [(k, 0, {"seed": 1}) for k in "abc"]
    lease, _ = take(store)
    store.finish(lease)
    assert store.queue([job("a")]) == 0  # done is done
    assert [j.key for j in store.jobs("cup", state="queued")] == ["b", "c"]


def test_claims_go_by_priority_then_age(store: Store):
    store.queue([job("old"), job("new"), job("urgent", priority=5), job("least", priority=-1)])
    store.queue([job("other", kind="train", priority=-2)])
    assert [take(store)[1].key for _ in range(4)] == ["urgent", "old", "new", "least"]
    assert store.claim("cup", ["match"], "me", 60) is None
    assert store.claim("cup", [], "me", 60) is None
    claimed = store.claim("cup", ["match", "train"], "me", 60)
    assert claimed
    assert claimed[1].key == "other"
    assert [j.key for j in store.jobs("cup", state="leased", kind="train")] == ["other"]


def test_a_claim_for_several_kinds_goes_by_priority_then_age_over_all_of_them(store: Store):
    store.queue([job("match"), job("turn", "train"), job("late match"), job("least", "train", -1)])
    store.queue([job("first turn", "train", 2), job("first match", priority=3), job("other kind", "rate", 9)])
    expired = store.claim("cup", ["train"], "dead", seconds=-1)
    assert expired
    assert expired[1].key == "first turn"
    found = []
    while claimed := store.claim("cup", ["train", "match"], "me", 60):
        found.append(claimed[1].key)
    assert found == ["first match", "first turn", "match", "turn", "late match", "least"]


@pytest.mark.parametrize(
    ("preferred", "order"),
    [
        ("new", ["urgent", "new", "old", "young", "least"]),
        ("least", ["urgent", "old", "new", "young", "least"]),  # of its priority alone
        ("waiting", ["urgent", "old", "new", "young", "least"]),
        ("other", ["urgent", "old", "new", "young", "least"]),
        ("unknown", ["urgent", "old", "new", "young", "least"]),
    ],
)
def test_a_preferred_job_goes_before_older_ones_of_its_priority_if_it_can_be_claimed(store, preferred, order):
    store.queue([job("waiting")])
    assert store.fail(take(store)[0], "broke", wait=3600)
    store.queue([job("old"), job("new"), job("urgent", priority=5), job("least", priority=-1)])
    store.queue([job("other", kind="train"), job("young")])
    found = [take(store, prefer=preferred)[1].key for _ in order]
    assert found == order
    assert [each.key for each in store.jobs("cup", "queued")] == ["waiting", "other"]


def test_a_job_that_its_worker_left_does_not_wait_for_those_that_others_prefer(store: Store):
    store.queue([job("mine before"), job("left"), job("old")])
    assert take(store, prefer="left", seconds=-1)[1].key == "left"
    store.queue([job("mine")])
    assert take(store, prefer="mine before")[1].key == "mine before"
    assert [take(store, prefer="mine")[1].key for _ in range(3)] == ["left", "mine", "old"]


def test_a_lease_is_ours_until_somebody_else_claims_the_job(store: Store):
    store.queue([job("a")])
    lease, claimed = take(store, "slow", seconds=-1)  # expired at once
    assert (claimed.state, claimed.holder, claimed.attempt) == ("leased", "slow", 1)
    assert store.renew(lease, 3600)
    assert store.claim("cup", ["match"], "quick", 60) is None
    assert store.renew(lease, -1)
    second, claimed = take(store, "quick")
    assert claimed.attempt == 2
    assert not store.renew(lease, 60)
    assert not store.release(lease)
    assert not store.fail(lease, "late")
    assert not store.record_setback(lease, "blue", "late")
    assert store.jobs("cup") == [claimed]
    assert store.renew(second, 60)


def test_an_expired_lease_may_finish_if_nobody_took_over(store: Store):
    store.queue([job("a")])
    lease, _ = take(store, seconds=-1)
    store.finish(lease, matches=[match(7)])
    assert [j.state for j in store.jobs("cup")] == ["done"]
    assert [m.seed for m in store.matches("cup")] == [7]


@pytest.mark.parametrize(
    "how", ["finished", "set back", "failed", "released and claimed again", "expired and claimed again"]
)
def test_a_stale_lease_writes_nothing(store: Store, how: str):
    store.queue([job("a")])
    lease, _ = take(store, "me", seconds=-1 if "expired" in how else 3600)
    if how == "finished":
        store.finish(lease)
    elif how == "failed":
        assert store.fail(lease, "broke")
    elif how == "set back":
        assert store.record_setback(lease, "blue", "its loss is nan")
    else:
        assert "expired" in how or store.release(lease)
        take(store, "me")  # the same holder: only the attempt tells the leases apart
    before, revision = store.jobs("cup"), store.revision("cup")
    late = Checkpoint("cup", "blue", store.blobs.put(b"late"), 1, 1, 1.0)
    with pytest.raises(LeaseLost, match=r"Job 1 is no longer held by me .attempt 1."):
        store.finish(lease, checkpoints=[late], matches=[match(1)], jobs=[job("b")])
    assert store.jobs("cup") == before
    assert store.revision("cup") == revision
    assert store.checkpoints("cup") == []
    assert store.matches("cup") == []


@pytest.mark.parametrize("bad", ["match", "snapshot", "job", "curve"])
def test_a_result_is_written_whole_or_not_at_all(store: Store, bad: str):
    store.create_league(League("other", ""))
    store.queue([job("a")])
    lease, _ = take(store)
    before, revision = store.jobs("cup"), store.revision("cup")
    good: dict[str, list] = {
        "checkpoints": [Checkpoint("cup", "blue", store.blobs.put(b"blue@1"), 1, 1, 1.0)],
        "snapshots": [snapshot(store, "blue@1")],
        "matches": [match(1)],
        "curves": [CurvePoint("cup", "blue", 1, 64, 0.5, {"entropy": 1.0})],
        "jobs": [job("b")],
    }
    wrong, complaint = {
        "match": ({"matches": [replace(match(2), b="ghost")]}, "names a league, player or snapshot that is not there"),
        "snapshot": ({"snapshots": [replace(snapshot(store, "x"), player="ghost")]}, "names a league, player"),
        "job": ({"jobs": [replace(job("c"), league="other")]}, "of league 'cup' has a result for league 'other'"),
        "curve": ({"curves": [CurvePoint("cup", "blue", 2, 1, 1.0, {"ratio": math.nan})]}, "ratio of blue .* is nan"),
    }[bad]
    with pytest.raises(StorageError, match=complaint):
        store.finish(lease, **{name: [*rows, *wrong.get(name, [])] for name, rows in good.items()})
    assert (store.jobs("cup"), store.revision("cup")) == (before, revision)
    assert len(store.snapshots("cup")) == 2
    assert store.checkpoints("cup") == store.matches("cup") == store.curves("cup") == []
    store.finish(lease, **good)
    assert [(j.key, j.state) for j in store.jobs("cup")] == [("a", "done"), ("b", "queued")]
    assert len(store.snapshots("cup")) == 3
    assert len(store.checkpoints("cup")) == len(store.matches("cup")) == len(store.curves("cup")) == 1
    assert [m.id for m in store.matches("cup")] == [1]  # what was refused has used no number


def test_a_failed_job_is_tried_again_later_and_then_set_aside(store: Store):
    store.queue([job("bad"), job("good")])
    waits = []
    for n in (1, 2):
        lease, claimed = take(store)
        assert claimed.key == "bad"
        before = store.now()
        assert store.fail(lease, f"error {n}", tries=3, wait=1000)
        (waiting,) = [j for j in store.jobs("cup") if j.key == "bad"]
        assert (waiting.state, waiting.failures, waiting.error, waiting.holder) == ("queued", n, f"error {n}", None)
        waits.append((waiting.not_before - before) / 1000)
        other, claimed = take(store)
        assert claimed.key == "good"  # the league goes on without it
        assert store.claim("cup", ["match"], "me", 60) is None
        assert store.release(other)
        with store._db.writing() as db:  # the wait is over
            db.execute(sa.update(schema.jobs).values(not_before=0.0))
    assert [round(wait, 1) for wait in waits] == [1.0, 2.0]
    lease, _ = take(store)
    assert store.fail(lease, "error 3", tries=3, wait=1000)
    (aside,) = store.jobs("cup", state="failed")
    assert (aside.key, aside.failures, aside.error) == ("bad", 3, "error 3")
    assert take(store)[1].key == "good"
    assert store.claim("cup", ["match"], "me", 60) is None


def test_an_error_that_is_no_text_is_kept_as_far_as_it_is(store: Store):
    store.queue([job("a"), job("b")])
    assert store.fail(take(store)[0], "in file \udcff\x00.py\nline 2", tries=1)
    assert store.record_setback(take(store)[0], "blue", "loss \udcff\x00", limit=0)
    assert [j.error for j in store.jobs("cup")] == ["in file ??.py\nline 2", "loss ??"]
    assert store.players("cup")[0].paused == "loss ??"


def test_a_job_that_failed_once_and_is_done_has_no_error(store: Store):
    store.queue([job("a")])
    assert store.fail(take(store)[0], "the store was away", wait=0.0)
    store.finish(take(store)[0])
    (done,) = store.jobs("cup")
    assert (done.state, done.error, done.failures) == ("done", None, 1)


def test_a_job_set_aside_waits_for_a_person(store: Store):
    store.queue([job("a")])
    lease, claimed = take(store)
    assert not store.requeue(claimed.id)  # it has not failed
    assert store.fail(lease, "sumo.py: the ring is missing", tries=1)
    (failed,) = store.jobs("cup", state="failed")
    assert (failed.error, failed.holder) == ("sumo.py: the ring is missing", None)
    assert store.claim("cup", ["match"], "me", 60) is None
    assert store.requeue(failed.id)
    (queued,) = store.jobs("cup", state="queued")
    assert (queued.error, queued.failures) == (None, 0)
    assert take(store)[1].attempt == 2


def test_a_job_that_ends_every_worker_is_given_up(store: Store):
    store.queue([job("deadly"), job("fine")])
    for _ in range(20):  # giving a job back is nothing against it
        assert store.release(take(store)[0])
    assert [take(store, seconds=-1, max_attempts=3)[1].key for _ in range(3)] == ["deadly"] * 3
    assert take(store, max_attempts=3)[1].key == "fine"
    (given_up,) = store.jobs("cup", state="failed")
    assert given_up.key == "deadly"
    assert given_up.error is not None
    assert "expired 3 times" in given_up.error
    assert store.requeue(given_up.id)
    assert [take(store, seconds=-1, max_attempts=3)[1].key for _ in range(3)] == ["deadly"] * 3


def work_until_done(where: str, blobs: str, holder: str, start: Event) -> None:
    with Store.open(where, blobs=blobs) as store:
        start.wait()
        while claimed := store.claim("cup", ["match"], holder, seconds=600):
            lease, taken = claimed
            assert store.renew(lease, 600)
            seed = taken.payload["seed"]
            follow_up = [job("x" * (seed + 20))] if seed <= 20 else []
            store.finish(lease, matches=[match(seed)], jobs=follow_up)


@pytest.mark.slow
def test_eight_processes_finish_each_of_forty_jobs_once(store: Store, place: tuple[str, str]):
    store.queue([job("x" * seed) for seed in range(1, 21)])  # each of these is followed by another
    start = SPAWN.Event()
    workers = [SPAWN.Process(target=work_until_done, args=(*place, f"worker {i}", start)) for i in range(8)]
    for worker in workers:
        worker.start()
    start.set()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0] * 8
    assert sorted(m.seed for m in store.matches("cup")) == list(range(1, 41))
    assert [(j.state, j.attempt) for j in store.jobs("cup")] == [("done", 1)] * 40


def claim_and_hang(where: str, blobs: str, seconds: float, claimed: Event) -> None:
    with Store.open(where, blobs=blobs) as store:
        take(store, "victim", seconds)
        claimed.set()
        time.sleep(600)


def test_the_job_of_a_killed_worker_goes_to_another(store: Store, place: tuple[str, str]):
    store.queue([job("a")])
    claimed = SPAWN.Event()
    victim = SPAWN.Process(target=claim_and_hang, args=(*place, 1.5, claimed))
    victim.start()
    assert claimed.wait(60)
    assert victim.pid is not None
    os.kill(victim.pid, signal.SIGKILL)
    victim.join()
    (held,) = store.jobs("cup")
    assert (held.state, held.holder) == ("leased", "victim")
    deadline = time.monotonic() + 60
    while (heir := store.claim("cup", ["match"], "heir", 600)) is None and time.monotonic() < deadline:
        time.sleep(0.05)
    assert heir is not None
    assert held.lease_until is not None
    assert store.now() > held.lease_until
    store.finish(heir[0], matches=[match(1)])
    (done,) = store.jobs("cup")
    assert (done.state, done.holder, done.attempt) == ("done", "heir", 2)
