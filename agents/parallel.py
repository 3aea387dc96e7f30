"""One learner over several processes, each on a device of its own and with a part of the worlds: data parallelism.

Every *rank* holds the whole learner and learns from its own rows. What an update needs of all rows is a sum over them:
how many count, means and deviations, gradients, figures. Each is summed over the ranks before anything is decided by
it, so all take the same step, and end with the same bytes. What belongs to a row, as M does, never leaves its rank.
"""

import os
import sys
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed import TCPStore  # type: ignore[attr-defined]  (it is exported, and not marked so)

from agents import graphs

T = TypeVar("T")

HERE = "127.0.0.1"
LONGEST = timedelta(minutes=10)  # that one rank waits for another; compiling lies outside, see `first`


class Together:
    """A process that learns alone: there is nobody to add to what it has, and nothing to wait for."""

    rank, size = 0, 1
    recordable = True  # whether what it tells others can be part of a CUDA graph

    def lane(self) -> "Together":
        """The same ranks, for what runs beside something else: its messages keep an order of their own."""
        return self

    def sum(self, *tensors: Tensor) -> Sequence[Tensor]:
        """Each tensor summed over all ranks, in one message; they have one type and lie on the learner's device."""
        return tensors

    def any(self, flags: Tensor) -> Tensor:
        """Which of the flags (n,) bool are set on any rank."""
        return flags

    def first(self, value: T) -> T:
        """What rank 0 has: what a clock or a person decides is decided there."""
        return value

    def gather(self, value: T) -> list[T]:
        """What each rank has, by rank."""
        return [value]

    def add(self, numbers: list[float]) -> list[float]:
        """Each number of the host summed over all ranks."""
        return [sum(each) for each in zip(*self.gather(numbers), strict=True)]


ALONE = Together()


class Ranks(Together):
    """One of several processes that learn together through torch's default process group."""

    def __init__(self, group: Any = None) -> None:
        self.rank, self.size = dist.get_rank(), dist.get_world_size()
        self.recordable = False
        self._group, self._lane = group, self  # none: torch's default group

    def lane(self) -> Together:
        """These ranks by another group, once `split` has made it."""
        return self._lane

    def split(self) -> None:
        """Lay lines of its own for a lane. All ranks do so at the same time."""
        self._lane = Ranks(dist.new_group())

    @torch.no_grad()
    def sum(self, *tensors: Tensor) -> Sequence[Tensor]:
        """All of them as one vector, for a message takes longer to begin than to be sent."""
        flat = torch.cat([x.reshape(-1) for x in tensors])
        dist.all_reduce(flat, group=self._group)
        return [part.view_as(x) for part, x in zip(flat.split([x.numel() for x in tensors]), tensors, strict=True)]

    def any(self, flags: Tensor) -> Tensor:
        """Which are set on any rank."""
        raised = flags.int()
        dist.all_reduce(raised, dist.ReduceOp.MAX, group=self._group)
        return raised.bool()

    def first(self, value: T) -> T:
        """What rank 0 has, through the host."""
        held = [value]
        dist.broadcast_object_list(held, src=0, device=torch.device("cpu"))
        return held[0]

    def gather(self, value: T) -> list[T]:
        """What each has, through the host."""
        held: list[T] = [value] * self.size
        dist.all_gather_object(held, value)
        return held


def meeting_place() -> TCPStore:
    """Where ranks of this host find each other, at `port`; it is there for as long as this value."""
    return TCPStore(HERE, 0, is_master=True, wait_for_workers=False)


def join(rank: int, size: int, port: int, on_gpus: bool) -> Together:
    """Become one of `size` ranks that meet at a port of this host; returns when all are there.

    Each process sees the one GPU that it learns on (NCCL), or none (gloo); numbers of the host go by gloo.
    Raises RuntimeError where the others do not come.
    """
    if size == 1:
        return ALONE
    # All ranks are on this host, whose own name need not lead to an address.
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo" if sys.platform == "linux" else "lo0")
    store = TCPStore(HERE, port, is_master=False, timeout=LONGEST)
    backend = "cpu:gloo,cuda:nccl" if on_gpus else "gloo"
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=LONGEST)
    ranks = Ranks()
    ranks.split()
    for each in (ranks, ranks.lane()):
        each.any(torch.zeros(1, device="cuda" if on_gpus else "cpu"))  # the first message lays the lines: not in a turn
    ranks.recordable = on_gpus and _recordable(ranks)
    return ranks


def _recordable(ranks: Ranks) -> bool:
    """Whether sums that CUDA graphs hold are right each time they are replayed, on all ranks: that is tried."""
    tried = [_Recorded(each) for each in (ranks, ranks.lane())]
    if not all(ranks.gather(all(each.replay for each in tried))):
        return False  # whoever could record would wait in vain for the others
    return all(ranks.gather(all(each.right() for each in tried)))


class _Recorded:
    """A sum over ranks as a CUDA graph; `replay` is None where this torch or NCCL cannot record it."""

    def __init__(self, ranks: Together):
        self.size, self.mine = ranks.size, torch.ones(8, device="cuda")
        self.total, self._ranks = torch.zeros_like(self.mine), ranks
        self.replay: Callable[[], None] | None = None
        try:
            self.replay = graphs.record(self._sum, graphs.new_pool(), graphs.new_stream())
        except RuntimeError as error:
            print(f"ranks learn without CUDA graphs: {error}", file=sys.stderr)

    def _sum(self) -> None:
        self.total.copy_(self._ranks.sum(self.mine)[0])

    def right(self) -> bool:
        """Whether two replays give the sums of two values."""
        assert self.replay is not None
        found = []
        for value in (1.0, 2.0):
            self.mine.fill_(value)
            self.replay()
            found.append(bool((self.total == value * self.size).all()))
        return all(found)
