"""Versions of packages that a result depends on, for run records, recordings and benchmarks."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("robot-league", "jax", "mujoco", "mujoco-mjx", "numpy", "torch", "warp-lang")


@cache
def versions() -> dict[str, str]:
    """Return package -> version, including Python's; packages that are not installed are omitted."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
