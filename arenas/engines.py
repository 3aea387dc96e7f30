"""Physics engines by name; `arenas/physics.py` says what each of them can.

| engine | where                       | how                                                          |
|--------|-----------------------------|--------------------------------------------------------------|
| `c`    | CPU, the default there      | `mujoco.batch.Batch` threads behind a callback               |
| `jax`  | any XLA device              | MJX, `impl='jax'`                                            |
| `warp` | NVIDIA GPU, default there   | MJX, `impl='warp'`                                           |
| `none` | where nothing can move      | chosen by itself for arenas without bodies                   |

MuJoCo in C resets a world by itself when numbers go bad; that is switched off, and such a world is told `unstable`.
"""

import os

import jax
import mujoco

from arenas.cores import cores
from arenas.errors import EngineError
from arenas.geometry import refuse
from arenas.native import CEngine
from arenas.options import EngineName
from arenas.physics import Engine, Still

THREADS = 4
"""With fewer threads of XLA's, but more than one, MJX in JAX can stop for ever on a CPU."""


def choose(name: EngineName) -> str:
    """Resolve `auto` to `warp` on an NVIDIA GPU and to `c` elsewhere; say so where a named engine cannot run."""
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
    """Threads in XLA's pool on a CPU.

    jaxlib's batched Cholesky (0.10.2) waits, inside that pool, for work that it gave to the same pool. MJX has two of
    them at once, and on two threads they wait for each other: 500 worlds of two rovers hung in all of three runs. With
    one thread, which does the work itself, and with four they ended.
    """
    asked = os.environ.get("NPROC", "")
    return int(asked) if asked.isdigit() and int(asked) else cores()


def make_engine(
    name: EngineName,
    model: mujoco.MjModel,
    derived: tuple[str, ...] = (),
    *,
    worlds: int = 1,
    contacts: int = 24,
    rows: int = 128,
    threads: int = 0,
) -> Engine:
    """An engine by name; where nothing can move it is `none`, whatever was asked for.

    `contacts` and `rows` are Warp's buffer sizes per world, `threads` the C engine's (0: all). Raises EngineError, with
    the two geoms, where such can meet as the engine cannot collide, and for all else in the model that it refuses.
    """
    resolved = choose(name)
    if model.nv == 0:
        return Still(model, derived)
    refuse(model, resolved)
    if resolved == "c":
        return CEngine(model, derived, threads)
    if resolved == "warp":
        try:
            import warp  # noqa: F401  (mjx imports it late, and then with a traceback)
        except ImportError as error:
            raise EngineError(
                "engine warp needs warp-lang: pip install 'robot-league[cuda]', or use engine c"
            ) from error
    from arenas.xla import MjxEngine  # MJX and Warp take seconds to import, which who steps in C need not wait for

    try:
        if resolved == "warp":
            return MjxEngine(model, derived, impl="warp", worlds=worlds, contacts=contacts, rows=rows)
        return MjxEngine(model, derived, impl="jax")
    except NotImplementedError as error:
        raise EngineError(f"engine {resolved} cannot run this model: {error}; engine c can") from error
