"""Learning curves as event files of TensorBoard, which hold each iteration once however often they are written.

A file is a function of the curve: an event for each iteration, in its order, with times counted from when the league
was made. So what it lacks follows from its last whole event, and what a killed writer left, half an event too, is
gone on from.
"""

import fcntl
import os
import struct
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from dashboards.errors import ViewerError
from storage.records import CurvePoint

HEAD, CHECKS = struct.Struct("<Q"), 4
"""What stands before an event: its length. A checksum of so many bytes follows that, another one the event itself."""
ITERATION = "iteration"
"""The figure by which a file says how far it is."""


class Events:
    """A player's event file, open for writing. See `events`."""

    def __init__(self, file: IO[bytes], began: float):
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._new, self._began, self._records, self._name = Event, began, RecordWriter(file), file.name
        self.iteration = 0  # the newest that the file holds
        last, end = next(iter(deque(_whole(file), 1)), (0, 0))
        file.seek(last)
        if end:
            self.iteration = _iteration(Event, file.read(end - last)[HEAD.size + CHECKS : -CHECKS], file.name)
        file.truncate(end)
        file.seek(end)
        if not end:
            self._write(Event(wall_time=began, file_version="brain.Event:2"))

    def extend(self, points: Iterable[CurvePoint]) -> int:
        """Add those that the file does not have, which must come in the order of iterations; how many these were.

        Raises ViewerError where they cannot be written.
        """
        new = [point for point in points if point.iteration > self.iteration]
        for point in new:
            event = self._new(wall_time=self._began + point.seconds, step=point.step)
            for name, value in {ITERATION: point.iteration, **point.values}.items():
                event.summary.value.add(tag=name, simple_value=value)
            self._write(event)
            self.iteration = point.iteration
        self._write()
        return len(new)

    def _write(self, event: Any = None) -> None:
        """An event, or what is still in memory."""
        try:
            if event is None:
                self._records.flush()
            else:
                self._records.write(event.SerializeToString())
        except OSError as error:
            raise _unwritable(self._name, error) from error


def _iteration(kind: Any, data: bytes, name: str) -> int:
    """Which iteration an event tells of; 0 for a file's first, which tells its version."""
    from google.protobuf.message import DecodeError

    try:
        event = kind.FromString(data)
    except DecodeError as error:
        raise ViewerError(f"{name} is damaged: remove it, and it is written anew") from error
    return next((int(value.simple_value) for value in event.summary.value if value.tag == ITERATION), 0)


@contextmanager
def events(folder: Path, began: float) -> Iterator[Events]:
    """A run of TensorBoard in a folder, made if need be, of a league that was made at a time.

    Raises ViewerError where TensorBoard is not installed, the file cannot be written or is damaged, or somebody else
    writes it.
    """
    path = folder / f"events.out.tfevents.{int(began)}.robot-league"
    try:
        import tensorboard.summary.writer.record_writer  # noqa: F401
    except ImportError as error:
        need = f"event files need tensorboard ({error}); install it with: pip install 'robot-league[tensorboard]'"
        raise ViewerError(need) from error
    with _alone(path) as file:
        yield Events(file, began)


def _alone(path: Path) -> IO[bytes]:
    """A file that nobody else writes, made if need be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+b")  # noqa: SIM115
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ViewerError(f"another league log writes {path}: end that one, or give another folder") from error
    except OSError as error:
        raise _unwritable(path, error) from error
    return file


def _unwritable(path: Path | str, error: OSError) -> ViewerError:
    return ViewerError(f"{path} cannot be written: {error.strerror}; make room or give another folder")


def _whole(file: IO[bytes]) -> Iterator[tuple[int, int]]:
    """Where the file's whole events begin and end; what a killed writer left of one is not among them."""
    size, at = os.fstat(file.fileno()).st_size, 0
    while at + HEAD.size <= size:
        file.seek(at)
        end = at + HEAD.unpack(file.read(HEAD.size))[0] + HEAD.size + 2 * CHECKS
        if end > size:
            return
        yield at, end
        at = end
