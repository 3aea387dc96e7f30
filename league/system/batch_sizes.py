"""Default numbers of worlds and of episodes per batch for a device and an arena, for settings that are not given.

There is one table of defaults for training and one for rating. Loads neither jax nor torch: the caller passes the
backend of JAX.
"""

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

from league.config.sections import Rating
from league.system import devices


class Batch(NamedTuple):
    """A batch of rating matches."""

    worlds: int  # episodes played at once, one in each world
    pairings: int  # pairs of snapshots that share the worlds


CPU_WORLDS = 256  # more worlds make updates rarer
GPU_WORLDS: Mapping[str, int] = {"anymal-walk": 2048, "walk": 2048, "block-push-anymal": 2048, "sumo-2v2": 4096}
"""Worlds of training on a GPU that reached a fixed strength soonest, by arena (`experiments/worlds.py` and
`benchmarks/strength.py`)."""
OTHER_GPU_WORLDS = 8192
"""Worlds for arenas without a measurement: below some thousand worlds a GPU is idle between kernel launches."""
RATING: Mapping[str, Batch] = {"cpu": Batch(512, 4), "gpu": Batch(4096, 32)}
"""Rating batches by device. On an H100 a control step of 512 worlds takes 4.4 ms, and one of 4,096 takes 10.6 ms."""
SOON = Batch(1024, 8)
"""Rating batch on a GPU if ratings decide when training ends: half the time per batch, and a third of the games."""
WORLD_BYTES = 1.25e6
"""Bytes of GPU memory per world of training or rating, in total: 2,048 worlds of two ANYmals and two rovers took 3.6 GB
of an H100, including the contexts of two processes, whose size is constant."""


def training(arena: str, backend: str) -> int:
    """Return the number of worlds that training simulates at once on each device, in the arena of that name."""
    if backend != "gpu":
        return CPU_WORLDS
    return _fitting(GPU_WORLDS.get(arena, OTHER_GPU_WORLDS), _gpu_memory())


def batch(rating: Rating, backend: str, soon: bool = False) -> Batch:
    """Return the size of a rating batch: from the settings, or by the device if they leave it open.

    If only one of the two sizes is given, the other follows: worlds are a multiple of 2 × pairings. With `soon` batches
    on a GPU are smaller, so that results come earlier.
    """
    usual = SOON if soon and backend == "gpu" else RATING.get(backend, RATING["cpu"])
    if backend == "gpu":
        usual = usual._replace(worlds=_fitting(usual.worlds, _gpu_memory()))
    least, each = RATING["cpu"].pairings, RATING["gpu"].worlds // RATING["gpu"].pairings
    if rating.worlds is None:
        pairings = rating.pairings or min(usual.pairings, max(least, usual.worlds // each))
        return Batch(-(-usual.worlds // (2 * pairings)) * 2 * pairings, pairings)
    most = min(usual.pairings, max(least, rating.worlds // each))
    fits = (n for n in range(most, 0, -1) if rating.worlds % (2 * n) == 0)
    return Batch(rating.worlds, rating.pairings or next(fits))


def _fitting(worlds: int, memory: float | None) -> int:
    """Halve a number of worlds until they take a fourth of GPU memory, which training, rating and torch share."""
    while memory is not None and worlds > 256 and worlds * WORLD_BYTES > memory / 4:
        worlds //= 2
    return worlds


@cache
def _gpu_memory() -> float | None:
    """Return the bytes of memory of the smallest GPU of this machine; None if unknown."""
    return min((gpu.total * 1e9 for gpu in devices.memory()), default=None)
