"""Sharing of a GPU by training and rating matches: they alternate, and matches get their share of any half minute.

If two processes use a GPU at once, the driver gives them time slices by turns, so training ran at half its speed during
a whole batch of matches. Matches are therefore played in stretches of a fraction of a second
(`league/matches/time_slices.py`). `Pace` decides when the next stretch is due, and `GpuLock` gives it exclusive use of
the GPU between two iterations of training.
"""

import fcntl
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

WINDOW = 30.0  # seconds over which the share is measured
SPARE = 2.0  # seconds of lost share that stretches may catch up on, e.g. after a wait for an iteration of training
LOOK = 1.0  # seconds between two checks for training
POLL = 0.001  # seconds between two tries of a lock
LONGEST = 5.0  # seconds that training waits for a stretch at most; a longer stretch hangs
ITERATION = 60.0  # seconds that a stretch waits for an iteration of training at most


class Pace:
    """Timing of the stretches of a batch, which limits them to a share of the time during training.

    After a stretch of s seconds comes a pause, until s / share seconds have passed since the start of the stretch. So
    in any T seconds stretches take at most share × (T + SPARE) seconds plus one stretch.

    Args:
        share: of the time, for stretches; at 1 there is no pause.
        trains: returns whether any player trains; may raise to abort the batch.
        clock: returns seconds.
        sleep: waits for a number of seconds.
    """

    def __init__(
        self,
        share: float,
        trains: Callable[[], bool],
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ):
        self.share, self._clock, self._sleep = share, clock, sleep
        self._ask, self._asked, self._trains = trains, -LOOK, False
        self._due = clock()  # time at which the next stretch is due
        self._played: tuple[tuple[float, float], ...] = ()  # (end, seconds) of recent stretches

    def wait(self) -> None:
        """Wait until a stretch is due; return at once if no player trains."""
        while self._paced():
            now = self._clock()
            self._due = max(self._due, now - SPARE)
            if self.share > 0.0 and self._due <= now:
                return
            self._sleep(min(LOOK, self._due - now) if self.share > 0.0 else LOOK)
        self._due = self._clock()

    def took(self, seconds: float) -> bool:
        """Record the seconds of a stretch. Return True if a player trains and the next stretch is due at once."""
        now = self._clock()
        self._played = (*(each for each in self._played if each[0] > now - WINDOW), (now, seconds))
        if not self._paced():
            return False
        self._due += seconds / self.share if self.share > 0.0 else 0.0
        return self.share > 0.0 and self._due <= self._clock()

    def recent(self) -> float:
        """Return the share of the last WINDOW seconds in which stretches ran. Safe to call from any thread."""
        since = self._clock() - WINDOW
        return sum(end - max(end - seconds, since) for end, seconds in self._played if end > since) / WINDOW

    def _paced(self) -> bool:
        if self._clock() - self._asked >= LOOK:
            self._asked, self._trains = self._clock(), self._ask()
        return self._trains and self.share < 1.0


class GpuLock:
    """Use of a GPU in turn, by locks of the operating system, which end with the process that holds them.

    Iterations of training share the GPU with each other; a stretch of matches has it alone. Training lets a waiting
    stretch go first. All waits have a limit: if a process hangs, or a lock is not available, both continue at once.

    Args:
        device: the GPU, as CUDA_VISIBLE_DEVICES names it; None: there is no GPU, and no wait.
        folder: of the lock files, the same for all processes of a user on this machine.
    """

    def __init__(self, device: str | None, folder: Path | None = None):
        self._files: tuple[int, int] | None = None
        self._patient_from = 0.0  # on the monotonic clock: until then training does not wait
        if device is None:
            return
        name = "".join(c if c.isalnum() else "-" for c in device)
        base = (folder or Path(tempfile.gettempdir())) / f"robot-league-{os.getuid()}-gpu-{name}"
        try:
            self._files = (_opened(base.with_suffix(".waits")), _opened(base.with_suffix(".plays")))
        except OSError:
            self._files = None

    @contextmanager
    def training(self) -> Iterator[None]:
        """Run an iteration of training in the context, after a stretch that has the GPU or waits for it."""
        with ExitStack() as held:
            if self._files is not None and time.monotonic() >= self._patient_from:
                waits, plays = self._files
                until = time.monotonic() + LONGEST
                with ExitStack() as passing:  # lets a waiting stretch go first
                    in_time = _held(passing, waits, fcntl.LOCK_SH, until)
                in_time = in_time and _held(held, plays, fcntl.LOCK_SH, until)
                if not in_time:
                    self._patient_from = time.monotonic() + 60.0
            yield

    @contextmanager
    def playing(self) -> Iterator[None]:
        """Run a stretch of matches in the context, after the current iteration of training."""
        with ExitStack() as held:
            if self._files is not None:
                until = time.monotonic() + ITERATION
                for file in self._files:
                    _held(held, file, fcntl.LOCK_EX, until)
            yield

    def close(self) -> None:
        """Close the lock files."""
        for file in self._files or ():
            os.close(file)
        self._files = None


def _opened(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)


def _held(until_left: ExitStack, file: int, how: int, deadline: float) -> bool:
    """Take a lock until the context ends; return False if it was not available before the deadline."""
    while True:
        try:
            fcntl.flock(file, how | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(POLL)
        except OSError:  # a file system without locks
            return False
        else:
            until_left.callback(fcntl.flock, file, fcntl.LOCK_UN)
            return True
