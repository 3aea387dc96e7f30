"""Number of kernels that this process still has to compile and load, for progress reports. Imports nothing heavy."""

import threading
from collections.abc import Iterable
from concurrent.futures import Future
from typing import Any

_lock = threading.Lock()
_batch: list[Future[Any]] = []  # all loads started since the last time none was left


def track(futures: Iterable[Future[Any]]) -> None:
    """Count these loads from now on."""
    with _lock:
        if all(future.done() for future in _batch):
            _batch.clear()
        _batch.extend(futures)


def remaining() -> tuple[int, int]:
    """Return the number of kernels still to be loaded and their total; (0, 0) before the first."""
    with _lock:
        return sum(not future.done() for future in _batch), len(_batch)


def describe() -> str:
    """Describe the progress, e.g. `31 of 46 physics kernels remain`; empty while nothing is being loaded."""
    left, total = remaining()
    return f"{left} of {total} physics kernels remain" if left else ""
