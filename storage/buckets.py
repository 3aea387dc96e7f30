"""Blobs in a bucket of an S3 server, through fsspec: `s3://bucket/prefix`.

Keys, regions and endpoints are those of the environment and of AWS's own files (AWS_ACCESS_KEY_ID, AWS_PROFILE,
AWS_ENDPOINT_URL, ...), never of the URL. A server shows an object whole or not at all, and answers each request with
what the last one left; so no name beside the blob's is needed to write it.
"""

import hashlib
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from storage.blobs import Entry, require_digest
from storage.errors import Away, DamagedBlob, StorageError, disk_error

_KEY = re.compile(r"([0-9a-f]{2})/([0-9a-f]{62})(\.removing)?")
LOOK = 0.2  # seconds between two looks at a removal that is going on
STALE = 60.0  # seconds after which the mark of a removal is that of a process which was killed


class BucketBlobs:
    """Blobs as objects `prefix/ab/cdef...` of a bucket, which must be there."""

    def __init__(self, bucket: str, prefix: str):
        self._root = "/".join(filter(None, (bucket, prefix.strip("/"))))
        self._bucket = bucket

    def put(self, data: bytes) -> str:
        """See Blobs. Whoever removes the same bytes meanwhile has left a mark, which is waited for."""
        digest = hashlib.sha256(data).hexdigest()
        key = self._key(digest)
        with self._told(f"Cannot write a blob of {len(data)} bytes to s3://{key}"):
            self._s3.pipe_file(key, data)
            while self._removing(key) or not self._s3.exists(key):
                time.sleep(LOOK)
                self._s3.pipe_file(key, data)
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        key = self._key(digest)
        with self._told(f"Cannot read blob {digest} at s3://{key}"):
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
        with self._told(f"Cannot look for blob {digest} at s3://{key}"):
            return bool(self._s3.exists(key))

    def entries(self) -> Iterator[Entry]:
        """See Blobs. Objects of other names are passed over."""
        with self._told(f"Cannot list the blobs in s3://{self._root}"):
            self._require_bucket()
            for key, about in self._s3.find(self._root, detail=True).items():
                if found := _KEY.fullmatch(key.removeprefix(f"{self._root}/")):
                    whole = found[3] is None
                    name = found[1] + found[2] if whole else key
                    yield Entry(name, about["size"], about["LastModified"].timestamp(), whole)

    def remove(self, entry: Entry, before: float) -> bool:
        """See Blobs. From the mark on, who puts these bytes waits, and puts them once more when it is gone."""
        key = self._key(entry.name) if entry.whole else entry.name
        mark = f"{key}.removing"
        with self._told(f"Cannot remove s3://{key}"):
            if entry.whole:
                self._s3.pipe_file(mark, b"")
            try:
                if (put := self._put(key)) is None or put >= before:
                    return False
                self._s3.rm_file(key)
                return True
            finally:
                if entry.whole:
                    self._s3.rm_file(mark)

    def _removing(self, key: str) -> bool:
        """Whether somebody removes that object now; the mark of one who was killed is taken away."""
        mark = f"{key}.removing"
        marked = self._put(mark)
        if marked is not None and marked < time.time() - STALE:
            self._s3.rm_file(mark)
            return False
        return marked is not None

    def _put(self, key: str) -> float | None:
        """When an object was put, on the server's clock; None where there is none."""
        try:
            return self._s3.info(key)["LastModified"].timestamp()
        except FileNotFoundError:
            return None

    def _require_bucket(self) -> None:
        if not self._s3.exists(self._bucket):
            raise Away(f"There is no bucket {self._bucket!r} (another name, another server?)")

    def _key(self, digest: str) -> str:
        require_digest(digest)
        return f"{self._root}/{digest[:2]}/{digest[2:]}"

    @cached_property
    def _s3(self) -> Any:
        """The server, found when it is first needed: it takes a second to load what speaks to it."""
        try:
            from s3fs import S3FileSystem
        except ImportError as error:
            needed = f"s3://{self._root} needs a driver: pip install 'robot-league[s3]' ({error})."
            raise StorageError(needed) from error
        limits = {"connect_timeout": 10, "read_timeout": 60, "retries": {"max_attempts": 2}}
        return S3FileSystem(config_kwargs=limits, skip_instance_cache=True, use_listings_cache=False)

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Tell a server's complaints in one line, which quotes no request: that would hold the keys' signature."""
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
        except Exception as error:  # of botocore and aiohttp, which share no class
            kind = type(error).__name__
            if "Credential" in kind or "Token" in kind:
                raise StorageError(f"{what}: no keys for it, see AWS_ACCESS_KEY_ID, AWS_PROFILE ({kind}).") from None
            raise Away(f"{what}: the server does not answer ({kind})") from None
