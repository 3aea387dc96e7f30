"""A worker on which jobs fail: one of several stops with the reason, one alone goes on and has them set aside."""

import os
import socket
import threading
from collections.abc import Callable

import pytest

from league.config.run_spec import RunSpec
from league.runtime.worker import Worker
from league.runtime.worker_process import WorkerSpec
from storage.errors import Unavailable, WrongBlobStore
from storage.records import Job, League
from storage.store import Store
from tests.league.runtime.test_worker import CONFIG, LEAGUE

KINDS = ("train", "match")


@pytest.fixture
def store(tmp_path):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League(LEAGUE, ""))
        yield store


def worker(store: Store, raising: Callable[[], object]) -> Worker:
    """A worker whose every job does that."""
    made = Worker(store, CONFIG, WorkerSpec(RunSpec(store.where, None, ""), KINDS, 0, os.getppid()), threading.Event())
    made._handlers = dict.fromkeys(made._handlers, lambda *_: raising())  # type: ignore[assignment]
    store.heartbeat(made.id, LEAGUE, "train+match", made.pid, made.host, {})
    return made


def work(store: Store, by: Worker, jobs: int) -> None:
    """Give a worker so many jobs, one after the other, until it stops."""
    for number in range(jobs):
        payload = {"turn": number, "group": "main"}
        store.queue([Job(LEAGUE, "match", f"{number}", payload, priority=-number)])
        claimed = store.claim(LEAGUE, ["match"], by.id, 60)
        if claimed is None or by.stopping.is_set():
            return
        by._run_job(*claimed)


def raises(error: Exception) -> Callable[[], object]:
    def raising() -> None:
        raise error

    return raising


@pytest.fixture(autouse=True)
def _any_job(monkeypatch):
    from league.state.jobs import RatingMatch

    monkeypatch.setattr("league.runtime.worker.decode", lambda job: object.__new__(RatingMatch))


@pytest.mark.parametrize(
    ("error", "jobs"), [(ModuleNotFoundError("No module named 'mujoco'"), 1), (RuntimeError("the GPU fell off"), 3)]
)
def test_a_broken_worker_stops_with_the_reason_and_sets_nothing_aside_where_others_are(store, error, jobs):
    store.heartbeat("other:1:match0", LEAGUE, "match", 1, "other", {})
    broken = worker(store, raises(error))
    work(store, broken, 9)
    assert broken.stopping.is_set()
    assert broken.unfit == f"{type(error).__name__}: {error}"
    assert len([job for job in store.jobs(LEAGUE) if job.failures]) == jobs
    assert not store.jobs(LEAGUE, "failed")


@pytest.mark.parametrize("beside", ["nobody", "its predecessor", "a worker of other kinds"])
def test_a_worker_alone_goes_on_and_its_jobs_are_set_aside(store, beside):
    broken = worker(store, raises(ModuleNotFoundError("No module named 'mujoco'")))
    host = socket.gethostname()
    if beside == "its predecessor":
        store.heartbeat(f"{host}:1:train+match0", LEAGUE, "train+match", 1, host, {})
    elif beside == "a worker of other kinds":
        store.heartbeat("other:1:train0", LEAGUE, "train", 1, "other", {})
    for _ in range(CONFIG.workers.max_attempts):
        work(store, broken, 1)
        with store._db.writing() as db:
            db.exec_driver_sql("UPDATE jobs SET not_before = 0")
    assert [job.state for job in store.jobs(LEAGUE)] == ["failed"]
    assert not broken.stopping.is_set()


def test_a_job_that_is_done_begins_the_count_anew(store):
    store.heartbeat("other:1:match0", LEAGUE, "match", 1, "other", {})
    ends = iter([RuntimeError("bad batch"), RuntimeError("bad batch"), None] * 3)

    def by_turns() -> None:
        if error := next(ends):
            raise error

    fit = worker(store, by_turns)
    work(store, fit, 9)
    assert not fit.stopping.is_set()


def test_a_worker_whose_blobs_are_another_store_s_stops_and_holds_nothing_against_its_job(store):
    lost = worker(store, raises(WrongBlobStore("these are of another store")))
    work(store, lost, 1)
    assert lost.unfit == "these are of another store"
    assert [(job.state, job.failures) for job in store.jobs(LEAGUE)] == [("queued", 0)]


def test_a_store_that_is_away_is_waited_for_and_said(store, monkeypatch, capfd):
    monkeypatch.setattr("league.runtime.worker.AWAY", 0.0)
    waits = worker(store, raises(Unavailable("the disk is not mounted")))
    work(store, waits, 5)
    assert [(job.state, job.failures) for job in store.jobs(LEAGUE)][:1] == [("queued", 0)]
    assert not waits.stopping.is_set()
    assert capfd.readouterr().err.count("league: waiting: the disk is not mounted") == 1
