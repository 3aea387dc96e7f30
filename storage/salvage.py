"""What is whole in a damaged recording: each chunk has a checksum of its own and can be read alone."""

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

from storage.recording import MAGIC, Recording, RecordingError, read

_KINDS = {
    Opcode.CHUNK: Chunk, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata, Opcode.ATTACHMENT: Attachment,
}  # fmt: skip
_HEAD = 9  # bytes of a record's opcode and length


def salvage(data: bytes, episode: int = 0) -> tuple[Recording, str]:
    """An episode with all steps that are whole, and in words what is missing, "" where nothing is.

    Raises RecordingError, one line, where no step, no header or no arena is left.
    """
    try:
        recording, steps, count = read(_whole_records(data), episode)
    except RecordingError:
        raise
    except Exception as error:  # bytes that anything may have happened to
        raise RecordingError(f"nothing of this recording can be shown: {error!r}") from error
    if not recording.xml:
        raise RecordingError("nothing of this recording can be shown: its arena is damaged")
    return recording, _missing(steps, recording.header.dt, count)


def _missing(steps: np.ndarray, dt: float, count: int | None) -> str:
    there = np.r_[-1, steps, steps[-1] + 1 if count is None else count]
    gaps = [(int(a) + 1, int(b) - 1) for a, b in pairwise(there) if b - a > 1]
    of = "" if count is None else f" of {count:,}"
    told = ", ".join(f"{a:,} to {b:,} ({a * dt:.2f} to {b * dt:.2f} s)" for a, b in gaps)
    unsure = ", and perhaps more after them" if count is None else ""
    return f"steps {told}{of} are missing{unsure}" if gaps else ""


def _whole_records(data: bytes) -> Iterator[Any]:
    """The records that are as they were written, in their order; after a damaged one, the next chunk that is whole.

    Chunks and attachments have checksums. Of the other kinds only those are taken that follow on a whole record: what
    looks like one in the midst of other bytes may be there by chance.
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
    """The record that begins there, None for a kind that is not wanted, and where it ends: there, if it is none."""
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
    except Exception:  # whatever a flipped bit makes a parser stumble over
        return None, at
    return (None, at) if broken else (record, end)
