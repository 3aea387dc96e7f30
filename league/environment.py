"""What jax, XLA, Warp and BLAS read from the environment when they are first imported."""

import os
from pathlib import Path


def prepare() -> None:
    """Set it, before any of them is imported; what the user has set stays. Child processes inherit it."""
    cache = cache_folder()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # workers, torch and Warp share the GPU
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache / "jax"))
    # By default JAX keeps no program that compiled within a second; a start compiles dozens of such.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
    os.environ.setdefault("WARP_CACHE_PATH", str(cache / "warp"))
    # OpenMP threads that spin while they wait take the core from the process that they wait for.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Two BLAS threads spin against each other on matrices as small as those of the ratings.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def cache_folder() -> Path:
    """Where compiled kernels are kept between runs."""
    base = os.environ.get("ROBOT_LEAGUE_CACHE") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "robot-league"
