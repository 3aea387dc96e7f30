"""How a command tells of work that takes a while."""

import sys
import time
from typing import Self

EVERY = 5.0  # seconds between two lines of progress where the output is no terminal


class Progress:
    """Tells how far a work has come: on a terminal in one line that changes, elsewhere in a line every few seconds."""

    def __init__(self, doing: str):
        self.doing = doing
        self._live = sys.stderr.isatty()
        self._told = time.monotonic()
        self._shown = False

    def tell(self, what: str, done: int, total: int | None) -> None:
        """Say it, if it is time."""
        now = time.monotonic()
        if now - self._told < (0.2 if self._live else EVERY):
            return
        self._told, self._shown = now, True
        line = f"{self.doing}: {what} {done:,}" + (f" of {total:,}" if total is not None else "")
        print(f"\r\033[K{line}" if self._live else line, end="" if self._live else "\n", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Leave a terminal's line as it was found."""
        if self._live and self._shown:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
