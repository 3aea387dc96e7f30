"""Progress reports of commands during long work."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

EVERY = 5.0  # seconds between two lines of progress if the output is not a terminal


class Progress:
    """Progress of a task: on a terminal one line that changes, elsewhere a line every few seconds."""

    def __init__(self, doing: str):
        self.doing = doing
        self._live = sys.stderr.isatty()
        self._printed = time.monotonic()
        self._shown = False

    def tell(self, what: str, done: int, total: int | None) -> None:
        """Report the progress, if it is time."""
        now = time.monotonic()
        if now - self._printed < (0.2 if self._live else EVERY):
            return
        self._printed, self._shown = now, True
        line = f"{self.doing}: {what} {done:,}" + (f" of {total:,}" if total is not None else "")
        print(f"\r\033[K{line}" if self._live else line, end="" if self._live else "\n", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Clear the line of progress on a terminal."""
        if self._live and self._shown:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
        self._shown = False


@contextmanager
def report_kernels(every: float = 0.2) -> Iterator[None]:
    """Within this context, report the remaining kernels while physics compiles; check every `every` seconds."""
    from arenas.physics.kernels.progress import remaining  # here, because commands that only read do not need it

    over = threading.Event()

    def watch() -> None:
        with Progress("compiling physics kernels") as progress:
            while not over.wait(every):
                left, total = remaining()
                if left:
                    progress.tell("remaining", left, total)
                else:
                    progress.end()

    watching = threading.Thread(target=watch, name="kernels", daemon=True)
    watching.start()
    try:
        yield
    finally:
        over.set()
        watching.join()
