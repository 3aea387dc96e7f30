"""Leagues as one file: a zip of rows as JSON lines, blobs by digest, and a manifest with the digest of every member.

    rows/<table>.jsonl   a JSON object per row, deflated
    blobs/<sha256>       stored uncompressed
    manifest.json        {"archive": 1, ..., "rows": {table: {rows, bytes, sha256}}, "blobs": {digest: bytes}}

No other member is allowed. All data from an archive is checked while it is read: names, sizes, digests. Nothing is ever
extracted to a path that an archive names. Data is streamed, so memory use does not depend on the archive's size.
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

from storage.blobs.files import open_file
from storage.errors import StorageError, disk_error

FORMAT = 1
MANIFEST = "manifest.json"

# Data in memory at once, and unpacked beyond the archive's own size, is bounded, for writers and readers alike.
# A parsed byte of JSON may take fifty bytes of memory, and a packed byte may unpack to a thousand: data that is parsed
# at once is small, or in proportion to the archive.
MANIFEST_LIMIT = 2**20  # bytes of the manifest, plus
MANIFEST_SHARE = 256  # bytes for each member
LINE_LIMIT = 2**22  # bytes of a row
ROWS_LIMIT = 2**34  # bytes of all rows
ROWS_RATIO = 250  # bytes of rows for each packed byte, beyond the first ROWS_FREE; real rows need 4 to 50
ROWS_FREE = 2**24
BLOB_LIMIT = 2**31  # bytes of a blob, which is held in memory
CHUNK = 2**20

_BLOB = re.compile(r"blobs/[0-9a-f]{64}")


class ArchiveError(StorageError):
    """A file is not a whole, undamaged archive of leagues that this program reads; nothing was written."""


class ArchiveWriter:
    """An archive being written, as a context. Rows and blobs come in any order, then `finish` writes the manifest."""

    def __init__(self, file: BinaryIO):
        self._zip = zipfile.ZipFile(file, "w", allowZip64=True)
        self._rows: dict[str, dict[str, Any]] = {}
        self._blobs: dict[str, int] = {}
        self._size = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, ValueError):  # it was abandoned, or `finish` has closed it
            self._zip.close()

    def rows(self, table: str, rows: Iterable[Mapping[str, Any]]) -> int:
        """Write a table; return its number of rows. Raises StorageError for more rows than can be read back."""
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
        """Add a blob. Raises StorageError for a blob that is too large to be read back."""
        if len(data) > BLOB_LIMIT:
            raise StorageError(f"Blob {digest} has more than an archive holds: {_limits()}.")
        self._zip.writestr(zipfile.ZipInfo(_blob_member(digest)), data)
        self._blobs[digest] = len(data)

    def finish(self, fields: Mapping[str, Any]) -> None:
        """Write the manifest, including `fields`, and close the archive."""
        manifest = {"archive": FORMAT, **fields, "rows": self._rows, "blobs": self._blobs}
        member = zipfile.ZipInfo(MANIFEST)
        member.compress_type = zipfile.ZIP_DEFLATED
        self._zip.writestr(member, json.dumps(manifest, indent=1, allow_nan=False))
        self._zip.close()


class ArchiveReader:
    """An archive opened for reading. Opening checks the members and the manifest; contents are checked when read.

    Every method raises ArchiveError, one line, for an archive that is damaged or inconsistent.
    """

    def __init__(self, file: BinaryIO, where: str, tables: Iterable[str]):
        self.where = where
        self._file = file
        with self._archive_errors():
            self._zip = zipfile.ZipFile(file)
            members = self._members(set(map(_rows_member, tables)))
            self.manifest = self._manifest(members)
            self.rows: Mapping[str, Mapping[str, Any]] = self.manifest["rows"]
            self.blobs: Mapping[str, int] = self.manifest["blobs"]
            self._compare(members)

    @classmethod
    def open(cls, path: Path, tables: Iterable[str]) -> Self:
        """Open the archive at a path. Raises ArchiveError, and StorageError for a file that cannot be read at all."""
        file = open_file(path)
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
        """Yield the rows of a table; only at the end are they known to match the manifest."""
        declared, digest, count, size = self.rows[table], hashlib.sha256(), 0, 0
        with self._archive_errors(), self._zip.open(_rows_member(table)) as member:
            while line := member.readline(LINE_LIMIT + 1):
                if len(line) > LINE_LIMIT:
                    raise self.error(f"a row of {table} is longer than {LINE_LIMIT} bytes")
                digest.update(line)
                count, size = count + 1, size + len(line)
                row = json.loads(line, parse_constant=_no_constant)
                if not isinstance(row, dict):
                    raise self.error(f"row {count} of {table} is no JSON object")
                yield row
            if (count, size, digest.hexdigest()) != (declared["rows"], declared["bytes"], declared["sha256"]):
                raise self.error(f"the rows of {table} are not those of its manifest")

    def blob(self, digest: str) -> bytes:
        """Return a blob's bytes."""
        with self._archive_errors(), self._zip.open(_blob_member(digest)) as member:
            data = member.read(self.blobs[digest] + 1)
        if len(data) != self.blobs[digest] or hashlib.sha256(data).hexdigest() != digest:
            raise self.error(f"the bytes of blob {digest[:12]} do not hash to its name")
        return data

    def check_blob(self, digest: str) -> None:
        """Read a blob, piece by piece, and check its digest."""
        found = hashlib.sha256()
        with self._archive_errors(), self._zip.open(_blob_member(digest)) as member:
            while piece := member.read(CHUNK):
                found.update(piece)
        if found.hexdigest() != digest:
            raise self.error(f"the bytes of blob {digest[:12]} do not hash to its name")

    def error(self, what: object) -> ArchiveError:
        """Return the error to raise for a faulty archive."""
        return ArchiveError(f"{self.where}: {shortened(what)}; nothing was unpacked.")

    def _members(self, rows: set[str]) -> dict[str, int]:
        """Return the members' names and declared sizes, after checking every name, kind and size."""
        found: dict[str, int] = {}
        for info in self._zip.infolist():
            name = info.orig_filename
            if name.startswith(("/", "\\")) or ":" in name or ".." in re.split(r"[/\\]", name):
                raise self.error(f"its member {name!r} would lie outside of the folder it is unpacked in")
            if stat.S_ISLNK(info.external_attr >> 16):
                raise self.error(f"its member {name!r} is a link")
            is_blob = _BLOB.fullmatch(name)
            if not (is_blob or name in rows or name == MANIFEST):
                raise self.error(f"it has a member {name!r}, which no archive of leagues has")
            if name in found:
                raise self.error(f"it has two members {name!r}")
            if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise self.error(f"its member {name!r} is encrypted or compressed by an unsupported method")
            limit = self._limit(info, is_blob is not None)
            if info.file_size > limit:
                raise self.error(f"its member {name!r} declares {info.file_size:,} bytes, and {limit:,} are possible")
            if is_blob and (info.compress_type, info.compress_size) != (zipfile.ZIP_STORED, info.file_size):
                raise self.error(
                    f"its member {name!r} declares {info.file_size:,} bytes and has {info.compress_size:,}"
                )
            found[name] = info.file_size
        total = sum(size for name, size in found.items() if name in rows)
        if total > ROWS_LIMIT:
            raise self.error(f"its rows declare {total:,} bytes, and {ROWS_LIMIT:,} are possible")
        packed, there = sum(info.compress_size for info in self._zip.infolist()), self._file.seek(0, 2)
        if packed > there:
            raise self.error(f"its members declare {packed:,} packed bytes, and the whole file has {there:,}")
        if MANIFEST not in found:
            raise self.error(f"it is a zip without {MANIFEST}, which is no archive of leagues")
        return found

    def _limit(self, info: zipfile.ZipInfo, is_blob: bool) -> int:
        """Return the maximum size of a member when unpacked, in bytes."""
        if is_blob:
            return BLOB_LIMIT
        if info.orig_filename == MANIFEST:
            return MANIFEST_LIMIT + MANIFEST_SHARE * len(self._zip.infolist())
        return min(ROWS_LIMIT, ROWS_FREE + ROWS_RATIO * info.compress_size)

    def _manifest(self, members: Mapping[str, int]) -> Mapping[str, Any]:
        with self._zip.open(MANIFEST) as member:
            manifest = json.loads(member.read(members[MANIFEST]), parse_constant=_no_constant)
        if not isinstance(manifest, dict) or not _is_count(manifest.get("archive")):
            raise self.error(f"its {MANIFEST} does not say which format it has")
        if manifest["archive"] > FORMAT:
            raise ArchiveError(
                f"{self.where} has format {manifest['archive']}, but this program knows only up to {FORMAT}: update"
                " robot-league."
            )
        rows, blobs = manifest.get("rows"), manifest.get("blobs")
        if not (isinstance(rows, dict) and isinstance(blobs, dict)):
            raise self.error(f"its {MANIFEST} does not say what it holds")
        if not (all(map(_is_table_entry, rows.values())) and all(map(_is_count, blobs.values()))):
            raise self.error(f"its {MANIFEST} is damaged")
        return manifest

    def _compare(self, members: Mapping[str, int]) -> None:
        """Check that the members are exactly those of the manifest."""
        declared = {_rows_member(table): each["bytes"] for table, each in self.rows.items()}
        declared |= {_blob_member(digest): size for digest, size in self.blobs.items()}
        there = {name: size for name, size in members.items() if name != MANIFEST}
        for name in sorted(declared.keys() | there.keys()):
            if name not in there:
                raise self.error(f"it lacks {name!r}, which its manifest names")
            if name not in declared:
                raise self.error(f"it has {name!r}, which its manifest does not name")
            if declared[name] != there[name]:
                raise self.error(f"{name!r} has {there[name]:,} bytes, and its manifest says {declared[name]:,}")

    @contextmanager
    def _archive_errors(self) -> Iterator[None]:
        """Translate errors of the libraries that read the archive to one line."""
        try:
            yield
        except zipfile.BadZipFile as error:
            self._file.seek(0)
            begun = self._file.read(4) == b"PK\x03\x04"
            if not begun:
                raise self.error("this is no archive of leagues") from error
            what = "it is cut off" if "not a zip file" in str(error) else f"it is damaged: {error}"
            raise self.error(what) from error
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise disk_error(f"Cannot read {self.where}", error) from error
            raise self.error("it is damaged: it refers to a position before its beginning") from error
        except RecursionError as error:
            raise self.error("it is damaged: its JSON is nested too deeply") from error
        except _DAMAGED as error:
            raise self.error(f"it is damaged: {error or type(error).__name__}") from error


def shortened(what: object) -> str:
    """Return an untrusted text as one line of limited length."""
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


def _is_table_entry(value: object) -> bool:
    """Return whether a value can be a manifest's entry for a table."""
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
