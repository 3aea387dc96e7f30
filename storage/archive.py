"""Leagues as one file: a zip of rows as JSON lines, blobs by digest, and a manifest with the digest of every member.

    rows/<table>.jsonl   a JSON object per row, deflated
    blobs/<sha256>       stored as they are
    manifest.json        {"archive": 1, ..., "rows": {table: {rows, bytes, sha256}}, "blobs": {digest: bytes}}

Nothing else may be in it. Whatever comes from an archive is checked while it is read: names, sizes, digests. Nothing is
ever extracted to a path that an archive names, and everything is streamed, so its size says nothing of the memory used.
"""

import errno
import hashlib
import json
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Self

from storage.errors import StorageError, disk_error
from storage.files import opened

FORMAT = 1
MANIFEST = "manifest.json"

# What is held in memory at once, or unpacked beyond the archive's own size, is bounded, for writers as for readers.
MANIFEST_LIMIT = 2**28  # bytes: about two million blobs
LINE_LIMIT = 2**26  # bytes of a row
ROWS_LIMIT = 2**34  # bytes of all rows
BLOB_LIMIT = 2**31  # bytes of a blob, which is held in memory
CHUNK = 2**20

_DIGEST = re.compile(r"[0-9a-f]{64}")


class ArchiveError(StorageError):
    """A file is no whole, undamaged archive of leagues that this program reads; nothing was written."""


class Writer:
    """An archive being written, as a context. Rows and blobs in any order, the manifest at the end by `finish`."""

    def __init__(self, file: BinaryIO):
        self._zip = zipfile.ZipFile(file, "w", allowZip64=True)
        self._rows: dict[str, dict[str, Any]] = {}
        self._blobs: dict[str, int] = {}
        self._size = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, ValueError):  # it was given up, or `finish` has closed it
            self._zip.close()

    def rows(self, table: str, rows: Iterable[Mapping[str, Any]]) -> int:
        """Write a table; how many rows it has. Raises StorageError for more than can be read back."""
        digest, count, size = hashlib.sha256(), 0, 0
        member = zipfile.ZipInfo(_rows_member(table))
        member.compress_type = zipfile.ZIP_DEFLATED
        with self._zip.open(member, "w", force_zip64=True) as out:
            for row in rows:
                line = _line(table, row)
                self._size += len(line)
                if len(line) > LINE_LIMIT or self._size > ROWS_LIMIT:
                    raise StorageError(f"Table {table!r} has more than an archive holds: {_limits()}.")
                out.write(line)
                digest.update(line)
                count, size = count + 1, size + len(line)
        self._rows[table] = {"rows": count, "bytes": size, "sha256": digest.hexdigest()}
        return count

    def blob(self, digest: str, data: bytes) -> None:
        """Add a blob. Raises StorageError for one that is larger than can be read back."""
        if len(data) > BLOB_LIMIT:
            raise StorageError(f"Blob {digest} has more than an archive holds: {_limits()}.")
        self._zip.writestr(zipfile.ZipInfo(_blob_member(digest)), data)
        self._blobs[digest] = len(data)

    def finish(self, about: Mapping[str, Any]) -> None:
        """Write the manifest, `about` in it, and end the archive."""
        manifest = {"archive": FORMAT, **about, "rows": self._rows, "blobs": self._blobs}
        member = zipfile.ZipInfo(MANIFEST)
        member.compress_type = zipfile.ZIP_DEFLATED
        self._zip.writestr(member, json.dumps(manifest, indent=1, allow_nan=False))
        self._zip.close()


class Archive:
    """An archive opened for reading. Opening checks members and manifest; what they hold is checked as it is read.

    Every verb raises ArchiveError, one line, for an archive that is not sound.
    """

    def __init__(self, file: BinaryIO, where: str, tables: Iterable[str]):
        self.where = where
        self._file = file
        with self._plain():
            self._zip = zipfile.ZipFile(file)
            members = self._members(set(map(_rows_member, tables)))
            self.about = self._manifest(members)
            self.rows: Mapping[str, Mapping[str, Any]] = self.about["rows"]
            self.blobs: Mapping[str, int] = self.about["blobs"]
            self._compare(members)

    @classmethod
    def open(cls, path: Path, tables: Iterable[str]) -> Self:
        """Open the archive at a path; raises ArchiveError, StorageError for what cannot be read at all."""
        file = opened(path)
        try:
            return cls(file, str(path), tables)
        except BaseException:
            file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def table(self, table: str) -> Iterator[dict[str, Any]]:
        """The rows of a table; at the end it is known that they are those of the manifest, before that not."""
        told, digest, count, size = self.rows[table], hashlib.sha256(), 0, 0
        with self._plain(), self._zip.open(_rows_member(table)) as member:
            while line := member.readline(LINE_LIMIT + 1):
                if len(line) > LINE_LIMIT:
                    raise self.bad(f"a row of {table} is longer than {LINE_LIMIT} bytes")
                digest.update(line)
                count, size = count + 1, size + len(line)
                row = json.loads(line, parse_constant=_no_constant)
                if not isinstance(row, dict):
                    raise self.bad(f"row {count} of {table} is no JSON object")
                yield row
            if (count, size, digest.hexdigest()) != (told["rows"], told["bytes"], told["sha256"]):
                raise self.bad(f"the rows of {table} are not those that its manifest tells of")

    def blob(self, digest: str) -> bytes:
        """A blob's bytes."""
        with self._plain(), self._zip.open(_blob_member(digest)) as member:
            data = member.read(self.blobs[digest] + 1)
        if len(data) != self.blobs[digest] or hashlib.sha256(data).hexdigest() != digest:
            raise self.bad(f"the bytes of blob {digest[:12]} do not hash to its name")
        return data

    def check_blob(self, digest: str) -> None:
        """Read a blob, piece by piece, to see that it is whole."""
        found = hashlib.sha256()
        with self._plain(), self._zip.open(_blob_member(digest)) as member:
            while piece := member.read(CHUNK):
                found.update(piece)
        if found.hexdigest() != digest:
            raise self.bad(f"the bytes of blob {digest[:12]} do not hash to its name")

    def bad(self, what: object) -> ArchiveError:
        """What to raise where the archive is not sound."""
        return ArchiveError(f"{self.where}: {shortened(what)}; nothing was unpacked.")

    def _members(self, rows: set[str]) -> dict[str, int]:
        """The members' names and the sizes they declare; every name, kind and size is one that can be."""
        found: dict[str, int] = {}
        for info in self._zip.infolist():
            name = info.orig_filename
            if name.startswith(("/", "\\")) or ":" in name or ".." in re.split(r"[/\\]", name):
                raise self.bad(f"its member {name!r} would lie outside of the folder it is unpacked in")
            if stat.S_ISLNK(info.external_attr >> 16):
                raise self.bad(f"its member {name!r} is a link")
            is_blob = name.startswith("blobs/") and _DIGEST.fullmatch(name.removeprefix("blobs/"))
            if not (is_blob or name in rows or name == MANIFEST):
                raise self.bad(f"it has a member {name!r}, which no archive of leagues has")
            if name in found:
                raise self.bad(f"it has two members {name!r}")
            if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise self.bad(f"its member {name!r} is encrypted or packed by a method that is not used here")
            limit = BLOB_LIMIT if is_blob else MANIFEST_LIMIT if name == MANIFEST else ROWS_LIMIT
            if info.file_size > limit:
                raise self.bad(f"its member {name!r} declares {info.file_size:,} bytes, and {limit:,} are possible")
            if is_blob and (info.compress_type, info.compress_size) != (zipfile.ZIP_STORED, info.file_size):
                raise self.bad(f"its member {name!r} declares {info.file_size:,} bytes and has {info.compress_size:,}")
            found[name] = info.file_size
        total = sum(size for name, size in found.items() if name in rows)
        if total > ROWS_LIMIT:
            raise self.bad(f"its rows declare {total:,} bytes, and {ROWS_LIMIT:,} are possible")
        packed, there = sum(info.compress_size for info in self._zip.infolist()), self._file.seek(0, 2)
        if packed > there:
            raise self.bad(f"its members declare {packed:,} packed bytes, and the whole file has {there:,}")
        if MANIFEST not in found:
            raise self.bad(f"it is a zip without {MANIFEST}, which is no archive of leagues")
        return found

    def _manifest(self, members: Mapping[str, int]) -> Mapping[str, Any]:
        with self._zip.open(MANIFEST) as member:
            about = json.loads(member.read(MANIFEST_LIMIT + 1), parse_constant=_no_constant)
        if not isinstance(about, dict) or not _is_count(about.get("archive")):
            raise self.bad(f"its {MANIFEST} does not say which format it has")
        if about["archive"] > FORMAT:
            raise ArchiveError(
                f"{self.where} has format {about['archive']}, but this program knows only up to {FORMAT}: update"
                " robot-league."
            )
        rows, blobs = about.get("rows"), about.get("blobs")
        if not (isinstance(rows, dict) and isinstance(blobs, dict)):
            raise self.bad(f"its {MANIFEST} does not say what it holds")
        if not (all(map(_is_told, rows.values())) and all(map(_is_count, blobs.values()))):
            raise self.bad(f"its {MANIFEST} is damaged")
        return about

    def _compare(self, members: Mapping[str, int]) -> None:
        """The members must be exactly those of the manifest."""
        told = {_rows_member(table): each["bytes"] for table, each in self.rows.items()}
        told |= {_blob_member(digest): size for digest, size in self.blobs.items()}
        there = {name: size for name, size in members.items() if name != MANIFEST}
        for name in sorted(told.keys() | there.keys()):
            if name not in there:
                raise self.bad(f"it lacks {name!r}, which its manifest names")
            if name not in told:
                raise self.bad(f"it has {name!r}, which its manifest does not name")
            if told[name] != there[name]:
                raise self.bad(f"{name!r} has {there[name]:,} bytes, and its manifest tells of {told[name]:,}")

    @contextmanager
    def _plain(self) -> Iterator[None]:
        """Tell in one line what the libraries that read it have to say."""
        try:
            yield
        except zipfile.BadZipFile as error:
            self._file.seek(0)
            begun = self._file.read(4) == b"PK\x03\x04"
            if not begun:
                raise self.bad("this is no archive of leagues") from error
            what = "it is cut off" if "not a zip file" in str(error) else f"it is damaged: {error}"
            raise self.bad(what) from error
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise disk_error(f"Cannot read {self.where}", error) from error
            raise self.bad("it is damaged: it tells of a place before its beginning") from error
        except RecursionError as error:
            raise self.bad("it is damaged: brackets within brackets without end") from error
        except _DAMAGED as error:
            raise self.bad(f"it is damaged: {error or type(error).__name__}") from error


def shortened(what: object) -> str:
    """What a stranger's file says, as one line that is not too long."""
    text = " ".join(str(what).split())
    return text if len(text) <= 300 else f"{text[:200]} ... {text[-60:]}"


_DAMAGED = (
    ValueError,
    LookupError,
    EOFError,
    zlib.error,
    struct.error,
    OverflowError,
    NotImplementedError,
    RuntimeError,
)


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no figure")


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _line(table: str, row: Mapping[str, Any]) -> bytes:
    try:
        return json.dumps(row, allow_nan=False, separators=(",", ":")).encode() + b"\n"
    except (ValueError, TypeError) as error:
        raise StorageError(f"A row of table {table!r} is damaged, and cannot be packed: {error}.") from error


def _is_told(value: object) -> bool:
    """Whether the manifest can tell that of a table."""
    return (
        isinstance(value, dict)
        and value.keys() == {"rows", "bytes", "sha256"}
        and all(_is_count(value[name]) for name in ("rows", "bytes"))
    )


def _rows_member(table: str) -> str:
    return f"rows/{table}.jsonl"


def _blob_member(digest: str) -> str:
    return f"blobs/{digest}"


def _limits() -> str:
    return f"{ROWS_LIMIT:,} bytes of rows, {LINE_LIMIT:,} of a row, {BLOB_LIMIT:,} of a blob"
