"""What a GPU does while something runs: its kernels, as torch's profiler sees those of the whole process."""

import json
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import torch


def profiled(verb: Callable[[], object]) -> dict:
    """Seconds of kernels, copies and fills on the GPU, how many kernels ran, and how often the host launched any.

    `by_name` has the seconds and number of runs of each kernel, the longest first. The profiler slows down the host.
    """
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        verb()
        torch.cuda.synchronize()
    with tempfile.TemporaryDirectory() as folder:
        profile.export_chrome_trace(trace := str(Path(folder, "trace.json")))
        events = json.loads(Path(trace).read_text())["traceEvents"]
    kinds = {kind: [e for e in events if e.get("cat") == kind] for kind in ("kernel", "gpu_memcpy", "gpu_memset")}
    calls = [e["name"] for e in events if e.get("cat") in ("cuda_runtime", "cuda_driver")]
    seconds, runs = Counter[str](), Counter[str]()
    for event in (e for each in kinds.values() for e in each):
        seconds[event["name"]] += event["dur"] * 1e-6
        runs[event["name"]] += 1
    return {
        "seconds": sum(seconds.values()),
        "kernels": len(kinds["kernel"]),
        "launches": sum("LaunchKernel" in name or "GraphLaunch" in name for name in calls),
        "by_name": {name: [round(took, 6), runs[name]] for name, took in seconds.most_common()},
    }
