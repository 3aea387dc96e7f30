"""Device code of cuSOLVER's solvers for tiles, built in processes before Warp compiles the kernels that link it.

A kernel that factorises a matrix or solves by it links a part for each solver and size, which takes NVIDIA's libmathdx
about two seconds. Warp has it built while it holds the lock of its code generation, and libmathdx builds one part at a
time in a process, so threads cannot hurry it. Processes put the parts into Warp's cache, where Warp then finds them.

The process of `start_builds` runs this file as a script; it needs no GPU.
"""

import inspect
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import warp
from warp._src import build

LONGEST = 120.0
"""Seconds in which a process has built its solvers, each of which takes some two seconds."""

Solver = dict[str, Any]  # arguments of Warp's `build_lto_solver`, all but its builder


def recorder(found: list[Solver]) -> Callable[..., tuple[str, bytes]]:
    """Return a function in the place of Warp's `build_lto_solver`, which lists its arguments and builds nothing."""
    signature = inspect.signature(build.build_lto_solver)

    def record(*args: Any, **options: Any) -> tuple[str, bytes]:
        arguments = {**signature.bind(*args, **options).arguments}
        arguments.pop("builder")
        found.append(arguments)
        return "recorded", b""

    return record


def start_builds(solvers: Sequence[Solver], processes: int) -> list[subprocess.Popen[bytes]]:
    """Start at most so many processes that build the solvers into Warp's cache.

    A solver that fails there is built by Warp itself later, which then reports the error.
    """
    started, solvers = [], list({json.dumps(solver): solver for solver in solvers}.values())
    path = os.pathsep.join(folder for folder in sys.path if folder)
    variables = {**os.environ, "PYTHONPATH": path, "CUDA_VISIBLE_DEVICES": ""}  # else each takes memory of the GPU
    for first in range(min(processes, len(solvers))):
        request = {"cache": warp.config.kernel_cache_dir, "solvers": solvers[first::processes]}
        process = subprocess.Popen(
            [sys.executable, "-P", __file__], env=variables, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True,  # Ctrl-C is for the parent
        )  # fmt: skip
        assert process.stdin is not None
        with suppress(BrokenPipeError), process.stdin:  # one that has ended already builds nothing
            process.stdin.write(json.dumps(request).encode())
        started.append(process)
    return started


def await_builds(builds: Sequence[subprocess.Popen[bytes]]) -> None:
    """Wait for processes that build; one that hangs for `LONGEST` seconds is ended, and Warp builds its solvers."""
    for process in builds:
        try:
            process.wait(LONGEST)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class _Parts:
    """The parts of a builder that `build_lto_solver` fills."""

    def __init__(self) -> None:
        self.ltoirs, self.ltoirs_decl, self.fatbins = {}, {}, {}


def main(request: Mapping[str, Any]) -> None:
    """Build the solvers of a request."""
    warp.init()
    warp.config.kernel_cache_dir = request["cache"]
    for solver in request["solvers"]:
        build.build_lto_solver(**solver, builder=_Parts())


if __name__ == "__main__":
    signal.alarm(int(LONGEST))  # the process that waits for this one may have been killed
    main(json.load(sys.stdin))
