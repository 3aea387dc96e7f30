"""The process of a worker: its signals, its device and its threads, the store, and then the lease loop.

Nothing heavy is imported above: `work` first sets the environment variables that jax, XLA and Warp read.
"""

import os
import signal
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from arenas.physics.cpu import cores
from league.config.run_spec import RunSpec
from league.runtime.worker import AWAY, Worker
from league.state.jobs import RatingMatch
from league.system import devices, environment, exit_codes, provenance
from storage.database import lock_wait
from storage.errors import StorageError, Unavailable
from storage.store import Store

if TYPE_CHECKING:
    from league.system.arena_build import Built


@dataclass(frozen=True)
class WorkerSpec:
    """The values that the process of a worker receives."""

    run: RunSpec
    kinds: tuple[str, ...]  # of jobs that it takes
    number: int  # among the workers of these kinds
    parent: int | None  # process id of its manager: the worker ends when that process is gone
    devices: int = 1  # that its jobs use; several devices are used by processes of their own
    leader: str = ""  # without a parent: the league's manager; the worker ends when the league has another one


def work(spec: WorkerSpec, built: "Built | None" = None) -> None:
    """Work on the jobs of the given kinds until a SIGTERM, `league stop`, or the end of the manager.

    A worker with a parent ignores Ctrl-C, since the parent decides. In a worker without one, the first Ctrl-C acts as a
    SIGTERM and the second ends the process. Ends with `exit_codes.UNFIT` if this host cannot do the jobs. `built` is
    an arena that this process has already.
    """
    stopping = stop_by_signals(spec.parent is not None)
    on_stop = signal.getsignal(signal.SIGTERM)
    if spec.parent is not None:  # a manager that ends the worker need not wait for its imports
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if spec.devices == 1:
        devices.take(spec.number)
    environment.prepare()
    provenance.code()  # as it is now; the files may change while this process runs
    config = spec.run.config()
    if spec.kinds == (RatingMatch.kind,):  # rating uses what the learner leaves idle
        os.nice(config.workers.nice)
    import torch

    # Updates alternate with physics, and torch's threads would wake and wait for those of physics: on two cores an
    # update takes 0.39 s with one thread and 0.47 s with two, and the rollout after it 1.5 s instead of 1.9 s.
    torch.set_num_threads(max(1, cores() // 2))
    name = f"{'+'.join(spec.kinds)} worker"
    signal.signal(signal.SIGTERM, on_stop)
    try:
        with open_store(spec, stopping) as store:
            worker = Worker(store, config, spec, stopping, built)
            worker.run()
    except StorageError as error:  # the manager starts another worker; a person needs the reason, not a traceback
        print(f"league: {name}: {error}", file=sys.stderr, flush=True)
        sys.exit(exit_codes.of(error))
    if worker.unfit:
        report_unfit(worker)
        sys.exit(exit_codes.UNFIT)


def run_process(spec: WorkerSpec, built: "Built | None" = None) -> None:
    """Work as `work` does, in a process of the manager's; end it at once when all is in the store.

    The exit handlers of libraries, and the destruction of what they hold, take seconds for which the manager waits.
    """
    work(spec, built)
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with suppress(OSError):
            stream.flush()
    os._exit(exit_codes.DONE)


def report_unfit(worker: Worker) -> None:
    """Print why a worker cannot do its jobs."""
    name = f"{'+'.join(worker.spec.kinds)} worker {worker.spec.number} on {worker.host}"
    print(f"league: {name} stops, because it cannot do its jobs: {worker.unfit}", file=sys.stderr, flush=True)


def stop_by_signals(has_parent: bool) -> threading.Event:
    """Return an event that a SIGTERM sets, and without a parent also the first Ctrl-C; the second ends the process."""
    stopping = threading.Event()

    def on_interrupt(number: int, frame: object) -> None:
        if stopping.is_set():
            os._exit(130)
        stopping.set()

    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN if has_parent else on_interrupt)
    return stopping


def open_store(spec: WorkerSpec, stopping: threading.Event) -> Store:
    """Open the store; wait while it is away. Raises StorageError; Unavailable if the worker is to stop before."""
    patience = lock_wait.RetryReporter()
    while True:
        try:
            return Store.open(spec.run.store, blobs=spec.run.blobs)
        except Unavailable as error:
            patience.report(error)
            if stopping.wait(AWAY) or (spec.parent is not None and os.getppid() != spec.parent):
                raise
