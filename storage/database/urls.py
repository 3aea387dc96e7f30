"""Locations of stores and their blobs: folders and URLs, shown to users without passwords."""

import os
import re
from pathlib import Path
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from storage.errors import NotAStore, StorageError

BLOBS_VARIABLE = "ROBOT_LEAGUE_BLOBS"  # the environment variable with the location of blobs
DATABASE_FILE = "league.db"  # the database in a store's folder

_SQLITE = b"SQLite format 3\0"  # the first bytes of its files
_POSSIBLE = "a folder, sqlite:///path/to/league.db or postgresql://user@host/database is possible"
_CREDENTIALS = re.compile(r"(?i):.*@|(pass|secret|token)\w*=")  # name:password@host, ?password=
# A URL with a user name or a setting next to which a password may stand.
_PLACE = re.compile(
    r"(?i)(?:\b(?:[a-z][a-z0-9+.-]*://|(?:sqlite|postgres\w*|mysql|s3|file)(?:\+\w+)?[:/]/*)|://)[^\s'\"`]*"
    r"(?:@|(?:pass|secret|token)\w*=)[^\s'\"`]*"
)
# A server's URL with a user name alone, or with a password that is masked already.
_MASKED = re.compile(r"postgresql(\+\w+)?://[\w.-]+(:\*\*\*)?@[^\s'\"`@]*")
# postgresql://name:password@host:port,host:port/database?settings
_HOSTS = re.compile(r"(postgresql(?:\+\w+)?://(?:[^@/?#]*@)?)([^@/?#,]*(?:,[^@/?#,]*)+)(/[^?]*)?(?:\?(.*))?$")
_SECRET = re.compile(r"(?i)pass|secret|token")


def looks_like_url(text: str) -> bool:
    """Return whether a location is written as a URL, well-formed or not; it is then never taken for a folder's name."""
    if "://" in text or re.match(r"\s*([A-Za-z][A-Za-z0-9+.-]+:|(sqlite|postgres\w*)(\+\w+)?//)", text):
        return True
    return re.match(r"[.~]|/(?!/)", text) is None and _CREDENTIALS.search(text) is not None


def database_url(where: str | os.PathLike[str]) -> sa.URL:
    """Return the database of a store given by its folder or its URL. A password is only ever in `URL.password`.

    Raises NotAStore for a file in place of a folder, StorageError for a URL that cannot be that of a store.
    """
    text = os.fspath(where)
    if not text.strip():
        raise StorageError(f"An empty text is not the location of a store: {_POSSIBLE}.")
    if looks_like_url(text):
        return _parse_url(text)
    folder = Path(text).absolute()
    if os.path.isfile(folder):
        raise NotAStore(f"{text} is a file: give the folder of a store, or the database file as sqlite:///{text}.")
    return sa.URL.create("sqlite", database=str(folder / DATABASE_FILE))


def display_url(url: sa.URL) -> str:
    """Return a database's location for users: a file's path, or a server's URL without its passwords."""
    if url.get_backend_name() == "sqlite":
        return str(Path(url.database or "").absolute())
    query = {name: "***" if _SECRET.search(name) else value for name, value in url.query.items()}
    plain = url.set(drivername=url.get_backend_name(), query=query)
    if hosts := several_hosts(url):  # as PostgreSQL writes them
        plain = plain.difference_update_query(["host"]).set(host="\0")
    return plain.render_as_string(hide_password=True).replace("%2A%2A%2A", "***").replace("\0", ",".join(hosts))


def several_hosts(url: sa.URL) -> tuple[str, ...]:
    """Return the hosts (`host` or `host:port`) of a URL that names several servers, of which one takes writes."""
    hosts = url.query.get("host", ())
    return () if isinstance(hosts, str) else tuple(hosts)


def display_location(where: str) -> str:
    """Return the location of a store or of blobs as given, without passwords; used for every printed location."""
    if not looks_like_url(where):
        return where
    try:
        return display_url(database_url(where))
    except StorageError:  # a location of blobs, or an invalid one
        return redacted(where)


def without_passwords(text: str) -> str:
    """Return any text, e.g. an error that quotes user input, with the passwords in its locations masked.

    A server's URL without a password stays whole, so that commands and errors that show it can be copied.
    """
    return _PLACE.sub(lambda found: found[0] if _has_no_password(found[0]) else redacted(found[0]), text)


def _has_no_password(text: str) -> bool:
    return _MASKED.fullmatch(text) is not None and not _SECRET.search(text)


def redacted(text: str) -> str:
    """Return a possibly malformed URL with every possible password masked (a number without `@` is a port)."""
    text = re.sub(r"(?is)((?:pass|secret|token)\w*)=.*", r"\1=***", text)
    start, colon, rest = text.partition(":")
    slashes = "//" if rest.startswith("//") else ""
    before, at, host = rest.rpartition("@")
    if at:  # in a query, an `@` may be part of a password
        return f"{start}:{slashes}***" + ("" if "?" in before else f"@{host.partition('?')[0]}")
    rest = re.sub(r":(?!\d+(/|$))[^/]*", ":***", rest.partition("?")[0])
    return f"{start.partition('?')[0]}{colon}{rest}"


def blobs_location(given: str | os.PathLike[str] | None, url: sa.URL) -> str:
    """Return the location of a store's blobs: as given, else from the environment, else beside a SQLite file.

    Raises StorageError for a store on a server without a location for its blobs.
    """
    if given is not None:
        return os.fspath(given)
    if place := os.environ.get(BLOBS_VARIABLE):
        return place
    if url.get_backend_name() == "sqlite":
        return str(Path(display_url(url)).parent / "blobs")
    raise StorageError(
        f"{display_url(url)}: say where its blobs are kept, a folder that every host sees or s3://bucket/prefix:"
        f" --blobs PLACE, or {BLOBS_VARIABLE}."
    )


def blobs_are_exclusive(blobs: str, url: sa.URL) -> bool:
    """Return whether blobs surely belong to this store alone: beside its SQLite file, with no other database there."""
    if url.get_backend_name() != "sqlite" or looks_like_url(blobs):
        return False
    file = Path(display_url(url))
    try:
        others = (
            [path for path in file.parent.iterdir() if path != file and not path.match(backup_path(file, "*").name)]
            if file.parent.is_dir()
            else []
        )
    except OSError:
        return False
    return Path(blobs).absolute() == file.parent / "blobs" and not any(map(_may_be_database, others))


def backup_path(database: Path, schema: int | str) -> Path:
    """Return the path of the backup copy of a SQLite store that is made before a migration from a schema."""
    return database.with_name(f"{database.name}.schema-{schema}")


def _may_be_database(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return True


def _hosts_as_query(found: re.Match[str]) -> str:
    """Return a URL of several hosts in the form that SQLAlchemy reads. Raises ValueError for an invalid port."""
    start, hosts, path, query = found.groups(default="")
    for host in (listed := hosts.split(",")):
        if not re.fullmatch(r"[^:]+(:\d{1,5})?", host):
            raise ValueError(host)
    return f"{start}{path or '/'}?{'&'.join([f'host={quote(host)}' for host in listed] + ([query] if query else []))}"


def _parse_url(text: str) -> sa.URL:
    try:
        url = make_url(_HOSTS.sub(_hosts_as_query, text))
        backend = url.get_backend_name()
    except (ArgumentError, ValueError):  # its message may contain the password
        raise StorageError(
            f"{redacted(text)!r} looks like a URL but is no database's: {_POSSIBLE} "
            "(a folder with such a name as ./name)."
        ) from None
    if backend not in ("sqlite", "postgresql"):
        raise StorageError(f"Cannot keep a store at {redacted(text)}: {_POSSIBLE}.")
    if backend == "sqlite" and (
        not url.database
        or url.database == ":memory:"
        or url.database.startswith("file:")
        or any((url.host, url.username, url.password))
        or re.match(r"(?s)(?!\.).*:.*@", url.database)  # name:password@host after too many slashes, or a path
    ):
        raise StorageError("A store is shared by processes: give a file, as in sqlite:///runs/league.db.")
    if re.search(r"(?i)(pass|secret|token)\w*=", text.partition("?")[0]):
        raise StorageError(f"{redacted(text)!r}: in a URL settings, such as a password, follow a ?; {_POSSIBLE}.")
    server = text.partition("://")[2]
    if backend == "postgresql" and server.count("@") != min(1, re.split("[/?#]", server)[0].count("@")):
        # A URL split at the wrong @ would show a part of the password as the host's name.
        raise StorageError(f"{redacted(text)}: in a name or password of a URL, @ / ? # are written %40 %2F %3F %23.")
    if "password" in url.query:  # the driver also reads it there, with precedence
        secret = url.query["password"]
        url = url.difference_update_query(["password"]).set(password=secret if isinstance(secret, str) else secret[-1])
    if url.drivername == "postgresql":
        return url.set(drivername="postgresql+psycopg")
    return url
