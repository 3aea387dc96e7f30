"""What actors and critics share when they learn: Adam, its step, minibatches, means, figures.

Only `means` asks the device for numbers: all that comes before it can be replayed as CUDA graphs (`agents/graphs.py`).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import islice
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from agents.parallel import ALONE, Together
from agents.settings import Precision

P = ParamSpec("P")
T = TypeVar("T")
Rows = TypeVar("Rows")  # tensors (B, ...) in lists and tuples

BETAS, EPSILON = (0.9, 0.999), 1e-5
MOST_COMPILED = 256  # networks for which one process compiles a function; torch's own limit of 8 is two teams of four


class Adam:
    """Adam (Kingma and Ba, 2015) for a network, by torch's kernel for all its parameters at once.

    `lr` () is read at each step; it lies, like the moments, on the device of the parameters. Without torch.optim, which
    looks all tensors up anew at each step, 6 % of a small network's update on a CPU, and to tell torch.compile to leave
    it alone imports all of that, 1 to 3 s of a training process's start.
    """

    def __init__(self, network: nn.Module, lr: Tensor):
        self.lr, self.names = lr, [name for name, _ in network.named_parameters()]
        self.parameters: list[Tensor] = list(network.parameters())
        self.steps = [torch.zeros((), device=lr.device) for _ in self.parameters]
        self.first, self.second = ([torch.zeros_like(p) for p in self.parameters] for _ in range(2))  # moments

    def slope(self, loss: Tensor) -> Sequence[Tensor]:
        """The gradient of a loss, parameter by parameter."""
        return torch.autograd.grad(loss, self.parameters)

    @torch.no_grad()
    def step(self, gradient: Sequence[Tensor], taught: Tensor) -> None:
        """Step down a gradient, if `taught` () is 1 and not 0; else all stays as it is, whatever the gradient holds."""
        undone = 1 - taught
        torch._foreach_add_(self.steps, 1)  # pyright: ignore[reportPrivateImportUsage]
        torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
            self.parameters, list(gradient), self.first, self.second, [], self.steps, lr=self.lr, beta1=BETAS[0],
            beta2=BETAS[1], weight_decay=0.0, eps=EPSILON, amsgrad=False, maximize=False, found_inf=undone,
        )  # fmt: skip
        torch._foreach_sub_(self.steps, [undone] * len(self.steps))  # pyright: ignore[reportPrivateImportUsage]

    def tensors(self) -> dict[str, Tensor]:
        """Its state by the names of parameters, complete before its first step too."""
        found = {}
        for name, *each in zip(self.names, self.steps, self.first, self.second, strict=True):
            found |= {f"{name}.{kind}": x for kind, x in zip(("step", "exp_avg", "exp_avg_sq"), each, strict=True)}
        return found


def fused(function: Callable[P, T], on: bool) -> Callable[P, T]:
    """A function whose kernels, and those of its gradient, torch.compile makes few of where that is on.

    It is compiled once for each network, when that first needs it, with all that it calls, which may be fused too.
    Recorded graphs then hold what was compiled.
    """
    if not on:
        return function
    torch.compiler.config.recompile_limit = MOST_COMPILED
    return torch.compile(function, fullgraph=True, dynamic=False)


def step(optimizer: Adam, gradient: Sequence[Tensor], max_grad_norm: float, taught: Tensor) -> Tensor:
    """One step of Adam, if `taught` () is 1 and not 0; returns the norm of the gradient before it was scaled down.

    Where it is compiled it is written out, for torch's own kernels cannot be fused with what stands around them.
    """
    if torch.compiler.is_compiling():
        return _written_out(optimizer, gradient, max_grad_norm, taught > 0)
    norm = nn.utils.get_total_norm(gradient)
    scale = (max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    optimizer.step(torch._foreach_mul(list(gradient), scale), taught)  # pyright: ignore[reportPrivateImportUsage]
    return norm


@torch.no_grad()
def _written_out(optimizer: Adam, gradient: Sequence[Tensor], max_grad_norm: float, on: Tensor) -> Tensor:
    """`step` where it is `on` () bool; else all is kept, whatever the gradient holds.

    What torch._foreach does to a list is one kernel for all of it, into which the rest is fused; a loop's is one each.
    No list may hold two tensors of one parameter: the compiler takes a list's tensors for independent of each other,
    and on a GPU a parameter was moved by what another block of the same kernel had yet to write (torch 2.11).
    """
    lr, (beta1, beta2) = optimizer.lr, BETAS
    norm = torch.cat([g.flatten() for g in gradient]).norm()
    scale = (max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    scaled = torch._foreach_mul(list(gradient), scale)  # pyright: ignore[reportPrivateImportUsage]
    old, new = (optimizer.parameters, optimizer.steps, optimizer.first, optimizer.second), []
    for theta, t, m, v, g in zip(*old, scaled, strict=True):
        t, m, v = t + 1, m.lerp(g, 1 - beta1), v.lerp(g**2, 1 - beta2)
        bias1, bias2 = (-torch.expm1(t * math.log(beta)) for beta in BETAS)  # 1 − βᵗ, with all its digits
        new.append((theta - lr * (m / bias1) / (torch.sqrt(v / bias2) + EPSILON), t, m, v))
    for before, after in zip(old, zip(*new, strict=True), strict=True):
        kept = [torch.where(on, b, a) for a, b in zip(before, after, strict=True)]
        torch._foreach_copy_(before, kept)  # pyright: ignore[reportPrivateImportUsage]
    return norm


def orders(sizes: Sequence[int], passes: int, dice: torch.Generator) -> list[Sequence[Tensor]]:
    """For each of these numbers of rows, and each pass over them, a random order (size,) on the device of the dice."""
    if dice.device.type == "cpu":
        return [[torch.randperm(size, generator=dice) for _ in range(passes)] for size in sizes]
    drawn = {size: iter(sorted_orders(size, passes * sizes.count(size), dice)) for size in dict.fromkeys(sizes)}
    return [list(islice(drawn[size], passes)) for size in sizes]


def sorted_orders(size: int, count: int, dice: torch.Generator) -> Tensor:
    """(count, size) Random orders, as random numbers of 31 bits are sorted; two that are equal stay as they were.

    All at once, where a GPU's `randperm` is a sort for each, of ten kernels.
    """
    keys = torch.randint(2**31 - 1, (count, size), generator=dice, dtype=torch.int32, device=dice.device)
    return keys.argsort(dim=1, stable=True)


def minibatches(rows: Rows, order: Tensor, count: int) -> Iterator[Rows]:
    """The rows (B, ...) of several tensors in this order, in `count` parts."""
    tensors, tree = pytree.tree_flatten(rows)
    for each in zip(*(x.index_select(0, order).chunk(count) for x in tensors), strict=True):
        yield pytree.tree_unflatten(each, tree)


def parts(valid: Tensor, together: Together = ALONE) -> tuple[Tensor, Tensor]:
    """What each decision (B, ...) is worth in a mean over the valid ones, Σ x · part; () 1, or 0 if there are none.

    Then all parts are 0, and so is the mean. The mean is that of all ranks' rows: each rank has a part of the sum.
    """
    (count,) = together.sum(valid.sum())
    return valid / count.clamp(min=1), (count > 0).float()


@contextmanager
def products(precision: Precision) -> Iterator[None]:
    """Matrix products of float32 on a GPU within: of TF32 where the precision is that, else as they are."""
    matmul = torch.backends.cuda.matmul
    before = matmul.fp32_precision
    if precision == "tf32":
        matmul.fp32_precision = "tf32"
    try:
        yield
    finally:
        matmul.fp32_precision = before


def networks(precision: Precision, device: torch.device) -> AbstractContextManager[object]:
    """Networks within compute their products in bfloat16 where the precision is that; what they give is float32."""
    return torch.autocast(device.type, torch.bfloat16) if precision == "bf16" else nullcontext()


class Tally:
    """Figures that minibatches tell, summed up on the device: to read each one a GPU would wait a hundred times."""

    def __init__(self, names: Sequence[str], device: torch.device):
        self.names, self.sums = tuple(names), torch.zeros(len(names) + 1, device=device)  # the last one counts

    def note(self, told: Tensor, **values: Tensor) -> None:
        """Add one of each figure (), if `told` () is 1 and not 0; then they must be finite all the same."""
        each = [values[name].detach().float() for name in self.names]
        self.sums.addcmul_(torch.stack([*each, told]), told)

    def mean(self, name: str, since: Tensor) -> Tensor:
        """() The mean of what was told of a figure since the sums were these; 0 if nothing was."""
        told = self.sums - since
        return told[self.names.index(name)] / told[-1].clamp(min=1.0)


def means(tallies: Sequence[Tally]) -> dict[str, float]:
    """Each figure's mean over all tallies that have it, fetched at once; a figure that nobody told is left out."""
    found: dict[str, tuple[float, float]] = {}
    told = torch.cat([tally.sums for tally in tallies]).tolist()
    for tally in tallies:
        *sums, count = (told.pop(0) for _ in tally.sums)
        for name, total in zip(tally.names, sums, strict=True):
            before = found.get(name, (0.0, 0.0))
            found[name] = before[0] + total, before[1] + count
    return {name: total / count for name, (total, count) in found.items() if count}
