"""Pool of learner updates: several at once on a CPU, each beyond the first in a worker process.

An update consists of thousands of short operations, after each of which a thread acquires Python's lock. Therefore two
threads take half as long again as one, while two processes take no longer (docs/speed.md). An update worker receives a
learner's constructor arguments, its state and its batch, and returns the state after the update; it keeps nothing.
Workers start once updates have taken `PATIENCE`, because starting one takes time: short runs never have any. Until
then, and after a worker has died, threads do its work. In a deterministic league one thread does: of hundreds of
leagues on busy processors of Intel a few learnt otherwise in the last digit, from the first update of a process on
(experiments/notes/faults.md), and updates that begin at once in two threads are what those have in common.
"""

import json
import os
import subprocess
import sys
import time
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from agents.batch import Batch
from agents.errors import Diverged
from agents.learner.happo import HappoLearner
from agents.learner.learner_state import LearnerSpec
from arenas.physics.cpu import cores
from league.system.provenance import import_path
from league.training.own_learner import OwnLearner

PATIENCE = 3.0  # seconds of updates
LARGEST = 64 * 2**20  # bytes of a batch for a worker: it is in memory three times then, which no estimate counts
BEGIN = "import json, sys; pipe, threads, path = sys.argv[1:]; sys.path[:] = json.loads(path)"
BEGIN += "; from league.training.update_pool import serve_updates; serve_updates(int(pipe), int(threads))"

Found = dict[str, float] | Diverged


class UpdateRequest(NamedTuple):
    """An update to make: the learner, its batch, and whether its policy rests."""

    learner: HappoLearner | OwnLearner
    batch: Batch
    rests: bool = False  # the critic alone learns


class UpdateExecutor(Protocol):
    """A place where updates are made: this thread or an update worker."""

    def __call__(self, request: UpdateRequest) -> Found:
        """Make an update; return its metrics, or the error for which its learner must return to a good state."""
        ...


def run_inline(request: UpdateRequest) -> Found:
    """Make an update in this thread. Raises PlayerDiverged for a learner of another class."""
    learner = request.learner
    try:
        if request.rests and isinstance(learner, HappoLearner):
            return learner.update_critic_only(request.batch)
        return learner.learn(request.batch)
    except Diverged as error:
        return error


class UpdatePool:
    """Executors of the updates of a process's learners. The result does not depend on the executor.

    With `one_here` this process makes one update at a time, and only its workers make others beside it.
    """

    def __init__(self, learners: Sequence[HappoLearner | OwnLearner], one_here: bool = False):
        # One thread for a GPU, which one update keeps busy, for ranks, whose collectives must keep their order, and for
        # learners of other classes, which may use torch's global random numbers.
        ours = [learner for learner in learners if isinstance(learner, HappoLearner)]
        free = len(ours) == len(learners) and all(each.device.type == "cpu" and each.comm.size == 1 for each in ours)
        self._most = min(cores(), len(learners)) if free else 1
        self._may_start_workers = not any(learner.config.compiled for learner in ours)  # a worker would compile again
        self._most_here = 1 if one_here else self._most
        self._threads = ThreadPoolExecutor(self._most, "update")
        self.workers: list[UpdateWorker] = []
        self._seconds = 0.0

    def __call__(self, updates: Sequence[UpdateRequest]) -> list[Found]:
        """Make all these updates, no two of one learner; return their metrics in the same order."""
        if len(updates) == 1 or self._most == 1:
            return [run_inline(request) for request in updates]
        began = time.monotonic()
        free: SimpleQueue[UpdateExecutor] = SimpleQueue()
        small = max(_bytes(request.batch) for request in updates) <= LARGEST
        ready = [worker for worker in self.workers if small and worker.ready]
        here = min(self._most_here, max(1, self._most - len(ready)))
        for executor in [*[run_inline] * here, *ready][: self._most]:
            free.put(executor)

        def make(request: UpdateRequest) -> Found:
            executor = free.get()
            try:
                return executor(request)
            finally:
                free.put(executor)

        found = list(self._threads.map(make, updates))
        self._seconds += time.monotonic() - began
        if self._seconds > PATIENCE and self._may_start_workers and small:
            try:
                self.start_workers(len(updates))
            except OSError:  # no room for another process: threads continue to do the work
                self._may_start_workers = False
        return found

    def start_workers(self, at_once: int) -> None:
        """Start as many workers as `at_once` simultaneous updates can use."""
        while len(self.workers) < min(self._most, at_once) - 1:
            self.workers.append(UpdateWorker())


def _bytes(batch: Batch) -> int:
    return sum(x.nbytes for x in pytree.tree_leaves(batch) if isinstance(x, Tensor))


class UpdateWorker:
    """Process that makes updates for this one, and ends with this process or with this object."""

    def __init__(self) -> None:
        self._pipe, far_end = Pipe()
        about = str(far_end.fileno()), str(torch.get_num_threads()), json.dumps(import_path())
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", BEGIN, *about], stdin=subprocess.DEVNULL, pass_fds=[far_end.fileno()],
            stderr=subprocess.DEVNULL,  # an error there occurs here again, and is reported here
            start_new_session=True,  # Ctrl-C must reach only the parent process
        )  # fmt: skip
        far_end.close()  # so that this end notices the end of the process
        self.pid = process.pid
        self._ready = self._gone = False
        weakref.finalize(self, _end, self._pipe, process)

    @property
    def ready(self) -> bool:
        """Return whether the process has started and is alive."""
        if not self._ready and not self._gone:
            self._ready = self._pipe.poll() and self._hear() == "ready"
        return self._ready and not self._gone

    def __call__(self, request: UpdateRequest) -> Found:
        """Make an update in the worker, or in this thread if the worker has died; then nothing has changed yet."""
        learner = request.learner
        assert isinstance(learner, HappoLearner)  # with others there are no workers
        arrays = pytree.tree_map_only(Tensor, lambda x: x.numpy(), request.batch)
        try:
            self._pipe.send((learner.spec, learner.save(), arrays, request.rests))
        except OSError:
            self._gone = True
        heard = None if self._gone else self._hear()
        if heard is None:
            return run_inline(request)
        found, state, final_memories = heard
        if not isinstance(found, Diverged):
            learner.load(state)
            learner.final_memories = [torch.tensor(x) for x in final_memories]
        return found

    def _hear(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            self._gone = True


def _end(pipe: Connection, process: subprocess.Popen) -> None:
    pipe.close()
    process.kill()
    process.wait()


# In an update worker's process ---------------------------------------------------------------------------------------


def serve_updates(pipe: int, threads: int) -> None:
    """Make updates for the process at the other end of the pipe with this descriptor, until that process ends.

    The number of threads, and the alignment of arrays, which `torch.tensor` copies, are those of the other process:
    either may change the last digit of a sum.
    """
    torch.set_num_threads(threads)
    learners: dict[LearnerSpec, HappoLearner] = {}
    try:
        with Connection(pipe) as heard:
            heard.send("ready")
            while True:
                spec, state, arrays, rests = heard.recv()
                if spec not in learners:
                    learners[spec] = HappoLearner(*spec)
                learner = learners[spec]
                learner.load(state)
                batch = pytree.tree_map_only(np.ndarray, torch.tensor, arrays)
                found = run_inline(UpdateRequest(learner, batch, rests))
                heard.send((found, learner.save(), [x.numpy() for x in learner.final_memories]))
    except (EOFError, OSError):
        os._exit(0)
