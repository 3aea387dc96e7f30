"""Jobs that fail: on one worker, which may be broken, and on several, where the job is."""

from collections.abc import Iterable

import pytest

from storage.operations.leases import MAX_RETRY_FACTOR, worker_of
from storage.records import Job
from storage.store import Store

TRIES = 3


@pytest.fixture
def waiting(store: Store) -> Store:
    store.queue([Job("cup", "match", "a batch")])
    return store


def alive(store: Store, *workers: str) -> None:
    for worker in workers:
        host, pid, what = worker.rsplit(":", 2)
        store.heartbeat(worker, "cup", what.rstrip("0123456789"), int(pid), host, {})


def fails_on(store: Store, workers: Iterable[str]) -> int:
    """The number of failures after which the job is set aside, on these workers one after the other."""
    for number, worker in enumerate(workers, start=1):
        claimed = store.claim("cup", ["match"], worker, 60)
        assert claimed
        store.fail(claimed[0], f"ImportError: no mujoco, try {number}\nTraceback: line 3", TRIES, wait=0.0)
        if store.jobs("cup", "failed"):
            return number
    return 0


def test_a_worker_alone_has_its_jobs_set_aside_after_so_many_tries(waiting: Store):
    alive(waiting, "ada:7:match0", "ada:8:train0", "ada:9:manager")
    assert fails_on(waiting, ["ada:7:match0"] * 9) == TRIES


def test_a_process_that_replaces_a_dead_one_is_the_same_worker(waiting: Store):
    alive(waiting, "ada:7:match0", "ada:8:match0", "ada:9:match0")
    assert fails_on(waiting, ["ada:7:match0", "ada:8:match0", "ada:9:match0"] * 3) == TRIES


@pytest.mark.parametrize("other", ["ada:8:match1", "bob:8:match0", "bob:8:train+match0"])
def test_one_worker_alone_sets_nothing_aside_where_others_are_there(waiting: Store, other: str):
    alive(waiting, "ada:7:match0", other)
    assert fails_on(waiting, ["ada:7:match0"] * (TRIES + 2)) == 0
    (job,) = waiting.jobs("cup", "queued")
    assert str(job.error).splitlines()[::2] == ["ImportError: no mujoco, try 5", "failed on: ada:match0"]
    claimed = waiting.claim("cup", ["match"], other, 60)
    assert claimed
    waiting.finish(claimed[0])
    assert [each.state for each in waiting.jobs("cup")] == ["done"]


def test_what_fails_on_two_workers_is_set_aside(waiting: Store):
    alive(waiting, "ada:7:match0", "bob:8:match0")
    assert fails_on(waiting, ["ada:7:match0", "bob:8:match0", "ada:7:match0"]) == TRIES
    (job,) = waiting.jobs("cup", "failed")
    assert str(job.error).splitlines()[-1] == "failed on: ada:match0, bob:match0"
    waiting.requeue(job.id)  # a person asks for another try, on whomever
    assert fails_on(waiting, ["ada:7:match0", "ada:7:match0", "ada:7:match0"]) == 0


def test_a_job_that_the_others_never_take_is_set_aside_in_the_end(waiting: Store):
    alive(waiting, "ada:7:match0", "bob:8:match0")
    assert fails_on(waiting, ["ada:7:match0"] * 99) == MAX_RETRY_FACTOR * TRIES


def test_a_job_is_never_kept_for_long(waiting: Store):
    alive(waiting, "ada:7:match0", "bob:8:match0")
    for _ in range(9):
        claimed = waiting.claim("cup", ["match"], "ada:7:match0", 60)
        assert claimed
        before = waiting.now()
        waiting.fail(claimed[0], "no", TRIES, wait=5.0)
        (job,) = waiting.jobs("cup", "queued")
        assert job.not_before <= before + 5.0 * 2 ** (TRIES - 1) + 5
        with waiting._db.writing() as db:
            db.exec_driver_sql("UPDATE jobs SET not_before = 0")


def test_a_worker_is_known_by_host_and_place_not_by_process():
    assert worker_of("ada:7:train+match0") == worker_of("ada:8:train+match0") == "ada:train+match0"
    assert worker_of("fe80::1:7:match0") == "fe80::1:match0"
    assert [worker_of(name) for name in ("tester", "a:b", "a:b:c")] == [None, None, None]
