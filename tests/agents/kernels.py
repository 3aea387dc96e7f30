"""Kernels written down and launched again, on a CPU: what CUDA's graphs do, and with as little promised.

The recorder writes down every kernel with the very tensors that it reads and writes, and the numbers that it was given;
a replay launches them again. What reads a number back, or copies one to the device, is refused, as CUDA refuses it.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

ASKS = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "unique", "equal")


class Recorder(TorchDispatchMode):
    """Runs kernels and writes them down; `replay` runs them once more, the first time excepted: they have just run."""

    def __init__(self) -> None:
        super().__init__()
        self.kernels: list[tuple[Any, tuple, dict, list[torch.Tensor]]] = []
        self.fresh = True

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name = func._schema.name.removeprefix("aten::")
        if name.startswith(ASKS) or (name.startswith("index") and _by_mask(args)):
            raise RuntimeError(f"{name} waits for the device")
        result = func(*args, **(kwargs or {}))
        if not func.is_view:
            self.kernels.append((func, args, kwargs or {}, fresh(func, result)))
        return result

    @torch.no_grad()
    def replay(self) -> None:
        if self.fresh:
            self.fresh = False
            return
        for func, args, kwargs, own in self.kernels:
            for kept, new in zip(own, fresh(func, func(*args, **kwargs)), strict=True):
                kept.copy_(new)


def fresh(func: Any, result: Any) -> list[torch.Tensor]:
    """The tensors that a kernel has made, not those that it was given."""
    returns = func._schema.returns
    each = zip(result if len(returns) > 1 else [result], returns, strict=True) if returns else ()
    leaves = [x for spec, about in each if about.alias_info is None for x in pytree.tree_leaves(spec)]
    return [x for x in leaves if isinstance(x, torch.Tensor)]


def _by_mask(args: tuple) -> bool:
    return any(isinstance(x, torch.Tensor) and x.dtype == torch.bool for x in pytree.tree_leaves(args[1:2]))


class NoNumbers(TorchFunctionMode):
    """Refuses what would copy numbers of the host to the device."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        spec = func in (torch.tensor, torch.as_tensor, torch.from_numpy)
        if spec or (func in (torch.where, torch.Tensor.where) and any(isinstance(x, (int, float)) for x in args)):
            raise RuntimeError(f"{func.__name__} waits for the device")
        return func(*args, **(kwargs or {}))


def record(function: Callable[[], None], pool: object, stream: object) -> Callable[[], None]:
    """Return a function that launches the kernels again, in the place of `agents.devices.cuda_graphs.record`."""
    recorder = Recorder()
    with recorder, NoNumbers():
        function()
    return recorder.replay
