"""Number of CPU cores that a process may use."""

import os


def cores() -> int:
    """Return the number of cores that this process may run on, as restricted by taskset, Slurm or the like."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
