"""Minibatches: random orders of rows, their parts, and the weights of valid rows in a mean."""

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from agents.devices.distributed import SINGLE_PROCESS, Communicator

Rows = TypeVar("Rows")  # tensors (B, ...) in lists and tuples


def minibatch_orders(sizes: Sequence[int], passes: int, rng: torch.Generator) -> list[Sequence[Tensor]]:
    """Return random orders (size,) on the generator's device: for each number of rows, one per pass."""
    if rng.device.type == "cpu":
        return [[torch.randperm(size, generator=rng) for _ in range(passes)] for size in sizes]
    drawn = {size: iter(random_orders(size, passes * sizes.count(size), rng)) for size in dict.fromkeys(sizes)}
    return [list(islice(drawn[size], passes)) for size in sizes]


def random_orders(size: int, count: int, rng: torch.Generator) -> Tensor:
    """Return random orders (count, size), by a stable sort of random 31-bit integers.

    All orders are sorted at once; a GPU's `randperm` would be a sort of ten kernels for each.
    """
    keys = torch.randint(2**31 - 1, (count, size), generator=rng, dtype=torch.int32, device=rng.device)
    return keys.argsort(dim=1, stable=True)


def minibatches(rows: Rows, order: Tensor, count: int) -> Iterator[Rows]:
    """Yield the rows (B, ...) of several tensors in this order, in `count` parts."""
    tensors, tree = pytree.tree_flatten(rows)
    for each in zip(*(x.index_select(0, order).chunk(count) for x in tensors), strict=True):
        yield pytree.tree_unflatten(each, tree)


def mean_weights(valid: Tensor, comm: Communicator = SINGLE_PROCESS) -> tuple[Tensor, Tensor]:
    """Return weights of decisions (B, ...) in a mean over the valid ones, Σ x · weight, and () 1, or 0 without any.

    Without valid ones all weights are 0, and so is the mean. The mean is that of all ranks' rows; each rank has a part
    of the sum.
    """
    (count,) = comm.sum(valid.sum())
    return valid / count.clamp(min=1), (count > 0).float()
