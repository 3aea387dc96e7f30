"""Data parallelism: one learner in several processes, each with its own device and its own part of the worlds.

Every *rank* holds the whole learner and learns from its own rows. All quantities of an update that depend on all rows
are sums: numbers of valid rows, means and deviations, gradients, metrics. Each is summed over the ranks before any
decision depends on it, so that all ranks take the same step and end with the same bytes. Values of single rows, such as
M, never leave their rank.
"""

import os
import sys
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed import Store, TCPStore  # type: ignore[attr-defined]  (exported, and not marked so)

from agents.devices import cuda_graphs

T = TypeVar("T")

LOCALHOST = "127.0.0.1"
TIMEOUT = timedelta(minutes=10)  # one rank waits so long for another; compiling lies outside, see `broadcast`


class Communicator:
    """Communication of a learner that has only one process: sums over ranks are its own values."""

    rank, size = 0, 1
    capturable = True  # its messages can be part of a CUDA graph

    def second_channel(self) -> "Communicator":
        """Return the same ranks with a channel of its own for concurrent work.

        Messages of each channel keep their order.
        """
        return self

    def sum(self, *tensors: Tensor) -> Sequence[Tensor]:
        """Return each tensor summed over all ranks, in one message. All have one type and lie on one device."""
        return tensors

    def any(self, flags: Tensor) -> Tensor:
        """Return the flags (n,) bool that are set on any rank."""
        return flags

    def broadcast(self, value: T) -> T:
        """Return rank 0's value. Decisions that depend on a clock or a person are made there."""
        return value

    def gather(self, value: T) -> list[T]:
        """Return the values of all ranks, in the order of ranks."""
        return [value]

    def sum_numbers(self, numbers: list[float]) -> list[float]:
        """Return each number of the host summed over all ranks."""
        return [sum(each) for each in zip(*self.gather(numbers), strict=True)]


SINGLE_PROCESS = Communicator()


class ProcessGroup(Communicator):
    """One of several processes that learn together, connected by a torch process group."""

    def __init__(self, group: Any = None) -> None:
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        self.capturable = False
        self._group, self._second_channel = group, self  # None: torch's default group

    def second_channel(self) -> Communicator:
        """Return these ranks with their second group, once `split` has made it."""
        return self._second_channel

    def split(self) -> None:
        """Create the second group. All ranks must call this at the same time."""
        self._second_channel = ProcessGroup(dist.new_group())

    @torch.no_grad()
    def sum(self, *tensors: Tensor) -> Sequence[Tensor]:
        """Return all sums, sent as one vector because starting a message takes longer than sending it."""
        flat = torch.cat([x.reshape(-1) for x in tensors])
        dist.all_reduce(flat, group=self._group)
        return [part.view_as(x) for part, x in zip(flat.split([x.numel() for x in tensors]), tensors, strict=True)]

    def any(self, flags: Tensor) -> Tensor:
        """Return the flags (n,) bool that are set on any rank."""
        raised = flags.int()
        dist.all_reduce(raised, dist.ReduceOp.MAX, group=self._group)
        return raised.bool()

    def broadcast(self, value: T) -> T:
        """Return rank 0's value, sent through the host."""
        values = [value]
        dist.broadcast_object_list(values, src=0, device=torch.device("cpu"))
        return values[0]

    def gather(self, value: T) -> list[T]:
        """Return the values of all ranks, sent through the host."""
        values: list[T] = [value] * self.size
        dist.all_gather_object(values, value)
        return values


def rendezvous() -> TCPStore:
    """Open a port of this host at which ranks find each other (`port`), for as long as the returned value lives."""
    return TCPStore(LOCALHOST, 0, is_master=True, wait_for_workers=False)


def join(rank: int, size: int, port: int, on_gpus: bool) -> Communicator:
    """Become one of `size` ranks that meet at a port of this host; return when all have joined.

    Each process sees the one GPU that it learns on (NCCL), or none (gloo); messages of the host always use gloo.

    Raises RuntimeError if the others do not come.
    """
    if size == 1:
        return SINGLE_PROCESS
    # All ranks are on this host, whose own name need not lead to an address.
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo" if sys.platform == "linux" else "lo0")
    return connect(TCPStore(LOCALHOST, port, is_master=False, timeout=TIMEOUT), rank, size, on_gpus)


def connect(store: Store, rank: int, size: int, on_gpus: bool) -> Communicator:
    """Become one of `size` ranks that find each other in a table of their own; return when all have joined.

    As `join` does it otherwise. The table must outlive the ranks' work. Raises RuntimeError if the others do not come.
    """
    backend = "cpu:gloo,cuda:nccl" if on_gpus else "gloo"
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=TIMEOUT)
    ranks = ProcessGroup()
    ranks.split()
    for each in (ranks, ranks.second_channel()):
        # The first message opens the connections: now, not in a turn.
        each.any(torch.zeros(1, device="cuda" if on_gpus else "cpu"))
    ranks.capturable = on_gpus and _test_capture(ranks)
    return ranks


def _test_capture(ranks: ProcessGroup) -> bool:
    """Return True if sums captured in CUDA graphs are right each time they are replayed, on all ranks."""
    tried = [_CapturedSum(each) for each in (ranks, ranks.second_channel())]
    if not all(ranks.gather(all(each.replay for each in tried))):
        return False  # a rank that can capture would wait in vain for the others
    return all(ranks.gather(all(each.right() for each in tried)))


class _CapturedSum:
    """A sum over ranks as a CUDA graph; `replay` is None where this torch or NCCL cannot capture it."""

    def __init__(self, ranks: Communicator):
        self.size, self.values = ranks.size, torch.ones(8, device="cuda")
        self.total, self._ranks = torch.zeros_like(self.values), ranks
        self.replay: Callable[[], None] | None = None
        try:
            self.replay = cuda_graphs.record(self._sum, cuda_graphs.new_pool(), cuda_graphs.new_stream())
        except RuntimeError as error:
            print(f"ranks learn without CUDA graphs: {error}", file=sys.stderr)

    def _sum(self) -> None:
        self.total.copy_(self._ranks.sum(self.values)[0])

    def right(self) -> bool:
        """Return True if two replays give the sums of two values."""
        assert self.replay is not None
        found = []
        for value in (1.0, 2.0):
            self.values.fill_(value)
            self.replay()
            found.append(bool((self.total == value * self.size).all()))
        return all(found)
