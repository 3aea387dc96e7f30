"""The file of an entry: JSON with a digest over its content, so that an edited file is noticed.

The digest guards against accidents and careless edits; who forges a file can compute it anew. What stops that is said
in docs/bench.md: ratings are computed again from the rows, and policies are played again from other seeds.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from league.runs.bench import tasks
from league.runs.bench.tasks import Task
from storage.blobs.files import new_file, open_file
from storage.errors import StorageError

FORMAT = 1
LIMIT = 2**24  # bytes
KEYS = (
    "format", "name", "about", "task", "config_hash", "references", "package", "commit", "versions", "device", "engine",
    "seed", "games", "trial", "seconds", "policies", "rows", "attacks", "curve", "metrics", "digest",
)  # fmt: skip
LATER: Mapping[str, Any] = {"track": None}
"""Keys that entries of earlier versions lack, and what they mean there."""
TYPES: Mapping[str, Any] = {
    **dict.fromkeys(("name", "about", "task", "config_hash", "references", "package", "device", "engine"), str),
    **dict.fromkeys(("policies", "rows", "attacks", "curve"), list), "metrics": dict, "games": int, "trial": bool,
    "commit": str | None, "track": str | None,
}  # fmt: skip


class EntryError(StorageError):
    """A file is no entry of the bench, or not as it was written; the message has one line."""


def digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of an entry without its digest."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, allow_nan=False).encode()).hexdigest()


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Write an entry with its digest to a new file. Raises StorageError where the file exists."""
    whole = {**content, "digest": digest(content)}
    text = json.dumps({key: whole[key] for key in (*KEYS, *LATER) if key in whole}, indent=1, allow_nan=False)
    with new_file(path) as file:
        file.write(f"{text}\n".encode())


def read(path: Path) -> dict[str, Any]:
    """Read an entry. Raises EntryError, one line, for a file that is none or was edited, StorageError for none."""
    with open_file(path) as file:
        data = file.read(LIMIT + 1)
    if len(data) > LIMIT:
        raise EntryError(f"{path} has more than {LIMIT:,} bytes, which no entry has.")
    try:
        content = json.loads(data)
        missing = [key for key in KEYS if key not in content]
    except (ValueError, TypeError, RecursionError):
        raise EntryError(f"{path} is no entry of `league bench`: it is not JSON with an object.") from None
    if not isinstance(content, dict) or missing:
        raise EntryError(f"{path} is no entry of `league bench`: it has no {(missing or ['object'])[0]}.")
    if content["format"] != FORMAT:
        raise EntryError(
            f"{path} has format {content['format']!r}, and this program knows {FORMAT}: update robot-league."
        )
    try:
        whole = digest(content) == content["digest"]
    except ValueError:  # a number that is not finite
        whole = False
    if not whole:
        raise EntryError(f"{path} was edited: its content is not that of its digest. Run `league bench` again.")
    content = {**LATER, **content}
    if wrong := [key for key, kind in TYPES.items() if not isinstance(content[key], kind)]:
        raise EntryError(f"{path} is no entry of `league bench`: its {wrong[0]} is of another type.")
    check_task(path, content)
    return content


def check_task(path: Path, content: Mapping[str, Any]) -> Task:
    """Return an entry's task. Raises UnknownName, or EntryError if it was played under another configuration."""
    task = tasks.find(str(content["task"]))
    if content["config_hash"] != task.config_hash:
        raise EntryError(
            f"{path} was played under configuration {content['config_hash']}, and {task.name} is {task.config_hash}."
        )
    if content["track"] not in (None, *task.tracks):
        raise EntryError(f"{path} names the track {content['track']!r}, and {task.name} has {_tracks(task)}.")
    return task


def _tracks(task: Task) -> str:
    return ", ".join(task.tracks) or "none"


def folder(path: Path) -> dict[Path, dict[str, Any]]:
    """Read all entries of a folder, by file. Raises EntryError, one line, for a folder without one, or as `read`."""
    if not path.is_dir():
        raise EntryError(f"{path} is no folder: give the folder with the entries' JSON files.")
    files = sorted(path.glob("*.json"))
    if not files:
        raise EntryError(f"{path} has no entry: `league bench TASK --entry FILE --out {path}/NAME.json` writes one.")
    return {file: read(file) for file in files}
