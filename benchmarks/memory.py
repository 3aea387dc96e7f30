"""Memory of long training: the row `memory` of `benchmarks/train.py`."""

import os
from pathlib import Path

import numpy as np
import torch

from benchmarks.loop import Ground

SETTLED = 0.1  # share of the iterations after which one-time allocations are done
GB = 1e9


def memory(ground: Ground) -> dict:
    """Measure memory after each of many iterations of rollout and updates of all teams.

    `device_gb` is the maximum in use on a GPU, by all processes. Allocators keep what they took once, so this is the
    peak of what JAX, torch and Warp needed within an iteration. `ratio` is the mean resident set of the last tenth of
    the iterations over that of the second tenth.
    """
    loop, count = ground.loop, ground.args.iterations
    resident, device = [], []
    for _ in range(count):
        loop.play(loop.learn)
        resident.append(_resident())
        if torch.cuda.is_available():
            free, total = torch.cuda.mem_get_info()
            device.append(total - free)
    part = max(1, int(SETTLED * count))
    settled, last = np.mean(resident[part : 2 * part]), np.mean(resident[-part:])
    slope = np.polyfit(np.arange(count - part), resident[part:], 1)[0] if count > 2 * part else 0.0
    return {
        "iterations": count, "decisions": ground.args.decisions, "ratio": round(float(last / settled), 4),
        "resident_gb": {
            "first": _gb(resident[0]), "settled": _gb(settled), "last": _gb(last), "most": _gb(max(resident))
        },
        "growth_mb_per_1000_iterations": round(1000 * float(slope) / 1e6, 2),
        "device_gb": _gb(max(device)) if device else None,
    }  # fmt: skip


def _resident() -> int:
    """Return the resident set size of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _gb(size: float) -> float:
    return round(float(size) / GB, 4)
