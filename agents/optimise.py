"""What actors and critics share when they learn: Adam, its step, minibatches, figures."""

from collections.abc import Iterator

import torch
from torch import Tensor, nn

Figures = dict[str, list[Tensor]]  # name -> what each minibatch said, kept on the device


def adam(module: nn.Module, lr: float) -> torch.optim.Adam:
    """Adam with its moments made at once, where it would make them at its first step: a fresh state is complete too."""
    optimizer = torch.optim.Adam(module.parameters(), lr=lr, eps=1e-5, foreach=True)
    for parameter in module.parameters():
        optimizer.state[parameter] = {
            "step": torch.zeros(()),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return optimizer


def moments(name: str, module: nn.Module, optimizer: torch.optim.Adam | None) -> dict[str, Tensor]:
    """Adam's state as named tensors; none without one."""
    found = {}
    if optimizer is None:
        return found
    for parameter_name, parameter in module.named_parameters():
        found |= {f"{name}.{parameter_name}.{k}": v for k, v in optimizer.state[parameter].items()}
    return found


def step(optimizer: torch.optim.Adam, module: nn.Module, loss: Tensor, max_grad_norm: float, lr: float) -> Tensor:
    """One step of Adam; returns the norm that the gradient had before it was scaled down."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = nn.utils.clip_grad_norm_(module.parameters(), max_grad_norm)
    for group in optimizer.param_groups:
        group["lr"] = lr
    optimizer.step()
    return norm


def minibatches(size: int, parts: int, rng: torch.Generator, device: torch.device) -> Iterator[Tensor]:
    """Row indices of one pass over a batch: a random split into `parts`."""
    yield from torch.randperm(size, generator=rng).to(device).chunk(parts)


def note(figures: Figures, **values: Tensor) -> None:
    """Keep values on the device: reading each one would make the GPU wait a hundred times an update."""
    for name, value in values.items():
        figures.setdefault(name, []).append(value.detach())
