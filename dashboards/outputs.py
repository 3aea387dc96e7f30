"""Where pictures, films and rerun's files go: the kinds that there are, and that each appears whole or not at all."""

from contextlib import AbstractContextManager
from pathlib import Path

from dashboards.errors import ViewerError
from storage.files import replaced, require_writable

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
FILMS = (".mp4", ".gif", ".webp")
RERUN = (".rrd",)
_CALLED = {PICTURES: "a picture", FILMS: "a film", RERUN: "a match for rerun"}


def require_kind(path: str | Path, kinds: tuple[str, ...]) -> Path:
    """The path; raises ViewerError where its name does not end as one of PICTURES, FILMS or RERUN does."""
    path = Path(path)
    if path.suffix not in kinds:
        known = ", ".join("*" + kind for kind in kinds)
        raise ViewerError(f"{_CALLED[kinds]} is a file named {known}, not {path.name}")
    return path


def examine(path: str | Path, kinds: tuple[str, ...]) -> None:
    """Raise what `output` would raise at its beginning."""
    require_writable(require_kind(path, kinds))


def output(path: str | Path, kinds: tuple[str, ...]) -> AbstractContextManager[Path]:
    """Where to write what `path` shall be: a file beside it, which takes its place at the end.

    Made at once, so that a place that cannot be written is known before anything is drawn. Raises ViewerError for
    another kind of name, StorageError where it cannot be written.
    """
    return replaced(require_kind(path, kinds))
