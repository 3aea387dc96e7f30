"""Blobs in a bucket of an S3 server, through fsspec: `s3://bucket/prefix`.

Keys, regions and endpoints come from the environment and AWS's own files (AWS_ACCESS_KEY_ID, AWS_PROFILE,
AWS_ENDPOINT_URL, ...), never from the URL. A server shows an object whole or not at all, and reads see the last write.
No temporary name is therefore needed to write a blob.
"""

import hashlib
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from storage.blobs.blobs import BlobEntry, is_identity, require_digest
from storage.errors import DamagedBlob, StorageError, Unavailable, disk_error

_KEY = re.compile(r"([0-9a-f]{2})/([0-9a-f]{62})(\.removing)?")
POLL_SECONDS = 0.2  # between two checks of a removal in progress
STALE_SECONDS = 60.0  # an older removal marker belongs to a process that was killed


class BucketBlobs:
    """Blobs as objects `prefix/ab/cdef...` of an existing bucket."""

    def __init__(self, bucket: str, prefix: str):
        self._root = "/".join(filter(None, (bucket, prefix.strip("/"))))
        self._bucket = bucket

    def put(self, data: bytes) -> str:
        """See Blobs. If another process is removing the same bytes, it has left a removal marker, and `put` waits for
        it.
        """
        digest = hashlib.sha256(data).hexdigest()
        key = self._key(digest)
        with self._translated_errors(f"Cannot write a blob of {len(data)} bytes to s3://{key}"):
            self._s3.pipe_file(key, data)
            while self._removing(key) or not self._s3.exists(key):
                time.sleep(POLL_SECONDS)
                self._s3.pipe_file(key, data)
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        key = self._key(digest)
        with self._translated_errors(f"Cannot read blob {digest} at s3://{key}"):
            try:
                data = self._s3.cat_file(key)
            except FileNotFoundError:
                self._require_bucket()
                raise DamagedBlob(digest, f"s3://{key}", "missing") from None
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(digest, f"s3://{key}", "damaged, its bytes do not hash to its name")
        return data

    def has(self, digest: str) -> bool:
        """See Blobs."""
        key = self._key(digest)
        with self._translated_errors(f"Cannot look for blob {digest} at s3://{key}"):
            return bool(self._s3.exists(key))

    def entries(self) -> Iterator[BlobEntry]:
        """See Blobs. Objects with other names are skipped."""
        with self._translated_errors(f"Cannot list the blobs in s3://{self._root}"):
            self._require_bucket()
            for key, status in self._s3.find(self._root, detail=True).items():
                if found := _KEY.fullmatch(key.removeprefix(f"{self._root}/")):
                    whole = found[3] is None
                    name = found[1] + found[2] if whole else key
                    yield BlobEntry(name, status["size"], status["LastModified"].timestamp(), whole)

    def remove(self, entry: BlobEntry, before: float) -> bool:
        """See Blobs. From the removal marker on, a writer of these bytes waits, and writes them again afterwards."""
        key = self._key(entry.name) if entry.whole else entry.name
        marker = f"{key}.removing"
        with self._translated_errors(f"Cannot remove s3://{key}"):
            if entry.whole:
                self._s3.pipe_file(marker, b"")
            try:
                if (put := self._put(key)) is None or put >= before:
                    return False
                self._s3.rm_file(key)
                return True
            finally:
                if entry.whole:
                    self._s3.rm_file(marker)

    @property
    def location(self) -> str:
        """See BlobStore."""
        return f"s3://{self._root}"

    def add_identity(self, store: str) -> None:
        """See BlobStore."""
        with self._translated_errors(f"Cannot mark the blobs in {self.location}"):
            self._s3.pipe_file(f"{self._root}/{store}", b"")

    def remove_identity(self, store: str) -> None:
        """See BlobStore."""
        with self._translated_errors(f"Cannot take a mark away from {self.location}"):
            self._s3.rm_file(f"{self._root}/{store}")

    def has_identity(self, store: str) -> bool:
        """See BlobStore."""
        with self._translated_errors(f"Cannot look for the mark {store} in {self.location}"):
            return bool(self._s3.exists(f"{self._root}/{store}"))

    def identities(self) -> list[str]:
        """See BlobStore."""
        with self._translated_errors(f"Cannot list the marks in {self.location}"):
            found = self._s3.glob(f"{self._root}/store-*")
        return sorted(name for key in found if is_identity(name := key.rpartition("/")[2]))

    def _removing(self, key: str) -> bool:
        """Return whether a process removes that object now; the marker of a killed process is removed."""
        marker = f"{key}.removing"
        marked_at = self._put(marker)
        if marked_at is not None and marked_at < time.time() - STALE_SECONDS:
            self._s3.rm_file(marker)
            return False
        return marked_at is not None

    def _put(self, key: str) -> float | None:
        """Return when an object was put, on the server's clock; None if there is none."""
        try:
            return self._s3.info(key)["LastModified"].timestamp()
        except FileNotFoundError:
            return None

    def _require_bucket(self) -> None:
        if not self._s3.exists(self._bucket):
            raise Unavailable(f"There is no bucket {self._bucket!r} (another name, another server?)")

    def _key(self, digest: str) -> str:
        require_digest(digest)
        return f"{self._root}/{digest[:2]}/{digest[2:]}"

    @cached_property
    def _s3(self) -> Any:
        """The file system of the server, created at first use: importing its client takes a second."""
        try:
            from s3fs import S3FileSystem
        except ImportError as error:
            needed = f"s3://{self._root} needs a driver: pip install 'robot-league[s3]' ({error})."
            raise StorageError(needed) from error
        limits = {"connect_timeout": 10, "read_timeout": 60, "retries": {"max_attempts": 2}}
        return S3FileSystem(config_kwargs=limits, skip_instance_cache=True, use_listings_cache=False)

    @contextmanager
    def _translated_errors(self, what: str) -> Iterator[None]:
        """Translate a server's errors to one line. No request is quoted: it would contain the keys' signature."""
        try:
            yield
        except StorageError:
            raise
        except FileNotFoundError as error:
            raise StorageError(f"{what}: there is no bucket {self._bucket!r}: make it first.") from error
        except PermissionError as error:
            raise StorageError(f"{what}: the server refuses it ({error}).") from error
        except OSError as error:
            raise disk_error(what, error) from error
        except Exception as error:  # from botocore and aiohttp, which share no base class
            kind = type(error).__name__
            if "Credential" in kind or "Token" in kind:
                raise StorageError(f"{what}: no keys for it, see AWS_ACCESS_KEY_ID, AWS_PROFILE ({kind}).") from None
            raise Unavailable(f"{what}: the server does not answer ({kind})") from None
