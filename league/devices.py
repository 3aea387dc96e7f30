"""Which GPU a worker takes, decided before anything that would take one is imported."""

import os
import subprocess
import time
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


def used(backend: str) -> float:
    """Seconds of a device that this process has used by now, from a beginning of its own: for differences.

    A CPU is one device, all its cores: a process that stands back behind another takes little of it, however long that
    takes. What a GPU did in the meantime is not told; there every second counts in which the process waited for it.
    """
    return time.process_time() / (os.cpu_count() or 1) if backend == "cpu" else time.monotonic()


def torch_has_cuda() -> bool:
    """Whether torch can learn on a GPU here; loads torch."""
    import torch

    return torch.cuda.is_available()
