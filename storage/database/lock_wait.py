"""Messages about waiting for the store: a process that waits for a lock in silence looks as if it hangs."""

import math
import sys
import threading
import time
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event

REPORT_SECONDS = 5.0  # waiting time for the store before the first message


def report_wait(what: str) -> None:
    """Print what this process waits for to standard error."""
    print(f"league: waiting: {what}", file=sys.stderr, flush=True)


class RetryReporter:
    """Reporter of the reason why a call is repeated: at once, then each time after twice as long."""

    def __init__(self) -> None:
        self._since, self._last, self._next = -math.inf, -math.inf, 0.0

    def report(self, error: Exception) -> None:
        """Print the error unless it was printed recently; after a quiet period the intervals start again."""
        now = time.monotonic()
        if now - self._last > 2 * REPORT_SECONDS:
            self._since, self._next = now, 0.0
        self._last = now
        if now - self._since >= self._next:
            self._next = max(REPORT_SECONDS, 2 * (now - self._since))
            report_wait(str(error))


class ServerWatch:
    """Reporter of statements that a server has not answered: each time after twice as long.

    A server lets a process wait for a lock in silence, and cannot know that the lock's holder was stopped.
    """

    def __init__(self) -> None:
        self._since: dict[int, float] = {}  # thread -> start of its wait
        self._thread: threading.Thread | None = None

    def attach(self, engine: sa.Engine) -> None:
        """Watch the statements of an engine and their completion."""
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
        reported: dict[int, tuple[float, float]] = {}  # thread -> start of its wait, duration when last reported
        while True:
            time.sleep(REPORT_SECONDS / 5)
            for thread, since in list(self._since.items()):
                waited, (then, last) = time.monotonic() - since, reported.get(thread, (0.0, 0.0))
                if waited >= (2 * last if then == since else REPORT_SECONDS):
                    reported[thread] = since, waited
                    report_wait(f"the server has not answered for {waited:.0f} s; does another process keep a lock?")


SERVER_WATCH = ServerWatch()
"""The watch over all servers that this process queries."""
