"""Programs of others as bytes: a line that names the format, a line of JSON, then the content of files.

The JSON has `files`, each with its name and its number of bytes, and whatever else describes the program.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from storage.errors import StorageError

FIRST = b"robot-league program 1\n"
Files = Sequence[tuple[str, bytes]]  # name and content


def to_bytes(files: Files, about: Mapping[str, Any]) -> bytes:
    """Return the bytes of a program; equal programs have equal bytes."""
    listed = [{"name": name, "bytes": len(data)} for name, data in files]
    head = json.dumps({**about, "files": listed}, sort_keys=True)
    return b"".join([FIRST, head.encode(), b"\n", *(data for _, data in files)])


def is_program(data: bytes) -> bool:
    """Return whether bytes are a program."""
    return data.startswith(FIRST)


def from_bytes(data: bytes) -> tuple[list[tuple[str, bytes]], dict[str, Any]]:
    """Return the files of a program and its description. Raises StorageError for bytes that are none, or damaged."""
    try:
        if not is_program(data):
            raise ValueError("they do not begin like one")
        head, _, rest = data.removeprefix(FIRST).partition(b"\n")
        about, files, at = json.loads(head), [], 0
        for file in about.pop("files"):
            files.append((str(file["name"]), rest[at : at + file["bytes"]]))
            at += file["bytes"]
        if at != len(rest):
            raise ValueError("their files have another size")
        return files, about
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StorageError(f"These {len(data)} bytes are no stored program: {error}") from error
