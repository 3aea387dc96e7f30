"""Which of a league's processes are alive, as far as a store and this host can tell."""

import os
import re
import socket
from contextlib import suppress
from pathlib import Path

from storage.records import Worker
from storage.store import Store

SEEN = 10.0  # seconds without a word after which a process of another host is taken for gone
STARTING = 300.0  # the same for one of this host that exists: compiling may keep it silent for long


def exists(pid: int) -> bool:
    """Whether a process of that number is alive on this host; one that has ended and was not yet waited for is not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    with suppress(OSError, IndexError):  # a system without /proc, or it has gone meanwhile
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]  # a name may hold anything
        return state not in ("Z", "X")
    return True


def place(holder: str) -> tuple[str, str]:
    """The host and the id of a process named `host:pid:...`; of a name that is damaged there is no id."""
    host, *pid = holder.rsplit(":", 2)
    return host, pid[0] if pid else ""


def is_dead(holder: str) -> bool:
    """Whether a process named `host:pid:...` is certainly gone: it was one of this host."""
    host, pid = place(holder)
    return host == socket.gethostname() and re.fullmatch(r"\d{1,9}", pid) is not None and not exists(int(pid))


def leader(store: Store, league: str) -> str | None:
    """The league's manager, `host:pid:manager`, unless nobody leads it or that process of this host has died."""
    found = store.leader(league)
    return None if found is None or not isinstance(found[0], str) or is_dead(found[0]) else found[0]


def processes(store: Store, league: str) -> list[Worker]:
    """The league's processes that are alive: on this host those that exist, elsewhere those that spoke lately."""
    here, now = socket.gethostname(), store.now()
    return [w for w in store.workers(league, STARTING) if (exists(w.pid) if w.host == here else now - w.seen < SEEN)]
