"""Updates in a process of their own: to the last byte what they are here, and nothing is lost where it dies."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.errors import Diverged
from agents.learner.happo import HappoLearner
from league.training import update_pool
from league.training.update_pool import UpdatePool, UpdateRequest, UpdateWorker, run_inline
from tests.agents.conftest import make_batch
from tests.agents.variants import BASE, EVERY_UPDATE, SIGHT, experienced

QUICK = ("happo", "ippo", "shared", "desired_kl", "recurrent", "privileged", "paper")
SLOW = ("hatrpo", "same", "squashed", "bf16", "recurrent, shared")  # the others are made of the same parts


def when(variant: str) -> list[pytest.MarkDecorator]:
    """Return the mark under which a variant is tried."""
    return [] if variant in QUICK else [pytest.mark.slow if variant in SLOW else pytest.mark.gpu]


WAIT = 120.0  # s for a process that imports torch, on a busy machine


def until(found: Callable[[], object]) -> None:
    end = time.monotonic() + WAIT
    while not found():
        assert time.monotonic() < end
        time.sleep(0.05)


def learners(count: int = 2, **settings) -> list[HappoLearner]:
    return [
        HappoLearner([4, 4, 3], [2, 2, 1], replace(BASE, **settings), seed, critic_size=SIGHT, kinds=["a", "a", "b"])
        for seed in range(count)
    ]


def assert_same(one: HappoLearner, other: HappoLearner) -> None:
    theirs = other.save()
    for name, array in one.save().items():
        np.testing.assert_array_equal(array, theirs[name], err_msg=name)
    assert len(one.final_memories) == len(other.final_memories)
    assert all(torch.equal(x, y) for x, y in zip(one.final_memories, other.final_memories, strict=True))


@pytest.fixture
def worker() -> UpdateWorker:
    found = UpdateWorker()
    until(lambda: found.ready)
    return found


@pytest.fixture(scope="module")
def lasting() -> Iterator[UpdateWorker]:
    found = UpdateWorker()
    until(lambda: found.ready)
    yield found
    assert found.ready  # it has served all of them


@pytest.mark.parametrize("variant", [pytest.param(v, id=k, marks=when(k)) for k, v in EVERY_UPDATE.items()])
def test_an_update_worker_makes_what_this_process_makes_to_the_last_byte(variant, lasting):
    mine, theirs = (learners(1, **variant)[0] for _ in range(2))
    before = mine.save()
    for seed, rests in enumerate((False, True, False)):
        batch = experienced(make_batch, mine, seed, 6)
        assert lasting(UpdateRequest(theirs, batch, rests)) == run_inline(UpdateRequest(mine, batch, rests))
        assert_same(mine, theirs)
    assert any(not np.array_equal(x, before[name]) for name, x in mine.save().items() if name.startswith("actor"))


def test_one_worker_serves_learners_of_several_shapes_and_settings_that_have_moved(lasting):
    of_two = [HappoLearner([4, 3], [2, 1], BASE, 5) for _ in range(2)]
    for lr in (0.01, 0.03):
        for pair in (of_two, learners(1, lr=lr) + learners(1, lr=lr)):
            batch = make_batch(pair[0], 7)
            assert lasting(UpdateRequest(pair[0], batch)) == run_inline(UpdateRequest(pair[1], batch))
            assert_same(*pair)


def test_who_diverges_in_a_worker_is_told_so_and_stays_as_it_was(lasting):
    (learner,) = learners(1)
    before, batch = learner.save(), make_batch(learner, 3)
    found = lasting(UpdateRequest(learner, batch._replace(rewards=batch.rewards.fill_(float("nan")))))
    assert isinstance(found, Diverged)
    assert "rewards" in str(found)
    assert all(np.array_equal(x, before[name]) for name, x in learner.save().items())


def test_a_worker_that_died_costs_no_update(worker):
    mine, theirs = (learners(1)[0] for _ in range(2))
    os.kill(worker.pid, signal.SIGKILL)
    batch = make_batch(mine, 1)
    assert worker(UpdateRequest(theirs, batch)) == run_inline(UpdateRequest(mine, batch))
    assert_same(mine, theirs)
    assert not worker.ready


@pytest.mark.parametrize("one_here", [False, True])
def test_of_two_that_learn_one_goes_to_the_worker(one_here, monkeypatch):
    monkeypatch.setattr(update_pool, "cores", lambda: 2)
    monkeypatch.setattr(update_pool, "PATIENCE", 0.0)
    mine, theirs = learners(), learners()
    comm, spec = UpdatePool(mine, one_here), []
    update = HappoLearner.learn
    monkeypatch.setattr(HappoLearner, "learn", lambda learner, batch: spec.append(learner) or update(learner, batch))
    for seed in range(3):
        batches = [make_batch(learner, seed) for learner in mine]
        spec.clear()
        found = comm([UpdateRequest(*each) for each in zip(mine, batches, strict=True)])
        assert [learner for learner in spec if learner in mine] == mine[: 2 if seed == 0 else 1]
        assert found == [run_inline(UpdateRequest(*each)) for each in zip(theirs, batches, strict=True)]
        for one, other in zip(mine, theirs, strict=True):
            assert_same(one, other)
        (worker,) = comm.workers
        until(lambda worker=worker: worker.ready)


def test_without_a_worker_two_learn_at_the_same_time(monkeypatch):
    monkeypatch.setattr(update_pool, "cores", lambda: 2)
    both, meeting = learners(), threading.Barrier(2)
    update = HappoLearner.learn
    monkeypatch.setattr(HappoLearner, "learn", lambda learner, batch: (meeting.wait(WAIT), update(learner, batch))[1])
    found = UpdatePool(both)([UpdateRequest(learner, make_batch(learner, 1)) for learner in both])
    assert [isinstance(figures, dict) and figures["critic_grad_norm"] > 0 for figures in found] == [True, True]


def test_a_process_makes_one_update_at_a_time_where_that_is_asked(monkeypatch):
    monkeypatch.setattr(update_pool, "cores", lambda: 2)
    both, under_way, most = learners(), [], []
    update = HappoLearner.learn

    def learn(learner, batch):
        under_way.append(learner)
        time.sleep(0.2)  # in which another thread would begin
        most.append(len(under_way))
        under_way.remove(learner)
        return update(learner, batch)

    monkeypatch.setattr(HappoLearner, "learn", learn)
    found = UpdatePool(both, one_here=True)([UpdateRequest(learner, make_batch(learner, 1)) for learner in both])
    assert [isinstance(figures, dict) for figures in found] == [True, True]
    assert most == [1, 1]


def test_nobody_is_called_for_short_runs_nor_to_compile_once_more_nor_for_large_batches(monkeypatch):
    monkeypatch.setattr(update_pool, "cores", lambda: 2)
    for patience, compiled, largest in ((1e6, False, 1e6), (0.0, True, 1e6), (0.0, False, 1000)):
        monkeypatch.setattr(update_pool, "PATIENCE", patience)
        monkeypatch.setattr(update_pool, "LARGEST", largest)
        both = learners()
        comm = UpdatePool(both)
        batches = [make_batch(learner, 1) for learner in both]
        comm._may_start_workers = not compiled
        comm([UpdateRequest(*each) for each in zip(both, batches, strict=True)])
        assert comm.workers == []


def test_a_worker_ends_with_the_process_that_it_serves_however_that_ends():
    script = "import time; from league.training.update_pool import UpdateWorker; a = UpdateWorker()"
    script += "; print(a.pid, flush=True); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        pid = int(served.stdout.readline())
        assert os.path.exists(f"/proc/{pid}")
        served.kill()
    until(lambda: not os.path.exists(f"/proc/{pid}"))
