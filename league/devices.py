"""Which GPU a worker takes, decided before anything that would take one is imported."""

import os
import subprocess
from functools import cache


@cache
def gpus() -> tuple[str, ...]:
    """The NVIDIA GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them; none where there is no driver."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(name.strip() for name in visible.split(",") if name.strip())
    try:
        listing = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return ()
    return tuple(str(i) for i, line in enumerate(line for line in listing.splitlines() if line.startswith("GPU ")))


def take(number: int) -> None:
    """Worker n takes GPU n; where there are fewer GPUs than workers, they share them in turn."""
    found = gpus()
    if found:
        os.environ["CUDA_VISIBLE_DEVICES"] = found[number % len(found)]


def torch_has_cuda() -> bool:
    """Whether torch can learn on a GPU here; loads torch."""
    import torch

    return torch.cuda.is_available()
