"""Salvage of damaged recordings: each chunk has a checksum of its own and can be read alone."""

import io
import struct
import zlib
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.stream_reader import breakup_chunk

from storage.recordings.recording import MAGIC, Recording, RecordingError, read_episode

_KINDS = {
    Opcode.CHUNK: Chunk, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata, Opcode.ATTACHMENT: Attachment,
}  # fmt: skip
_HEAD = 9  # bytes of a record's opcode and length


def salvage(data: bytes, episode: int = 0) -> tuple[Recording, str]:
    """Return an episode with all undamaged steps, and a description of the missing steps, "" if none are missing.

    Raises RecordingError, one line, if no step, no header or no arena is left.
    """
    try:
        recording, steps, count = read_episode(_whole_records(data), episode)
    except RecordingError:
        raise
    except Exception as error:  # the bytes may be damaged in any way
        raise RecordingError(f"nothing of this recording can be shown: {error!r}") from error
    if not recording.xml:
        raise RecordingError("nothing of this recording can be shown: its arena is damaged")
    return recording, _missing(steps, recording.header.dt, count)


def _missing(steps: np.ndarray, dt: float, count: int | None) -> str:
    there = np.r_[-1, steps, steps[-1] + 1 if count is None else count]
    gaps = [(int(a) + 1, int(b) - 1) for a, b in pairwise(there) if b - a > 1]
    of = "" if count is None else f" of {count:,}"
    spans = ", ".join(f"{a:,} to {b:,} ({a * dt:.2f} to {b * dt:.2f} s)" for a, b in gaps)
    unsure = ", and perhaps more after them" if count is None else ""
    return f"steps {spans}{of} are missing{unsure}" if gaps else ""


def _whole_records(data: bytes) -> Iterator[Any]:
    """Yield the undamaged records in their order; after a damaged record, continue at the next undamaged chunk.

    Chunks and attachments have checksums. Records of other kinds are accepted only directly after an undamaged record:
    elsewhere, bytes may resemble a record by chance.
    """
    at, lost = len(MAGIC), False
    while at + _HEAD <= len(data):
        record, end = _record(data, at)
        if end == at or (lost and not isinstance(record, Chunk)):
            at, lost = data.find(Opcode.CHUNK, at + 1), True
            if at < 0:
                return
            continue
        at, lost = end, False
        if isinstance(record, Chunk):
            yield from breakup_chunk(record)
        elif record is not None:
            yield record


def _record(data: bytes, at: int) -> tuple[Any, int]:
    """Return the record that begins there, None for an unused kind, and its end: the start itself if it is damaged."""
    opcode, length = struct.unpack_from("<BQ", data, at)
    end = at + _HEAD + length
    if end > len(data) or not Opcode.HEADER <= opcode <= Opcode.DATA_END:
        return None, at
    kind, content = _KINDS.get(Opcode(opcode)), data[at + _HEAD : end]
    if kind is None:
        return None, end
    try:
        record = kind.read(ReadDataStream(io.BytesIO(content)))
        if isinstance(record, Chunk):
            breakup_chunk(record, validate_crc=True)
        broken = isinstance(record, Attachment) and zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little")
    except Exception:  # a flipped bit can make a parser raise anything
        return None, at
    return (None, at) if broken else (record, end)
