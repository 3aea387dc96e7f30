"""How many cores a process has."""

import os


def cores() -> int:
    """Cores that this process may run on: the machine's, or fewer where taskset, Slurm or the like say so."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
