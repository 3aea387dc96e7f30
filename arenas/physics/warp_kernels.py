"""Compilation and loading of a model's Warp kernels on all cores before the first step.

Warp compiles a module of kernels when one of them is first launched, so on a GPU the roughly 45 modules of a step would
compile one after the other. A dry run of the step, which launches nothing, lists them. A kernel that this list misses,
or that fails here, is compiled at its launch, as usual.
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

from arenas.physics import kernel_progress
from arenas.physics.cpu import cores

WORKERS = 16
"""Maximum number of threads: more than a fourth of the work holds a lock of Warp, so more threads would only wait."""

Binary = tuple[Any, int]  # a module of Warp, and the threads per block, which are compiled into it

_loads: dict[tuple[str, Any, int], Future[Any]] = {}  # per device, for the whole process: nothing is loaded twice
_lock = threading.Lock()


def start_loading(model: mujoco.MjModel, verbs: Sequence[str], *, contacts: int, rows: int) -> Callable[[], None]:
    """Load the kernels that `verbs` of `mujoco_warp` need in threads; return a function that waits for them.

    Errors are logged and not raised.
    """
    try:
        device = warp.device_from_jax(jax.devices()[0])
        futures = load(kernels_of(model, verbs, device, contacts=contacts, rows=rows), device)
    except Exception as error:  # this depends on Warp's internals, which may differ in another version
        _warn(error)
        return lambda: None

    def finish() -> None:
        for (module, block_dim), future in futures.items():
            if error := future.exception():
                _loads.pop((device.alias, module, block_dim), None)
                module.mark_modified()  # otherwise Warp would not try again
                _warn(error)

    return finish


def kernels_of(model: mujoco.MjModel, verbs: Sequence[str], device: Any, *, contacts: int, rows: int) -> list[Binary]:
    """Return the binaries that `verbs` load on a device, in the order of their first launches.

    One world suffices: the number of worlds and their contacts decide how much is launched, but not which kernels.
    """
    found: dict[Binary, None] = {(warp.get_module(ffi.__name__), 1 if device.is_cpu else 256): None}  # for any callback
    with warp.ScopedDevice(device), _lock:
        m = mujoco_warp.put_model(model)
        m.opt.warn_overflow = 0  # as in MjxEngine: it is compiled into a kernel
        d = mujoco_warp.make_data(model, nworld=1, naconmax=contacts, njmax=rows)
        with _recording_launches(found, device):
            for verb in verbs:
                getattr(mujoco_warp, verb)(m, d)
    return list(found)


def load(binaries: Sequence[Binary], device: Any) -> dict[Binary, Future[Any]]:
    """Compile and load binaries in threads: while NVRTC or LLVM compiles, Python's lock is free."""
    with _lock:
        fresh = [binary for binary in binaries if (device.alias, *binary) not in _loads]
        if fresh:
            workers = ThreadPoolExecutor(min(WORKERS, cores()), "kernels")
            for module, block_dim in fresh:
                _loads[device.alias, module, block_dim] = workers.submit(module.load, device, block_dim)
            workers.shutdown(wait=False)  # they end when all is loaded
            kernel_progress.track(_loads[(device.alias, *binary)] for binary in fresh)
        return {binary: _loads[(device.alias, *binary)] for binary in binaries}


@contextmanager
def _recording_launches(found: dict[Binary, None], device: Any) -> Iterator[None]:
    """Make launches of this thread record their binary and return; loops and branches run once."""

    def note(module: Any, _: Any, block_dim: int | None = None, *args: Any, **options: Any) -> None:
        found[module, block_dim or module.options["block_dim"]] = (
            None  # with None as the module's executable, Warp launches nothing
        )

    def loop(_: Any, while_body: Callable[..., Any], stream: Any = None, **arguments: Any) -> None:
        while_body(**arguments)

    def branch(_: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **arguments: Any) -> None:
        for body in filter(None, (on_true, on_false)):
            body(**arguments)

    def block_size(kernel: Any, _: Any = None) -> tuple[int, int]:
        if device.is_cuda:  # Warp asks the kernel and would load it for that
            note(kernel.module, device)
        return 1, 1

    with (
        _patched_in_this_thread(warp.Module, "load", note),
        _patched_in_this_thread(warp, "capture_while", loop),
        _patched_in_this_thread(warp, "capture_if", branch),
        _patched_in_this_thread(warp, "get_suggested_block_size", block_size),
    ):
        yield


def _patched_in_this_thread(owner: Any, name: str, instead: Callable[..., Any]) -> Any:
    """Replace a function for this thread alone, because other threads may be launching."""
    real, thread = getattr(owner, name), threading.get_ident()

    def either(*args: Any, **options: Any) -> Any:
        return (instead if threading.get_ident() == thread else real)(*args, **options)

    return patch.object(owner, name, either)


def _warn(error: BaseException) -> None:
    logging.getLogger(__name__).warning("kernels of Warp are compiled where they are first launched: %r", error)
