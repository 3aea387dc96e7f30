"""Physics engines by name; `arenas/physics/engine.py` defines their interface.

| engine | where                       | how                                                          |
|--------|-----------------------------|--------------------------------------------------------------|
| `c`    | CPU, the default there      | `mujoco.batch.Batch` threads behind a callback               |
| `jax`  | any XLA device              | MJX, `impl='jax'`                                            |
| `warp` | NVIDIA GPU, default there   | MJX, `impl='warp'`                                           |
| `none` | where nothing can move      | chosen by itself for arenas without bodies                   |

MuJoCo in C resets a world by itself when numbers become non-finite. That is switched off; such a world is `unstable`.
"""

import os
from collections.abc import Sequence

import jax
import mujoco

from arenas.arena_settings import EngineName, Solver
from arenas.errors import EngineError
from arenas.physics.collisions import check_collisions
from arenas.physics.cpu import cores
from arenas.physics.engine import Engine, StaticEngine
from arenas.physics.mujoco_c import CEngine

THREADS = 4
"""With fewer XLA threads than this, but more than one, MJX in JAX can hang on a CPU."""


def resolve_engine(name: EngineName) -> str:
    """Resolve `auto` to `warp` on an NVIDIA GPU and to `c` elsewhere. Raises EngineError if it cannot run."""
    on_gpu = jax.default_backend() == "gpu"
    if name == "auto":
        return "warp" if on_gpu else "c"
    if name not in ("c", "jax", "warp"):
        raise EngineError(f"unknown engine {name!r}: choose auto, c, jax or warp")
    if name == "jax" and not on_gpu and 1 < _xla_threads() < THREADS:
        raise EngineError(
            f"engine jax can hang on a CPU where XLA has {_xla_threads()} threads, one per core: "
            f"take engine c, or set the environment variable NPROC={THREADS}"
        )
    return name


def _xla_threads() -> int:
    """Return the number of threads in XLA's pool on a CPU.

    jaxlib's batched Cholesky (0.10.2) waits, inside that pool, for work that it gave to the same pool. MJX has two of
    them at once, and on two threads they wait for each other: 500 worlds of two rovers hung in all of three runs. They
    completed with one thread, which does the work itself, and with four.
    """
    asked = os.environ.get("NPROC", "")
    return int(asked) if asked.isdigit() and int(asked) else cores()


def make_engine(
    name: EngineName,
    model: mujoco.MjModel,
    derived: tuple[str, ...] = (),
    pushed: Sequence[int] = (),
    *,
    worlds: int = 1,
    buffers: Solver | None = None,
    threads: int = 0,
) -> Engine:
    """Make an engine by name; it is always `none` for a model in which nothing can move.

    `pushed` are ids of bodies that outer forces push. `buffers` has the sizes of Warp's buffers, `threads` are the C
    engine's (0: all). Raises EngineError, which names the two geoms, if geoms can meet that the engine cannot collide,
    and for anything else in the model that the engine refuses.
    """
    resolved = resolve_engine(name)
    if model.nv == 0:
        return StaticEngine(model, derived)
    check_collisions(model, resolved)
    if resolved == "c":
        return CEngine(model, derived, pushed, threads=threads)
    if resolved == "warp":
        try:
            import warp  # mjx imports it late and fails with a traceback
        except ImportError as error:
            raise EngineError(
                "engine warp needs warp-lang: pip install 'robot-league[cuda]', or use engine c"
            ) from error
        if warp.config.log_level == warp.LOG_INFO:  # avoid a line for each of some 45 modules
            warp.config.log_level = warp.LOG_WARNING
        if jax.config.read("jax_disable_most_optimizations") and jax.default_backend() == "cpu":
            warp.config.optimization_level = 0  # LLVM compiles the kernels too; NVRTC refuses this level
    from arenas.physics.mjx import MjxEngine  # takes seconds to import, so only for MJX and Warp

    try:
        if resolved == "warp":
            return MjxEngine(model, derived, pushed, impl="warp", worlds=worlds, buffers=buffers)
        return MjxEngine(model, derived, pushed, impl="jax")
    except NotImplementedError as error:
        raise EngineError(f"engine {resolved} cannot run this model: {error}; engine c can") from error
