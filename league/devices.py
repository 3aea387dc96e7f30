"""Which GPU a worker takes, decided before anything that would take one is imported."""

import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

from league.config.schema import ConfigError


@cache
def gpus() -> tuple[str, ...]:
    """The NVIDIA GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them; none where there is no driver."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(name.strip() for name in visible.split(",") if name.strip())
    return tuple(str(i) for i, _ in enumerate(line for line in _driver("-L") if line.startswith("GPU ")))


def use(numbers: Sequence[int]) -> None:
    """Leave this process, and all that it starts, only these of the GPUs that it may use; none given: all of them.

    Raises ConfigError, one line, for a GPU that is not there or is named twice.
    """
    found = gpus()
    if not numbers:
        return
    if len(set(numbers)) < len(numbers) or max(numbers) >= len(found):
        there = f"there are {len(found)}, numbered from 0" if found else "there is no GPU here"
        asked = ",".join(map(str, numbers))
        raise ConfigError(("devices",), f"--devices {asked}: {there}; name each once, or leave --devices out")
    os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(found[number] for number in numbers)
    gpus.cache_clear()


def take(number: int) -> None:
    """Worker n takes GPU n; where there are fewer GPUs than workers, they share them in turn."""
    found = gpus()
    if found:
        os.environ["CUDA_VISIBLE_DEVICES"] = found[number % len(found)]


class Memory(NamedTuple):
    """How full a GPU is."""

    name: str  # as CUDA_VISIBLE_DEVICES has it
    used: float  # GB
    total: float  # GB


def memory() -> list[Memory]:
    """How full the NVIDIA GPUs of this machine are, whoever uses them; nothing where there is no driver."""
    rows = _driver("--query-gpu=index,memory.used,memory.total", "--format=csv,noheader,nounits")
    found = [row.split(",") for row in rows]
    mib = 2**20 / 1e9
    return [Memory(row[0].strip(), float(row[1]) * mib, float(row[2]) * mib) for row in found if len(row) == 3]


def _driver(*question: str) -> list[str]:
    """What NVIDIA's tool answers, line by line; nothing where there is none."""
    try:
        done = subprocess.run(["nvidia-smi", *question], capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    return done.stdout.splitlines()


def used(backend: str) -> float:
    """Seconds of a device that this process has used by now, from a beginning of its own: for differences.

    A CPU is one device, all its cores: a process that stands back behind another takes little of it, however long that
    takes. What a GPU did in the meantime is not told; there every second counts in which the process waited for it.
    """
    from arenas.cores import cores  # not for a query, which asks this module for a GPU's memory alone

    return time.process_time() / cores() if backend == "cpu" else time.monotonic()


def lacks_to_compile() -> str:
    """What torch.compile needs and does not find here; empty where there is all. Loads torch."""
    named = [os.environ[name] for name in ("CXX", "CC") if name in os.environ]
    if not any(map(shutil.which, [*named, "g++", "c++", "clang++", "gcc", "cc"])):
        return "a C++ compiler"
    return "Triton" if torch_has_cuda() and find_spec("triton") is None else ""


def torch_has_cuda() -> bool:
    """Whether torch can learn on a GPU here; loads torch."""
    import torch

    return torch.cuda.is_available()
