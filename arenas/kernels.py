"""Warp's kernels of a model, compiled and loaded by all cores before its step first runs.

Warp compiles a module of kernels where one of them is first launched, so that on a GPU the some 45 of a step are
compiled one after the other. Which they are, a step tells that launches nothing. A kernel that is not found so, or
fails here, is compiled where it is launched, as without this.
"""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import jax
import mujoco
import warp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.warp import ffi

from arenas.cores import cores

WORKERS = 16
"""Threads at most: more than a fourth of the work is under a lock of Warp's, for which more of them would wait."""

Binary = tuple[Any, int]  # a module of Warp's, and the threads of a block, which are compiled into it

_begun: dict[tuple[str, Any, int], Future[Any]] = {}  # on a device, of the whole process: nothing is loaded twice
_one_asks = threading.Lock()


def begin(model: mujoco.MjModel, verbs: Sequence[str], *, contacts: int, rows: int) -> Callable[[], None]:
    """Have threads load the kernels that `verbs` of `mujoco_warp` need; what this returns waits until they have.

    Whatever goes wrong is told and not raised.
    """
    try:
        device = warp.device_from_jax(jax.devices()[0])
        loading = load(needed(model, verbs, device, contacts=contacts, rows=rows), device)
    except Exception as error:  # all of this rests on Warp's insides, which may differ in another version
        _tell(error)
        return lambda: None

    def finish() -> None:
        for (module, block_dim), future in loading.items():
            if error := future.exception():
                _begun.pop((device.alias, module, block_dim), None)
                module.mark_modified()  # or Warp would not try again
                _tell(error)

    return finish


def needed(model: mujoco.MjModel, verbs: Sequence[str], device: Any, *, contacts: int, rows: int) -> list[Binary]:
    """The binaries that `verbs` load on a device, in the order of their first launches.

    One world tells: how many there are, and their room for contacts, decides how much is launched, but not what.
    """
    found: dict[Binary, None] = {(warp.get_module(ffi.__name__), 1 if device.is_cpu else 256): None}  # for any callback
    with warp.ScopedDevice(device), _one_asks:
        m = mujoco_warp.put_model(model)
        m.opt.warn_overflow = 0  # as in MjxEngine: it is compiled into a kernel
        d = mujoco_warp.make_data(model, nworld=1, naconmax=contacts, njmax=rows)
        with _noting(found, device):
            for verb in verbs:
                getattr(mujoco_warp, verb)(m, d)
    return list(found)


def load(binaries: Sequence[Binary], device: Any) -> dict[Binary, Future[Any]]:
    """Have threads compile and load binaries: while NVRTC or LLVM compiles, Python's lock is free."""
    with _one_asks:
        fresh = [binary for binary in binaries if (device.alias, *binary) not in _begun]
        if fresh:
            workers = ThreadPoolExecutor(min(WORKERS, cores()), "kernels")
            for module, block_dim in fresh:
                _begun[device.alias, module, block_dim] = workers.submit(module.load, device, block_dim)
            workers.shutdown(wait=False)  # they end when all is loaded
        return {binary: _begun[(device.alias, *binary)] for binary in binaries}


@contextmanager
def _noting(found: dict[Binary, None], device: Any) -> Iterator[None]:
    """Launches of this thread note what they would load, and end there; loops and branches are gone through once."""

    def note(module: Any, _: Any, block_dim: int | None = None, *args: Any, **options: Any) -> None:
        found[module, block_dim or module.options["block_dim"]] = None  # None is loaded, and Warp launches nothing

    def loop(_: Any, while_body: Callable[..., Any], stream: Any = None, **arguments: Any) -> None:
        while_body(**arguments)

    def branch(_: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **arguments: Any) -> None:
        for body in filter(None, (on_true, on_false)):
            body(**arguments)

    def block_size(kernel: Any, _: Any = None) -> tuple[int, int]:
        if device.is_cuda:  # Warp asks the kernel, which it loads for that
            note(kernel.module, device)
        return 1, 1

    with (
        _here(warp.Module, "load", note),
        _here(warp, "capture_while", loop),
        _here(warp, "capture_if", branch),
        _here(warp, "get_suggested_block_size", block_size),
    ):
        yield


def _here(owner: Any, name: str, instead: Callable[..., Any]) -> Any:
    """Put a function in another's place, for this thread alone: others may be launching."""
    real, thread = getattr(owner, name), threading.get_ident()

    def either(*args: Any, **options: Any) -> Any:
        return (instead if threading.get_ident() == thread else real)(*args, **options)

    return patch.object(owner, name, either)


def _tell(error: BaseException) -> None:
    logging.getLogger(__name__).warning("kernels of Warp are compiled where they are first launched: %r", error)
