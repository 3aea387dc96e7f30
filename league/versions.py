"""The versions that a result depends on, for run records, recordings and benchmarks."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("robot-league", "jax", "mujoco", "mujoco-mjx", "numpy", "torch", "warp-lang")


@cache
def versions() -> dict[str, str]:
    """Package -> version, Python's too; packages that are not installed are left out."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
