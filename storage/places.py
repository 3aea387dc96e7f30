"""Where stores and their blobs are: folders and URLs, told to users without the passwords in them."""

import os
import re
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from storage.errors import NotAStore, StorageError

BLOBS = "ROBOT_LEAGUE_BLOBS"  # the environment variable that says where blobs are kept
FILE = "league.db"  # the database of a store that is a folder

_SQLITE = b"SQLite format 3\0"  # how its files begin
_POSSIBLE = "a folder, sqlite:///path/to/league.db or postgresql://user@host/database is possible"
_CREDENTIALS = re.compile(r"(?i):.*@|(pass|secret|token)\w*=")  # name:password@host, ?password=
_SECRET = re.compile(r"(?i)pass|secret|token")


def looks_like_url(text: str) -> bool:
    """Whether a place is written as a URL, well or badly; then it is never taken for the name of a folder."""
    if "://" in text or re.match(r"\s*([A-Za-z][A-Za-z0-9+.-]+:|(sqlite|postgres\w*)(\+\w+)?//)", text):
        return True
    return re.match(r"[.~]|/(?!/)", text) is None and _CREDENTIALS.search(text) is not None


def database_url(where: str | os.PathLike[str]) -> sa.URL:
    """The database of a store given by its folder or its URL; a password is only ever in `URL.password`.

    Raises NotAStore for a file in a folder's place, StorageError for a URL that cannot be one of a store.
    """
    text = os.fspath(where)
    if not text.strip():
        raise StorageError(f"An empty text is the place of no store: {_POSSIBLE}.")
    if looks_like_url(text):
        return _parsed(text)
    folder = Path(text).absolute()
    if os.path.isfile(folder):
        raise NotAStore(f"{text} is a file: give the folder of a store, or the database file as sqlite:///{text}.")
    return sa.URL.create("sqlite", database=str(folder / FILE))


def shown(url: sa.URL) -> str:
    """Where a database is, in a user's words: a file's path or a server's URL without its passwords."""
    if url.get_backend_name() == "sqlite":
        return str(Path(url.database or "").absolute())
    query = {name: "***" if _SECRET.search(name) else value for name, value in url.query.items()}
    plain = url.set(drivername=url.get_backend_name(), query=query)
    return plain.render_as_string(hide_password=True).replace("%2A%2A%2A", "***")


def shown_place(where: str) -> str:
    """The place of a store as it was given, less its passwords."""
    return shown(database_url(where)) if looks_like_url(where) else where


def shown_text(text: str) -> str:
    """A URL that may not be well formed, less all that may be a password (a number without `@` is taken for a port)."""
    text = re.sub(r"(?is)((?:pass|secret|token)\w*)=.*", r"\1=***", text)
    start, colon, rest = text.partition(":")
    slashes = "//" if rest.startswith("//") else ""
    before, at, host = rest.rpartition("@")
    if at:  # in a query an `@` may be a password's own
        return f"{start}:{slashes}***" + ("" if "?" in before else f"@{host.partition('?')[0]}")
    rest = re.sub(r":(?!\d+(/|$))[^/]*", ":***", rest.partition("?")[0])
    return f"{start.partition('?')[0]}{colon}{rest}"


def blobs_place(given: str | os.PathLike[str] | None, url: sa.URL) -> str:
    """Where a store's blobs are: as given, else as the environment says, else beside the file of a SQLite store.

    Raises StorageError for a store on a server whose blobs have no place yet.
    """
    if given is not None:
        return os.fspath(given)
    if place := os.environ.get(BLOBS):
        return place
    if url.get_backend_name() == "sqlite":
        return str(Path(shown(url)).parent / "blobs")
    raise StorageError(
        f"{shown(url)}: say where its blobs are kept, a folder that every host sees or s3://bucket/prefix:"
        f" --blobs PLACE, or {BLOBS}."
    )


def are_apart(blobs: str, url: sa.URL) -> bool:
    """Whether blobs are surely of this store alone: beside its SQLite file, where no other database is."""
    if url.get_backend_name() != "sqlite" or looks_like_url(blobs):
        return False
    file = Path(shown(url))
    try:
        others = (
            [path for path in file.parent.iterdir() if path != file and not path.match(copied(file, "*").name)]
            if file.parent.is_dir()
            else []
        )
    except OSError:
        return False
    return Path(blobs).absolute() == file.parent / "blobs" and not any(map(_may_be_database, others))


def copied(database: Path, schema: int | str) -> Path:
    """Where the copy of a SQLite store is kept that was made before it was brought up to date from a schema."""
    return database.with_name(f"{database.name}.schema-{schema}")


def _may_be_database(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return True


def _parsed(text: str) -> sa.URL:
    try:
        url = make_url(text)
        backend = url.get_backend_name()
    except (ArgumentError, ValueError):  # its words may hold the password
        raise StorageError(
            f"{shown_text(text)!r} looks like a URL but is no database's: {_POSSIBLE} "
            "(a folder with such a name as ./name)."
        ) from None
    if backend not in ("sqlite", "postgresql"):
        raise StorageError(f"Cannot keep a store at {shown_text(text)}: {_POSSIBLE}.")
    if backend == "sqlite" and (
        not url.database
        or url.database == ":memory:"
        or url.database.startswith("file:")
        or any((url.host, url.username, url.password))
        or re.match(r"(?s)(?!\.).*:.*@", url.database)  # name:password@host, after slashes too many, or a path
    ):
        raise StorageError("A store is shared by processes: give a file, as in sqlite:///runs/league.db.")
    if re.search(r"(?i)(pass|secret|token)\w*=", text.partition("?")[0]):
        raise StorageError(f"{shown_text(text)!r}: in a URL settings, such as a password, follow a ?; {_POSSIBLE}.")
    server = text.partition("://")[2]
    if backend == "postgresql" and server.count("@") != min(1, re.split("[/?#]", server)[0].count("@")):
        # What is cut at the wrong @ would show a part of the password as the name of the host.
        raise StorageError(f"{shown_text(text)}: in a name or password of a URL, @ / ? # are written %40 %2F %3F %23.")
    if "password" in url.query:  # the driver takes it from there too, and then it wins
        secret = url.query["password"]
        url = url.difference_update_query(["password"]).set(password=secret if isinstance(secret, str) else secret[-1])
    if url.drivername == "postgresql":
        return url.set(drivername="postgresql+psycopg")
    return url
