"""tanh for networks that learn on a CPU, where torch has a slow one: it asks Intel's library, on cores of any make."""

from typing import Any

import torch
from torch import Tensor

EXACT = (torch.float32, torch.float64)


def tanh(x: Tensor) -> Tensor:
    """The tanh of x, of any shape; on a CPU to an absolute 2e-7 (float32), and differentiable as often as torch's own.

    There tanh x = 2 σ(2x) − 1, for σ is torch's own vector code: of 2,048 × 128 numbers in float32 0.06 ms, where tanh
    takes 0.58 ms on an AMD core. Compilers and GPUs have a quick tanh; in bfloat16 too few digits would be left.
    """
    if x.device.type != "cpu" or x.dtype not in EXACT or torch.compiler.is_compiling():
        return torch.tanh(x)
    return _BySigmoid.apply(x)  # pyright: ignore[reportReturnType]


class _BySigmoid(torch.autograd.Function):
    """It remembers what torch's own tanh does, its result; a sum of operations would remember each one's."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = torch.rsub((x + x).sigmoid_(), -1, alpha=-2)  # in three goes through memory
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *above: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(above[0], y)
