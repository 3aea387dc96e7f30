"""Environment variables that jax, XLA, Warp, BLAS and child processes of Python read at their start."""

import os
from itertools import islice
from pathlib import Path


def prepare() -> None:
    """Set the variables before these imports; values set by the user stay. Child processes inherit them."""
    cache = cache_folder()
    # Else a child process would import from its working folder first, even before it has its parent's path.
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # workers, torch and Warp share the GPU
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache / "jax"))
    # By default JAX caches no program that compiles within a second; a start compiles dozens of these.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
    os.environ.setdefault("WARP_CACHE_PATH", str(cache / "warp"))
    # OpenMP threads that spin while they wait use the core of the process that they wait for.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Two BLAS threads spin against each other on matrices as small as those of the ratings.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # MKL promises equal results from run to run only in this mode. On other processors it would multiply more slowly.
    if _is_intel():
        os.environ.setdefault("MKL_CBWR", "AUTO")


def _is_intel() -> bool:
    """Return whether Linux names this processor as Intel's."""
    try:
        with Path("/proc/cpuinfo").open() as found:
            return any("GenuineIntel" in line for line in islice(found, 10))
    except OSError:
        return False


def cache_folder() -> Path:
    """Return the folder that keeps compiled kernels between runs."""
    base = os.environ.get("ROBOT_LEAGUE_CACHE") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "robot-league"
