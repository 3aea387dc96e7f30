"""The programs of a snapshot as files again, as they were imported or as a learner of one's own exported them."""

from pathlib import Path

from league.queries.query import Open
from league.snapshots.exports.program_export import SUFFIX
from storage.blobs import programs
from storage.errors import StorageError
from storage.maintenance.archive import shortened


def files(league: Open, name: str, base: Path) -> dict[Path, bytes] | None:
    """Return the files of a snapshot that is a program: `base`.onnx for all its agents, or `base`-0.onnx, ... for each.

    None for a snapshot that is none. Raises UnknownName, and StorageError for a Python callable, of which no code is
    stored, and for damaged bytes.
    """
    snapshot = league.snapshot(name)
    if snapshot.script is not None or not programs.is_program(data := league.store.blobs.get(snapshot.digest)):
        return None
    kept, about = programs.from_bytes(data)
    suffix = next((suffix for kind, suffix in SUFFIX.items() if kind == about.get("kind")), None)
    if suffix is None:
        raise StorageError(f"{name} is {shortened(kept[0][0])}, of which no code is stored: take that file.")
    ends = [""] if len(kept) == 1 else [f"-{number}" for number in range(len(kept))]
    return {base.with_name(f"{base.name}{end}{suffix}"): file for end, (_, file) in zip(ends, kept, strict=True)}
