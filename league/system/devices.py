"""Choice of GPU for a worker, made before any import that would use a GPU."""

import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

from league.config.schema import ConfigError

ROOM = 8.0  # GB of a GPU that must be free for a process that prepares a stage there; it takes about one


@cache
def gpus() -> tuple[str, ...]:
    """Return the NVIDIA GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them; empty without a driver."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(name.strip() for name in visible.split(",") if name.strip())
    return tuple(str(i) for i, _ in enumerate(line for line in _driver("-L") if line.startswith("GPU ")))


def use(numbers: Sequence[int]) -> None:
    """Restrict this process and its child processes to these of its GPUs; if none are given, keep all.

    Raises ConfigError, one line, for a GPU that does not exist or is named twice.
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
    """Assign GPU n to worker n; if there are fewer GPUs than workers, assign them in turn."""
    found = gpus()
    if found:
        os.environ["CUDA_VISIBLE_DEVICES"] = found[number % len(found)]


def own(backend: str) -> str | None:
    """Return the GPU of this process, as CUDA_VISIBLE_DEVICES names it; None if JAX's `backend` is not a GPU."""
    if backend != "gpu":
        return None
    return os.environ.get("CUDA_VISIBLE_DEVICES", "0").partition(",")[0].strip()


class Memory(NamedTuple):
    """Memory in use on a GPU."""

    name: str  # as CUDA_VISIBLE_DEVICES has it
    used: float  # GB
    total: float  # GB


def memory() -> list[Memory]:
    """Return the memory in use on the NVIDIA GPUs of this machine, by all processes; empty without a driver."""
    mib = 2**20 / 1e9
    rows = driver_rows("index", "memory.used", "memory.total")
    return [Memory(name, float(used) * mib, float(total) * mib) for name, used, total in rows]


def has_room() -> bool:
    """Return whether the first GPU that this process may use has memory for another process; True if nothing tells."""
    first = next(iter(gpus()), None)
    return all(each.total - each.used > ROOM for each in memory() if each.name == first)


def driver_rows(*columns: str) -> list[list[str]]:
    """Return a row of these columns for each NVIDIA GPU of this machine; memory is in MiB. Empty without a driver."""
    rows = _driver(f"--query-gpu={','.join(columns)}", "--format=csv,noheader,nounits")
    found = [[cell.strip() for cell in row.split(",")] for row in rows]
    return [row for row in found if len(row) == len(columns)]


def _driver(*question: str) -> list[str]:
    """Return the lines of output of nvidia-smi; empty if it is missing or fails."""
    try:
        done = subprocess.run(["nvidia-smi", *question], capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    return done.stdout.splitlines()


def used(backend: str) -> float:
    """Return device seconds that this process has used, from an arbitrary start: only differences have a meaning.

    A CPU counts as one device with all its cores, so a process of low priority uses few device seconds, however long it
    runs. The work of a GPU is not measured: every second counts in which the process waited for the GPU.
    """
    from arenas.physics.cpu import cores  # late, because a query uses only `memory` of this module

    return time.process_time() / cores() if backend == "cpu" else time.monotonic()


def lacks_to_compile() -> str:
    """Return the missing requirement of torch.compile; empty if there is none. Loads torch."""
    named = [os.environ[name] for name in ("CXX", "CC") if name in os.environ]
    if not any(map(shutil.which, [*named, "g++", "c++", "clang++", "gcc", "cc"])):
        return "a C++ compiler"
    return "Triton" if torch_has_cuda() and find_spec("triton") is None else ""


def torch_has_cuda() -> bool:
    """Return whether torch can use a GPU here. Loads torch."""
    import torch

    return torch.cuda.is_available()
