"""Tests for the processes of a league that are alive, by the store and by this host."""

import os
import re
import socket
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from storage.records import Worker
from storage.store import Store

SEEN = 10.0  # seconds without a heartbeat after which a process of another host counts as dead
GRACE = 60.0  # seconds in which a worker that is to stop has to finish its iteration, at least
PATIENCE = 3.0  # times of its newest iteration in which it has to finish one, at least
STARTING = 300.0  # the same for an existing process of this host: compiling can delay heartbeats for long


def exists(pid: int) -> bool:
    """Return whether the process with this id is alive on this host; a zombie is not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    with suppress(OSError, IndexError):  # a system without /proc, or the process has ended meanwhile
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]  # a name may hold anything
        return state not in ("Z", "X")
    return True


class NamedProcess(NamedTuple):
    """A process that holds a lease, by its name `host:pid:...`."""

    host: str
    pid: str  # empty if the name is damaged

    @property
    def dead(self) -> bool:
        """Return whether it is of this host and does not exist any more."""
        is_number = re.fullmatch(r"\d{1,9}", self.pid) is not None
        return self.host == socket.gethostname() and is_number and not exists(int(self.pid))


def process_named(holder: str) -> NamedProcess:
    """Return the process of a name."""
    host, *pid = holder.rsplit(":", 2)
    return NamedProcess(host, pid[0] if pid else "")


def is_dead(holder: str) -> bool:
    """Return whether a process named `host:pid:...` is of this host and does not exist any more."""
    return process_named(holder).dead


def leader(store: Store, league: str) -> str | None:
    """Return the league's manager, `host:pid:manager`; None if there is none, or if it has died on this host."""
    found = store.leader(league)
    return None if found is None or not isinstance(found[0], str) or is_dead(found[0]) else found[0]


def grace(workers: Iterable[Worker]) -> float:
    """Return the seconds in which workers that are to stop have to finish: an iteration may take longer than GRACE.

    One that is killed before it commits its turn loses all iterations of that turn.
    """
    return max([GRACE, *(PATIENCE * worker.status.get("iteration_seconds", 0.0) for worker in workers)])


def processes(store: Store, league: str) -> list[Worker]:
    """Return the live processes of a league: existing ones on this host, and those of other hosts seen recently."""
    here, now = socket.gethostname(), store.now()
    return [w for w in store.workers(league, STARTING) if (exists(w.pid) if w.host == here else now - w.seen < SEEN)]
