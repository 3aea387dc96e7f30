"""Compilation and loading of a model's Warp kernels on all cores before the first step.

Warp compiles a module of kernels when one of them is first launched, so on a GPU the roughly 45 modules of a step would
compile one after the other. A dry run of the step, which launches nothing, lists them. `Preparation` compiles
them into Warp's cache while the process still imports and builds other things, and loads them from there. A kernel
that this list misses, or that fails here, is compiled at its launch, as usual.
"""

import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property, partial
from subprocess import Popen
from typing import Any
from unittest.mock import patch

import jax
import mujoco
import warp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.warp import ffi
from warp._src import build

from arenas.physics.cpu import cores
from arenas.physics.kernels import progress, tile_solvers

WORKERS = 16
"""Maximum number of threads: only a few modules take long to compile, and their code is generated one by one."""

Binary = tuple[Any, int]  # a module of Warp, and the threads per block, which are compiled into it
Key = tuple[str, Any, int]  # a device's name, and a binary

# For the whole process: nothing is compiled or loaded twice.
_compilations: dict[Key, Future[Any]] = {}
_loads: dict[Key, Future[Any]] = {}
_lock = threading.Lock()


class Preparation:
    """The kernels that `verbs` of `mujoco_warp` need for a model. Errors are logged and not raised.

    `contacts` and `rows` are the buffers of one world.
    """

    def __init__(self, model: mujoco.MjModel, verbs: Sequence[str], *, contacts: int, rows: int):
        self._of = partial(kernels_of, model, verbs, contacts=contacts, rows=rows)

    @cached_property
    def _found(self) -> tuple[list[Binary], Any]:
        """The binaries, and the device that needs them."""
        device = warp.device_from_jax(jax.devices()[0])
        return self._of(device), device

    def start_compiling(self) -> None:
        """Start to compile into Warp's cache, in threads; load nothing."""
        try:
            threading.Thread(target=self._compile, args=self._found, name="kernels", daemon=True).start()
        except Exception as error:  # this depends on Warp's internals, which may differ in another version
            _warn(error)

    def compile(self) -> None:
        """Compile into Warp's cache, load nothing, and raise the first error of Warp's compilers."""
        for compilation in compile_ahead(*self._found):
            compilation.result()

    def start_loading(self) -> Callable[[], None]:
        """Start to compile what is not compiled, and to load, in threads; return a function that waits for them."""
        try:
            self._compile(*self._found)
            futures = load(*self._found)
        except Exception as error:  # as above
            _warn(error)
            return lambda: None
        return lambda: _finish(futures)

    def _compile(self, binaries: list[Binary], device: Any) -> None:
        try:
            compile_ahead(binaries, device)
        except Exception as error:  # as above; loading compiles then, too
            _warn(error)


def _finish(loads: dict[Key, Future[Any]]) -> None:
    """Wait for loads, and let Warp try again what has failed."""
    for key, future in loads.items():
        if error := future.exception():
            for kept in (_compilations, _loads):
                kept.pop(key, None)
            key[1].mark_modified()  # otherwise Warp would not try again
            _warn(error)


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


def compile_ahead(binaries: Sequence[Binary], device: Any) -> list[Future[Any]]:
    """Compile binaries that are not in Warp's cache in threads: while NVRTC or LLVM compiles, Python's lock is free.

    Those that link solvers of tiles come last, after the processes that build these. Returns the compilations that
    this call has started.
    """
    with _lock:
        fresh = [b for b in binaries if (device.alias, *b) not in {**_compilations, **_loads} and not _kept(b, device)]
        solvers = {binary: _solvers(binary, device) for binary in fresh}
        builds = tile_solvers.start_builds([s for each in solvers.values() for s in each], min(WORKERS, cores()))
        started = []
        with _threads("compile") as threads:
            for binary in sorted(fresh, key=lambda b: (bool(solvers[b]), -len(b[0].kernels))):
                started.append(threads.submit(_compile, binary, device, builds if solvers[binary] else []))
                _compilations[device.alias, *binary] = started[-1]
        return started


def load(binaries: Sequence[Binary], device: Any) -> dict[Key, Future[Any]]:
    """Load binaries in threads, and first wait for those that are being compiled."""

    def loaded(key: Key) -> Any:
        if key in _compilations:
            _compilations[key].exception()  # waits; Warp reports the error, or tries again
        return key[1].load(device, key[2])

    with _lock:
        keys: list[Key] = [(device.alias, *binary) for binary in binaries]
        fresh = [key for key in keys if key not in _loads]
        with _threads("kernels") as threads:
            _loads.update({key: threads.submit(loaded, key) for key in fresh})
        progress.track(_loads[key] for key in fresh)
        return {key: _loads[key] for key in keys}


@contextmanager
def _threads(name: str) -> Iterator[ThreadPoolExecutor]:
    """Yield threads that end when all that was submitted in the context is done."""
    pool = ThreadPoolExecutor(min(WORKERS, cores()), name)
    yield pool
    pool.shutdown(wait=False)


def _options(binary: Binary) -> dict[str, Any]:
    """Return the options with which Warp compiles a binary."""
    module, block_dim = binary
    module.get_module_hash(block_dim)
    return module.resolved_options[block_dim]


def _kept(binary: Binary, device: Any) -> bool:
    """Return whether Warp's cache has a binary."""
    module, block_dim = binary
    folder = os.path.join(warp.config.kernel_cache_dir or "", module.get_module_identifier(block_dim))
    return os.path.exists(os.path.join(folder, module._get_compile_output_name(device, block_dim=block_dim)))


def _solvers(binary: Binary, device: Any) -> list[tile_solvers.Solver]:
    """Return the solvers of tiles that a binary links."""
    found: list[tile_solvers.Solver] = []
    module, _ = binary
    if device.is_cuda and any("tile_" in kernel.adj.source for kernel in module._get_live_kernels()):
        options = {**_options(binary), "output_arch": module._get_compile_arch(device)}
        with _patched_in_this_thread(build, "build_lto_solver", tile_solvers.recorder(found)):
            module._run_codegen(options, False)
    return found


def _compile(binary: Binary, device: Any, waits_for: Sequence[Popen[bytes]]) -> None:
    """Compile a binary into Warp's cache after the end of these processes, unless another process just did."""
    tile_solvers.await_builds(waits_for)
    if not _kept(binary, device):
        binary[0]._compile(device, options=_options(binary))


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
