"""Signs of life of ranks on several hosts: a host that loses power or its network closes no connection."""

import threading
import time
from collections.abc import Callable

from agents.devices.rendezvous import Meeting

BEAT = 1.0  # seconds between two signs of life


class RankWatch:
    """Two threads of a rank: one exchanges signs of life, the other notices that none come.

    Rank 0 watches all others, and each of them watches rank 0. They are two, since a connection to a host that has
    vanished can block its thread for many minutes.
    """

    def __init__(self, meeting: Meeting, stopping: threading.Event, lost: Callable[[str], None], silent: float):
        """Prepare the watch.

        Args:
            meeting: the meeting of the ranks; the watch opens a connection of its own.
            stopping: on rank 0 set as soon as any rank is to stop; on another rank its value is told to rank 0.
            lost: called once with the reason if a rank is lost, from a thread of the watch.
            silent: seconds without a sign of life after which a rank is lost.
        """
        self._meeting, self._stopping, self._lost, self._silent = meeting.again(), stopping, lost, silent
        place = meeting.place
        self._heard = dict.fromkeys(range(1, place.size) if place.rank == 0 else (0,), time.monotonic())
        self._ended, self._lock = threading.Event(), threading.Lock()

    def start(self) -> None:
        """Start both threads."""
        for each in (self._exchange, self._check):
            threading.Thread(target=each, name="rank watch", daemon=True).start()

    def end(self) -> None:
        """End the watch: from now on a rank may go."""
        with self._lock:
            self._ended.set()

    def _exchange(self) -> None:
        meeting, beat, seen = self._meeting, 0, dict.fromkeys(self._heard, "")
        try:
            while not self._ended.wait(BEAT):
                beat += 1
                meeting.tell(f"beat/{meeting.place.rank}", f"{beat} {'stop' if self._stopping.is_set() else ''}")
                for rank in self._heard:
                    told = meeting.told(f"beat/{rank}") or ""
                    if told != seen[rank]:
                        seen[rank], self._heard[rank] = told, time.monotonic()
                    if meeting.place.rank == 0 and told.endswith("stop"):
                        self._stopping.set()
        except RuntimeError:
            self._report("the connection to rank 0 is gone")

    def _check(self) -> None:
        while not self._ended.wait(BEAT):
            for rank, heard in self._heard.items():
                if time.monotonic() - heard > self._silent:
                    self._report(f"rank {rank} of {self._meeting.place.size} was silent for {self._silent:g} s")
                    return

    def _report(self, reason: str) -> None:
        with self._lock:
            if not self._ended.is_set():
                self._ended.set()
                self._lost(reason)
