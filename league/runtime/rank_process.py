"""The process of a rank that torchrun, srun or a person has started (`league worker --ranks`).

Rank 0 is a train worker that leads the others; they have no lease, no heartbeat in the store, and no decision.
"""

import os
import sys
import threading
from contextlib import suppress
from typing import NoReturn

from agents.devices.rendezvous import Meeting, Place, RanksError, meet, use_route_to
from arenas.physics.cpu import cores
from league.config.experiment import Config
from league.runtime.heartbeat import none_on_error
from league.runtime.worker import Worker
from league.runtime.worker_process import WorkerSpec, open_store, report_unfit, stop_by_signals
from league.system import devices, environment, exit_codes, provenance
from league.training.data_parallel.one_host import on_gpus
from league.training.data_parallel.rank_watch import RankWatch
from league.training.data_parallel.several_hosts import Ranks, first_line, follow
from storage.errors import StorageError
from storage.store import Store

LAST_WORD = 10.0  # seconds in which a process that ends early may still release its lease


def work_as_rank(spec: WorkerSpec, place: Place, limit: float) -> NoReturn:
    """Work as one of the ranks until a stop, and end the process with one of the league's exit codes.

    A SIGTERM or Ctrl-C at any rank has all of them finish the iteration. A rank that gives no sign of life for as long
    as a lease lasts is lost, and all end. `limit` is in seconds: so long this rank waits for the others. Raises
    RanksError, one line, if they do not come together.
    """
    devices.take(place.local_rank)
    environment.prepare()
    provenance.code()  # as it is now; the files may change while this process runs
    config = spec.run.config()
    meeting = meet(place, limit)
    if config.training.devices != place.size:
        raise RanksError(
            f"training.devices of league {config.league} is {config.training.devices}, and {place.size} ranks were"
            " started (WORLD_SIZE): make the two equal"
        )
    try:
        code = _work(spec, config, meeting)
        if code == exit_codes.DONE:
            print(f"Rank {place.rank} no longer works for league {config.league}; what was under way is finished.")
    except (StorageError, RanksError) as error:
        print(f"league: {error}", file=sys.stderr, flush=True)
        code = exit_codes.of(error)
    sys.stdout.flush()
    os._exit(code)  # without the exit handlers of libraries, which may wait for other ranks


def _work(spec: WorkerSpec, config: Config, meeting: Meeting) -> int:
    import torch

    from agents.devices.distributed import connect

    place, stopping = meeting.place, stop_by_signals(has_parent=False)
    torch.set_num_threads(max(1, cores() // place.local_size // 2))  # as in a worker
    use_route_to(place.address)
    with open_store(spec, stopping) as store:
        try:
            comm = connect(meeting.store, place.rank, place.size, on_gpus(config))
        except RuntimeError as error:
            reason = f"rank {place.rank} of {place.size} cannot reach all others: {first_line(error)}"
            raise RanksError(reason, transient=True) from error
        if place.rank == 0:
            return _lead(Ranks(meeting, comm, stopping), spec, config, store, meeting, stopping)
        watch = RankWatch(meeting, stopping, _end_at_once, config.workers.lease)
        watch.start()
        follow(meeting, config, store, comm, watch.end)
        return exit_codes.DONE


def _lead(
    ranks: Ranks, spec: WorkerSpec, config: Config, store: Store, meeting: Meeting, stopping: threading.Event
) -> int:
    """Be the worker of the ranks."""
    worker = Worker(store, config, spec, stopping, ranks=ranks)

    def lost(reason: str) -> None:
        """Return the turn to the queue: the main thread may wait for the lost rank for many minutes."""
        timer = threading.Timer(LAST_WORD, os._exit, [exit_codes.PASSING])
        timer.daemon = True
        timer.start()
        if (lease := worker.lease) is not None:
            none_on_error(store.fail, lease, reason, config.workers.max_attempts)
        _end_at_once(reason)

    watch = RankWatch(meeting, stopping, lost, config.workers.lease)
    watch.start()
    worker.run()
    if not ranks.broken:
        with suppress(Exception):  # a rank that is gone by now has left nothing undone
            ranks.end()
    watch.end()
    if ranks.broken:
        raise RanksError(f"{ranks.broken}: all ranks end, and the turn is done again", transient=True)
    if worker.unfit:
        report_unfit(worker)
        return exit_codes.UNFIT
    return exit_codes.DONE


def _end_at_once(reason: str) -> None:
    print(f"league: {reason}: this rank ends, and the turn is done again", file=sys.stderr, flush=True)
    os._exit(exit_codes.PASSING)
