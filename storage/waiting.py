"""Telling whoever watches a process what it waits for: a lock in silence looks like a program that hangs."""

import sys
import threading
import time
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event

SAY_SECONDS = 5.0  # how long a process waits for the store before it says so


def say(what: str) -> None:
    """Tell whoever watches this process what it waits for."""
    print(f"league: waiting: {what}", file=sys.stderr, flush=True)


class Watch:
    """Says, of each statement that a server takes long for, for how long it has by now: each time twice as long.

    A server keeps who waits for a lock waiting in silence, and cannot tell that whoever has it was stopped.
    """

    def __init__(self) -> None:
        self._since: dict[int, float] = {}  # thread -> when it began to wait
        self._thread: threading.Thread | None = None

    def over(self, engine: sa.Engine) -> None:
        """Watch the statements of an engine, and the answers to them."""
        event.listen(engine, "before_cursor_execute", self._begin)
        event.listen(engine, "after_cursor_execute", self._end)
        event.listen(engine, "handle_error", self._end)

    def _begin(self, *_: Any) -> None:
        self._since[threading.get_ident()] = time.monotonic()
        if self._thread is None or not self._thread.is_alive():  # as after a fork
            self._thread = threading.Thread(target=self._look, name="waiting for a server", daemon=True)
            self._thread.start()

    def _end(self, *_: Any) -> None:
        self._since.pop(threading.get_ident(), None)

    def _look(self) -> None:
        said: dict[int, tuple[float, float]] = {}  # thread -> since when it waits, for how long it did by then
        while True:
            time.sleep(SAY_SECONDS / 5)
            for thread, since in list(self._since.items()):
                waited, (then, last) = time.monotonic() - since, said.get(thread, (0.0, 0.0))
                if waited >= (2 * last if then == since else SAY_SECONDS):
                    said[thread] = since, waited
                    say(f"the server has not answered for {waited:.0f} s; does another process keep a lock?")


SERVERS = Watch()
"""Over all servers that this process asks."""
