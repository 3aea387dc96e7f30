"""tanh for networks that learn on a CPU, where torch's own is slow: it calls Intel's library on CPUs of all makers."""

from typing import Any

import torch
from torch import Tensor

EXACT = (torch.float32, torch.float64)


def tanh(x: Tensor) -> Tensor:
    """Return tanh of x, of any shape, differentiable like torch's own; on a CPU its absolute error is 2e-7 (float32).

    On a CPU tanh x = 2 σ(2x) − 1, because torch vectorises σ itself: 2,048 × 128 numbers in float32 take 0.06 ms, and
    torch's tanh takes 0.58 ms on an AMD core. Compilers and GPUs have a fast tanh; in bfloat16 too few digits would be
    left.
    """
    if x.device.type != "cpu" or x.dtype not in EXACT or torch.compiler.is_compiling():
        return torch.tanh(x)
    return _SigmoidTanh.apply(x)  # pyright: ignore[reportReturnType]


class _SigmoidTanh(torch.autograd.Function):
    """tanh by the sigmoid. Like torch's tanh it saves only its result; a chain of operations would save each one's."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = torch.rsub((x + x).sigmoid_(), -1, alpha=-2)  # three passes through memory
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *above: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(above[0], y)
