"""GPU kernels of this process, as seen by torch's profiler, and the graphs that Warp records."""

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import torch


def profiled(action: Callable[[], object]) -> dict:
    """Profile the GPU while `action()` runs.

    The profiler slows down the host.

    Returns:
        `seconds` of all kernels, copies and fills added up; `at_work`, the seconds in which at least one of them ran,
        because they may run at the same time; `kernels`, how many ran; `launches` by the host; `by_name`, seconds and
        number of runs of each kernel, the longest first.
    """
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        action()
        torch.cuda.synchronize()
    with tempfile.TemporaryDirectory() as folder:
        profile.export_chrome_trace(trace := str(Path(folder, "trace.json")))
        events = json.loads(Path(trace).read_text())["traceEvents"]
    kinds = {kind: [e for e in events if e.get("cat") == kind] for kind in ("kernel", "gpu_memcpy", "gpu_memset")}
    calls = [e["name"] for e in events if e.get("cat") in ("cuda_runtime", "cuda_driver")]
    ran = [e for each in kinds.values() for e in each]
    seconds, runs = Counter[str](), Counter[str]()
    for event in ran:
        seconds[event["name"]] += event["dur"] * 1e-6
        runs[event["name"]] += 1
    return {
        "seconds": sum(seconds.values()),
        "at_work": 1e-6 * _covered([(e["ts"], e["ts"] + e["dur"]) for e in ran]),
        "kernels": len(kinds["kernel"]),
        "launches": sum("LaunchKernel" in name or "GraphLaunch" in name for name in calls),
        "by_name": {name: [round(took, 6), runs[name]] for name, took in seconds.most_common()},
    }


def _covered(intervals: list[tuple[float, float]]) -> float:
    """Return the length of the union of intervals (begin, end)."""
    covered, until = 0.0, 0.0
    for begin, end in sorted(intervals):
        covered += max(0.0, end - max(begin, until))
        until = max(until, end)
    return covered


@contextmanager
def captures() -> Iterator[list[float]]:
    """Yield a list of the seconds of each graph that Warp records meanwhile; it records one for buffers new to it."""
    import warp

    took: list[float] = []
    enter, leave = warp.ScopedCapture.__enter__, warp.ScopedCapture.__exit__

    def begin(capture: warp.ScopedCapture) -> warp.ScopedCapture:
        took.append(-time.perf_counter())
        return enter(capture)

    def end(capture: warp.ScopedCapture, *error: object) -> object:
        left = leave(capture, *error)
        took[-1] += time.perf_counter()
        return left

    with patch.multiple(warp.ScopedCapture, __enter__=begin, __exit__=end):
        yield took
