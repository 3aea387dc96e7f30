"""Learning curves as event files of TensorBoard, which hold each iteration once however often they are written.

A file is a function of the curve: an event for each iteration, in order, with times counted from the league's creation.
The missing events therefore follow from the file's last whole event. The file of a killed writer, even with a partial
event, is continued.
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
from dashboards.export.run_folders import find_event_file
from storage.records import CurvePoint

HEAD, CHECKS = struct.Struct("<Q"), 4
"""Header of an event, its length, and bytes of a checksum: one follows the header, another one the event."""
ITERATION = "iteration"
"""The tag that states the iteration of an event."""


class EventFile:
    """A player's event file, open for writing. See `open_event_file`."""

    def __init__(self, file: IO[bytes], created: float):
        from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._new, self._created, self._records, self._name = Event, created, RecordWriter(file), file.name
        self.iteration = 0  # the newest iteration in the file
        last, end = next(iter(deque(_whole_events(file), 1)), (0, 0))
        file.seek(last)
        if end:
            self.iteration = _iteration(Event, file.read(end - last)[HEAD.size + CHECKS : -CHECKS], file.name)
        file.truncate(end)
        file.seek(end)
        if not end:
            self._write(Event(wall_time=created, file_version="brain.Event:2"))

    def extend(self, points: Iterable[CurvePoint]) -> int:
        """Add the points that the file does not have; points come in iteration order. Return how many were added.

        Raises ViewerError where they cannot be written.
        """
        new = [point for point in points if point.iteration > self.iteration]
        for point in new:
            event = self._new(wall_time=self._created + point.seconds, step=point.step)
            for name, value in {ITERATION: point.iteration, **point.values}.items():
                event.summary.value.add(tag=name, simple_value=value)
            self._write(event)
            self.iteration = point.iteration
        self._write()
        return len(new)

    def _write(self, event: Any = None) -> None:
        """Write an event, or flush buffered data."""
        try:
            if event is None:
                self._records.flush()
            else:
                self._records.write(event.SerializeToString())
        except OSError as error:
            raise _unwritable(self._name, error) from error


def _iteration(kind: Any, data: bytes, name: str) -> int:
    """Return the iteration of an event; 0 for a file's first event, which states its version."""
    from google.protobuf.message import DecodeError

    try:
        event = kind.FromString(data)
    except DecodeError as error:
        raise ViewerError(f"{name} is damaged: remove it, and it is written again") from error
    return next((int(value.simple_value) for value in event.summary.value if value.tag == ITERATION), 0)


@contextmanager
def open_event_file(folder: Path, created: float, identity: str) -> Iterator[EventFile]:
    """Open a run of TensorBoard in a folder, made if needed, for a league with that identity and creation time.

    Raises ViewerError where TensorBoard is not installed, the file cannot be written or is damaged, or another process
    writes it.
    """
    path = find_event_file(folder, created, identity)
    try:
        import tensorboard.summary.writer.record_writer  # noqa: F401
    except ImportError as error:
        need = f"event files need tensorboard ({error}); install it with: pip install 'robot-league[tensorboard]'"
        raise ViewerError(need) from error
    with _locked_file(path) as file:
        yield EventFile(file, created)


def _locked_file(path: Path) -> IO[bytes]:
    """Open a file that no other process writes, made if needed."""
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


def _whole_events(file: IO[bytes]) -> Iterator[tuple[int, int]]:
    """Yield start and end of the file's whole events; a killed writer's partial event is left out."""
    size, at = os.fstat(file.fileno()).st_size, 0
    while at + HEAD.size <= size:
        file.seek(at)
        end = at + HEAD.unpack(file.read(HEAD.size))[0] + HEAD.size + 2 * CHECKS
        if end > size:
            return
        yield at, end
        at = end
