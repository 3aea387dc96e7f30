"""Temporary folders that do not outlive their process: the next process removes the folder of a killed one."""

import fcntl
import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

LOCK = "in-use"


@contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """Yield a new folder, removed at the end of the block and after SIGTERM or SIGHUP. Abandoned folders are removed
    too.

    `prefix` begins the folder's name. A folder is in use while a process holds the lock of a file beside it.
    """
    _remove_unused(prefix)
    with tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True) as outer, _exit_on_signals():
        new, lock, folder = Path(outer, "new"), Path(outer, LOCK), Path(outer, "files")
        folder.mkdir()
        new.touch()
        with new.open("rb") as held:
            fcntl.flock(held, fcntl.LOCK_EX)
            new.rename(lock)  # from now on other processes may find it
            yield folder


def _remove_unused(prefix: str) -> None:
    for lock in Path(tempfile.gettempdir()).glob(f"{prefix}*/{LOCK}"):
        with suppress(OSError), lock.open("rb") as unlocked:
            fcntl.flock(unlocked, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(lock.parent, ignore_errors=True)


@contextmanager
def _exit_on_signals() -> Iterator[None]:
    """Have SIGTERM and SIGHUP leave the block by an exception, unless another handler is set."""

    def leave(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    changed = {}
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            with suppress(ValueError):  # not in the main thread
                changed[number] = signal.signal(number, leave)
    try:
        yield
    finally:
        for number, handler in changed.items():
            signal.signal(number, handler)
