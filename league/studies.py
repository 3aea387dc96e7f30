"""How learners are updated: several at once on a CPU, each beyond the first in a process of its own.

An update is thousands of short operations, after each of which a thread takes back Python's lock. Two threads so take
half as long again as one, and two processes no longer (docs/speed.md). To such a process, an *assistant*, a learner is
what it is made of, its state and its batch; what it is after the update comes back, and nothing stays there. It begins
once updates have taken `PATIENCE`, for it takes its time to be there: short runs never see one. Until then, and where
one has died, threads do its work.
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
from agents.happo import Learner, Made
from arenas.cores import cores

PATIENCE = 3.0  # seconds of updates
LARGEST = 64 * 2**20  # bytes of a batch that an assistant gets: it is there three times then, which nobody has counted
BEGIN = "import json, sys; pipe, threads, path = sys.argv[1:]; sys.path[:] = json.loads(path); import league.studies"
BEGIN += "; league.studies.assist(int(pipe), int(threads))"

Found = dict[str, float] | Diverged


class Study(NamedTuple):
    """An update to be made: whose, from what, and whether its policy rests, so that its critic alone learns."""

    learner: Learner
    batch: Batch
    rests: bool = False


class Way(Protocol):
    """Where an update is made."""

    def __call__(self, study: Study) -> Found:
        """Its figures, or why its learner must go back to a good state."""
        ...


def here(study: Study) -> Found:
    """Make an update in this thread."""
    try:
        return (study.learner.update_critic_only if study.rests else study.learner.update)(study.batch)
    except Diverged as error:
        return error


class Studies:
    """The updates of a process's learners. Which way one is made changes nothing in what comes of it."""

    def __init__(self, learners: Sequence[Learner]):
        # A GPU is asked by one thread: it is busy with one update. So are ranks, that all may hear the same in order.
        free = all(learner.device.type == "cpu" and learner.together.size == 1 for learner in learners)
        self._most = min(cores(), len(learners)) if free else 1
        self._assisted = not any(learner.config.compiled for learner in learners)  # it would compile once more
        self._threads = ThreadPoolExecutor(self._most, "update")
        self.assistants: list[Assistant] = []
        self._seconds = 0.0

    def __call__(self, studies: Sequence[Study]) -> list[Found]:
        """Make all these updates, no two of one learner; their figures in the same order."""
        if len(studies) == 1 or self._most == 1:
            return [here(study) for study in studies]
        began = time.monotonic()
        idle: SimpleQueue[Way] = SimpleQueue()
        small = max(_bytes(study.batch) for study in studies) <= LARGEST
        ways = [here, *(assistant for assistant in self.assistants if small and assistant.ready)]
        for way in [*ways, *[here] * self._most][: self._most]:
            idle.put(way)

        def make(study: Study) -> Found:
            way = idle.get()
            try:
                return way(study)
            finally:
                idle.put(way)

        found = list(self._threads.map(make, studies))
        self._seconds += time.monotonic() - began
        if self._seconds > PATIENCE and self._assisted and small:
            try:
                self.assist(len(studies))
            except OSError:  # there is no room for another process: threads do as before
                self._assisted = False
        return found

    def assist(self, at_once: int) -> None:
        """Have as many assistants as are of use to so many updates at once."""
        while len(self.assistants) < min(self._most, at_once) - 1:
            self.assistants.append(Assistant())


def _bytes(batch: Batch) -> int:
    return sum(x.nbytes for x in pytree.tree_leaves(batch) if isinstance(x, Tensor))


class Assistant:
    """A process that makes updates for this one, and ends with it or with this object."""

    def __init__(self) -> None:
        self._pipe, theirs = Pipe()
        about = str(theirs.fileno()), str(torch.get_num_threads()), json.dumps(sys.path)
        process = subprocess.Popen(
            [sys.executable, "-c", BEGIN, *about], stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()],
            stderr=subprocess.DEVNULL,  # what goes wrong there does so here again, and is told here
            start_new_session=True,  # Ctrl-C is for who began it
        )  # fmt: skip
        theirs.close()  # so that this end hears when the process is gone
        self.pid = process.pid
        self._ready = self._gone = False
        weakref.finalize(self, _end, self._pipe, process)

    @property
    def ready(self) -> bool:
        """Whether it is there; never again once it has died."""
        if not self._ready and not self._gone:
            self._ready = self._pipe.poll() and self._hear() == "ready"
        return self._ready and not self._gone

    def __call__(self, study: Study) -> Found:
        """The update by this process, or here where that has died over it: then nothing has changed yet."""
        learner = study.learner
        arrays = pytree.tree_map_only(Tensor, lambda x: x.numpy(), study.batch)
        try:
            self._pipe.send((learner.made, learner.state(), arrays, study.rests))
        except OSError:
            self._gone = True
        heard = None if self._gone else self._hear()
        if heard is None:
            return here(study)
        found, state, remembered = heard
        if not isinstance(found, Diverged):
            learner.load(state)
            learner.remembered = [torch.tensor(x) for x in remembered]
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


# In an assistant's process -------------------------------------------------------------------------------------------


def assist(pipe: int, threads: int) -> None:
    """Make updates for the process that holds the other end of the pipe with this descriptor, until that is gone.

    With as many threads and, as `torch.tensor` copies, with numbers that lie as evenly as there: either may change the
    last digit of a sum.
    """
    torch.set_num_threads(threads)
    learners: dict[Made, Learner] = {}
    try:
        with Connection(pipe) as heard:
            heard.send("ready")
            while True:
                made, state, arrays, rests = heard.recv()
                if made not in learners:
                    learners[made] = Learner(*made)
                learner = learners[made]
                learner.load(state)
                batch = pytree.tree_map_only(np.ndarray, torch.tensor, arrays)
                found = here(Study(learner, batch, rests))
                heard.send((found, learner.state(), [x.numpy() for x in learner.remembered]))
    except (EOFError, OSError):
        os._exit(0)
