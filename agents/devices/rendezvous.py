"""The meeting of ranks that torchrun, srun or a person has started, on one host or on several.

Rank 0, or torchrun itself, serves a small table of keys at an address (torch's TCPStore). The ranks first agree on a
*meeting*: a fresh prefix for their keys. torchrun keeps its table while it starts ranks again, so keys of ranks that
have died may still be there. A rank therefore writes a random token; rank 0 answers every token with its meeting, and
the rank that has the answer joins. The meeting also carries what the ranks tell each other besides tensors: orders of
rank 0, answers, signs of life. These are text, never pickled objects.
"""

import os
import socket
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from uuid import uuid4

import torch.distributed as dist
from torch.distributed import PrefixStore, TCPStore  # type: ignore[attr-defined]  (exported, and not marked so)

POLL = 0.05  # seconds between two looks for a key
RETRY = 0.5  # seconds between two attempts to reach an address, each of at most CONNECT seconds
CONNECT = 5.0
PARTING = 5.0  # seconds that rank 0 waits until the others have read why they do not fit together
ANYWHERE = ("192.0.2.1", 9)  # an address of no host (RFC 5737), used to find the route that leads outside


class RanksError(Exception):
    """Ranks that do not come together, or that have lost each other; the message is one line for the user.

    `transient`: the same start may succeed later, although nobody changes a setting.
    """

    def __init__(self, message: str, transient: bool = False):
        super().__init__(message)
        self.transient = transient


@dataclass(frozen=True)
class Place:
    """The place of a process among the ranks.

    `served`: torchrun serves the table at the address; otherwise rank 0 does. `local_rank` and `local_size` are those
    on one host.
    """

    rank: int
    size: int
    address: str
    port: int
    local_rank: int = 0
    local_size: int = 1
    served: bool = False


def place_of(environ: Mapping[str, str]) -> Place:
    """Return the place that torchrun's variables give, or without them srun's.

    MASTER_ADDR and MASTER_PORT have no counterpart of srun. Raises RanksError, one line, for a variable that is missing
    or makes no sense.
    """
    first = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    second = ("SLURM_PROCID", "SLURM_NTASKS", "SLURM_LOCALID", "SLURM_NTASKS_PER_NODE")
    names = second if "RANK" not in environ and "SLURM_PROCID" in environ else first
    missing = [n for n in (*names[:2], "MASTER_ADDR", "MASTER_PORT") if not environ.get(n)]
    if missing:
        raise RanksError(f"--ranks: {', '.join(missing)} is not set: start the ranks by torchrun or srun (docs/deploy)")
    rank, size, port = (_number(environ, name) for name in (*names[:2], "MASTER_PORT"))
    if not rank < size:
        raise RanksError(f"--ranks: {names[0]} is {rank}, and {names[1]} is {size}: ranks are counted from 0")
    if not 0 < port < 2**16:
        raise RanksError(f"--ranks: MASTER_PORT is {port}: take one from 1 to 65535")
    local = _number(environ, names[2]) if environ.get(names[2]) else 0
    beside = _number(environ, names[3]) if environ.get(names[3]) else 1
    served = environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    return Place(rank, size, environ["MASTER_ADDR"], port, local, max(1, beside), served)


def _number(environ: Mapping[str, str], name: str) -> int:
    if not environ[name].isascii() or not environ[name].isdigit():
        raise RanksError(f"--ranks: {name} is {environ[name][:80]!r}, which is not a number")
    return int(environ[name])


class Meeting:
    """The keys that the ranks of one meeting share, through one connection.

    Methods raise RuntimeError if the table's host is gone. One thread at a time may use a meeting.
    """

    def __init__(self, place: Place, name: str, table: TCPStore):
        self.place, self.name, self._table = place, name, table
        self.store = PrefixStore(name, table)

    def again(self) -> "Meeting":
        """Return the same meeting through a connection of its own, for another thread."""
        limit = timedelta(seconds=PARTING)
        table = TCPStore(self.place.address, self.place.port, timeout=limit, wait_for_workers=False)
        return Meeting(self.place, self.name, table)

    def tell(self, key: str, text: str) -> None:
        """Write a key."""
        self.store.set(key, text)

    def told(self, key: str) -> str | None:
        """Return the text of a key; None while it is not written."""
        return self.store.get(key).decode() if self.store.check([key]) else None


def meet(place: Place, limit: float) -> Meeting:
    """Return the meeting of all ranks, once all have come.

    Args:
        place: the place of this process.
        limit: seconds in which all must come.

    Raises RanksError, one line: transient if not all came in time; otherwise if they disagree about their number.
    """
    deadline, serves = time.monotonic() + limit, place.rank == 0 and not place.served
    _find(place, serves, deadline, limit)
    try:
        table = TCPStore(
            place.address, place.port, is_master=serves, timeout=timedelta(seconds=limit), wait_for_workers=False
        )
        return (_receive if place.rank == 0 else _join)(place, table, deadline, limit)
    except dist.DistError as error:
        reason = str(error).partition("\n")[0]
        where = f"{place.address}:{place.port}"
        failed = "cannot serve" if serves else "has lost"
        message = f"rank {place.rank} of {place.size} {failed} the table of the ranks at {where}: {reason}"
        raise RanksError(message, transient=True) from error


def _find(place: Place, serves: bool, deadline: float, limit: float) -> None:
    """Wait until the address answers. torch would wait too, and print a page of C++ frames for each attempt."""
    if serves:
        with suppress(socket.gaierror):
            socket.getaddrinfo(place.address, place.port)
            return
        raise RanksError(f"rank 0 of {place.size} finds no address of {place.address} (MASTER_ADDR)", transient=True)
    while True:
        with suppress(OSError), socket.create_connection((place.address, place.port), timeout=CONNECT):
            return
        if time.monotonic() > deadline:
            raise RanksError(_missing(place, limit, "no rank 0"), transient=True)
        time.sleep(RETRY)


def _receive(place: Place, table: TCPStore, deadline: float, limit: float) -> Meeting:
    """Answer those that come, until all ranks of this size have joined."""
    meeting = Meeting(place, uuid4().hex, table)
    arrivals: set[int] = set()
    answered = joined = 0
    sizes = {0: place.size}
    while len(sizes) < place.size:
        came = table.add("arrivals", 0)
        arrivals |= set(range(answered + 1, came + 1))
        answered = came
        for number in [n for n in arrivals if table.check([f"arrival/{n}"])]:
            table.set(f"answer/{table.get(f'arrival/{number}').decode()}", meeting.name)
            arrivals.remove(number)
        while (line := meeting.told(f"joined/{joined + 1}")) is not None:
            joined += 1
            rank, size = map(int, line.split())
            if size != place.size or rank in sizes:
                _refuse(meeting, rank, size, joined)
            sizes[rank] = size
        if time.monotonic() > deadline:
            absent = ", ".join(str(rank) for rank in range(place.size) if rank not in sizes)
            raise RanksError(_missing(place, limit, f"no rank {absent}"), transient=True)
        time.sleep(POLL)
    meeting.tell("verdict", "")
    return meeting


def _refuse(meeting: Meeting, rank: int, size: int, joined: int) -> None:
    """Tell all that have joined why they do not fit together, and raise RanksError."""
    own = meeting.place.size
    reason = f"the ranks disagree about their number: it is {own} for rank 0 and {size} for rank {rank} (WORLD_SIZE)"
    if size == own:
        reason = f"two processes are rank {rank} of {size} (RANK)"
    meeting.tell("verdict", reason)
    deadline = time.monotonic() + PARTING
    while meeting.store.add("read", 0) < joined and time.monotonic() < deadline:
        time.sleep(POLL)
    raise RanksError(reason)


def _join(place: Place, table: TCPStore, deadline: float, limit: float) -> Meeting:
    """Join the meeting of the rank 0 that answers."""
    token = uuid4().hex
    table.set(f"arrival/{table.add('arrivals', 1)}", token)
    _wait(lambda: table.check([f"answer/{token}"]), deadline, _missing(place, limit, "no rank 0"))
    meeting = Meeting(place, table.get(f"answer/{token}").decode(), table)
    meeting.tell(f"joined/{meeting.store.add('joiners', 1)}", f"{place.rank} {place.size}")
    _wait(lambda: meeting.told("verdict") is not None, deadline, _missing(place, limit, "not all ranks"))
    verdict = meeting.told("verdict")
    meeting.store.add("read", 1)
    if verdict:
        raise RanksError(verdict)
    return meeting


def _wait(there: Callable[[], bool], deadline: float, otherwise: str) -> None:
    while not there():
        if time.monotonic() > deadline:
            raise RanksError(otherwise, transient=True)
        time.sleep(POLL)


def _missing(place: Place, limit: float, who: str) -> str:
    where = f"{place.address}:{place.port}"
    return f"rank {place.rank} of {place.size} met {who} at {where} within {limit:g} s"


def interface(address: str) -> str | None:
    """Return the network interface of this host that leads to an address, e.g. eth0; None if that cannot be told.

    It is the loopback only if the address is given as one. A host's own name may stand for a loopback address there, at
    which no other host reaches it: then it is the interface of the default route. Linux only.
    """
    if sys.platform != "linux":
        return None
    given = address == "localhost" or address.startswith("127.") or address == "::1"
    with suppress(OSError):
        local = _source_of((address, 9))
        if local.startswith("127.") or local == "::1":
            if given:
                return "lo"
            local = _source_of(ANYWHERE)
        return next((name for _, name in socket.if_nameindex() if local in _addresses(name)), None)
    return None


def _source_of(target: tuple[str, int]) -> str:
    """Return the address from which this host would send to a target; sends nothing. Raises OSError."""
    family, kind, _, _, where = socket.getaddrinfo(*target, type=socket.SOCK_DGRAM)[0]
    with socket.socket(family, kind) as asked:
        asked.connect(where)
        return asked.getsockname()[0]


def _addresses(name: str) -> set[str]:
    """Return the IPv4 and IPv6 addresses of an interface."""
    import fcntl
    import struct

    found = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked, suppress(OSError):
        answer = fcntl.ioctl(asked, 0x8915, struct.pack("256s", name.encode()[:15]))  # SIOCGIFADDR
        found.add(socket.inet_ntoa(answer[20:24]))
    with suppress(OSError), open("/proc/net/if_inet6") as lines:
        for line in lines:
            number, *_, owner = line.split()
            if owner == name:
                found.add(socket.inet_ntop(socket.AF_INET6, bytes.fromhex(number)))
    return found


def use_route_to(address: str) -> None:
    """Have gloo and NCCL's first messages take the interface that leads to an address, unless the user has chosen."""
    if found := interface(address):
        os.environ.setdefault("GLOO_SOCKET_IFNAME", found)
