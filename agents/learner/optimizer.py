"""The optimizer of actors and critics: Adam, its step, and the precision of products."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from agents.settings import Precision

P = ParamSpec("P")
T = TypeVar("T")
Rows = TypeVar("Rows")  # tensors (B, ...) in lists and tuples

BETAS, EPSILON = (0.9, 0.999), 1e-5
MAX_COMPILED = 256  # networks for which one process compiles a function; torch's limit of 8 is two teams of four


class Adam:
    """Adam (Kingma and Ba, 2015) for a network, by torch's kernel for all its parameters at once.

    `lr` () is read at each step; like the moments it lies on the device of the parameters. It replaces torch.optim,
    which looks up all tensors at each step, 6 % of a small network's update on a CPU, and whose exclusion from
    torch.compile needs imports that add 1 to 3 s to the start of a training process.
    """

    def __init__(self, network: nn.Module, lr: Tensor):
        self.lr, self.names = lr, [name for name, _ in network.named_parameters()]
        self.parameters: list[Tensor] = list(network.parameters())
        self.steps = [torch.zeros((), device=lr.device) for _ in self.parameters]
        self.first, self.second = ([torch.zeros_like(p) for p in self.parameters] for _ in range(2))  # moments

    def gradient(self, loss: Tensor) -> Sequence[Tensor]:
        """Return the gradient of a loss, parameter by parameter."""
        return torch.autograd.grad(loss, self.parameters)

    @torch.no_grad()
    def step(self, gradient: Sequence[Tensor], any_valid: Tensor) -> None:
        """Step down a gradient if `any_valid` () is 1; if it is 0 nothing changes, whatever the gradient holds."""
        undone = 1 - any_valid
        torch._foreach_add_(self.steps, 1)  # pyright: ignore[reportPrivateImportUsage]
        torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
            self.parameters, list(gradient), self.first, self.second, [], self.steps, lr=self.lr, beta1=BETAS[0],
            beta2=BETAS[1], weight_decay=0.0, eps=EPSILON, amsgrad=False, maximize=False, found_inf=undone,
        )  # fmt: skip
        torch._foreach_sub_(self.steps, [undone] * len(self.steps))  # pyright: ignore[reportPrivateImportUsage]

    def tensors(self) -> dict[str, Tensor]:
        """Return its state by parameter name, complete even before the first step."""
        found = {}
        for name, *each in zip(self.names, self.steps, self.first, self.second, strict=True):
            found |= {f"{name}.{kind}": x for kind, x in zip(("step", "exp_avg", "exp_avg_sq"), each, strict=True)}
        return found


def maybe_compiled(function: Callable[P, T], on: bool) -> Callable[P, T]:
    """Return the function, compiled by torch.compile into few kernels together with its gradient if `on`.

    It is compiled once for each network, at its first use, with all functions that it calls, which may be compiled
    themselves. CUDA graphs then capture the compiled kernels.
    """
    if not on:
        return function
    torch.compiler.config.recompile_limit = MAX_COMPILED
    return torch.compile(function, fullgraph=True, dynamic=False)


def step(optimizer: Adam, gradient: Sequence[Tensor], max_grad_norm: float, any_valid: Tensor) -> Tensor:
    """Take one step of Adam if `any_valid` () is 1 and not 0; return the norm of the gradient before clipping.

    Compiled code uses a version in plain operations, because torch's own kernels cannot be fused with others.
    """
    if torch.compiler.is_compiling():
        return _written_out(optimizer, gradient, max_grad_norm, any_valid > 0)
    norm = nn.utils.get_total_norm(gradient)
    scale = (max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    optimizer.step(torch._foreach_mul(list(gradient), scale), any_valid)  # pyright: ignore[reportPrivateImportUsage]
    return norm


@torch.no_grad()
def _written_out(optimizer: Adam, gradient: Sequence[Tensor], max_grad_norm: float, on: Tensor) -> Tensor:
    """Take the same step in plain operations where `on` () bool; otherwise keep everything, whatever the gradient is.

    Each torch._foreach call on a list is one kernel, into which the rest is fused; a loop makes one kernel per element.
    No list may hold two tensors of one parameter: the compiler treats a list's tensors as independent, and on a GPU a
    parameter was moved by values that another block of the same kernel had yet to write (torch 2.11).
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


@contextmanager
def matmul_precision(precision: Precision) -> Iterator[None]:
    """Run the block with this precision of float32 matrix products on a GPU: TF32 for "tf32", otherwise unchanged."""
    matmul = torch.backends.cuda.matmul
    before = matmul.fp32_precision
    if precision == "tf32":
        matmul.fp32_precision = "tf32"
    try:
        yield
    finally:
        matmul.fp32_precision = before


def autocast_networks(precision: Precision, device: torch.device) -> AbstractContextManager[object]:
    """Let networks in the block compute products in bfloat16 if the precision says so; their outputs are float32."""
    return torch.autocast(device.type, torch.bfloat16) if precision == "bf16" else nullcontext()
