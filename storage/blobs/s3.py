"""Blobs in a bucket of an S3 server, through fsspec: `s3://bucket/prefix`.

Keys, regions and endpoints come from the environment and AWS's own files (AWS_ACCESS_KEY_ID, AWS_PROFILE,
AWS_ENDPOINT_URL, ...), never from the URL. A server shows an object whole or not at all, so no temporary name is needed
to write a blob. Where reads do not see the last write at once, a reader waits before it calls a blob missing, and a
writer until the server shows what it wrote. `remove` needs a server whose reads do (AWS, Ceph and MinIO are such).
"""

import hashlib
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from storage.blobs.blobs import BlobEntry, is_identity, require_digest
from storage.blobs.s3_errors import is_changed, is_cut, server_error
from storage.errors import DamagedBlob, StorageError, Unavailable

_KEY = re.compile(r"([0-9a-f]{2})/([0-9a-f]{62})(\.removing)?")
POLL_SECONDS = 0.2  # between two checks of a removal in progress
STALE_SECONDS = 60.0  # an older removal marker belongs to a process that was killed
LATE_SECONDS = 5.0  # time after which a server surely shows what was written; afterwards it is written again
READS = 3  # attempts to read an object whole
TRIES = 3  # of each request, with growing pauses
SILENCE_SECONDS = 20.0  # without a byte from the server, until a request is tried again


class BucketBlobs:
    """Blobs as objects `prefix/ab/cdef...` of an existing bucket."""

    def __init__(self, bucket: str, prefix: str):
        self._root = "/".join(filter(None, (bucket, prefix.strip("/"))))
        self._bucket = bucket
        self._absent_at = -STALE_SECONDS  # when an object was last waited for in vain

    def put(self, data: bytes) -> str:
        """See Blobs. If another process is removing the same bytes, it has left a removal marker, and `put` waits for
        it. Raises Unavailable also where the server does not show the object after a minute.
        """
        digest = hashlib.sha256(data).hexdigest()
        key = self._key(digest)
        what = f"Cannot write a blob of {len(data)} bytes to s3://{key}"
        with self._translated_errors(what):
            self._s3.pipe_file(key, data)
            until = time.monotonic() + STALE_SECONDS
            patience = LATE_SECONDS
            while (removing := self._removing(key)) or not self._appears(key, patience):
                if not removing and time.monotonic() > until:
                    raise Unavailable(f"{what}: it was written, and the server does not show it")
                time.sleep(POLL_SECONDS)
                patience *= 2  # a write may be what makes the server show nothing
                self._s3.pipe_file(key, data)
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        key = self._key(digest)
        with self._translated_errors(f"Cannot read blob {digest} at s3://{key}"):
            data = self._whole(key, digest)
            if data is None and self._waited_for(key):
                data = self._whole(key, digest)
            if data is None:
                self._require_bucket()
                raise DamagedBlob(digest, f"s3://{key}", "missing")
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(digest, f"s3://{key}", "damaged, its bytes do not hash to its name")
        return data

    def has(self, digest: str) -> bool:
        """See Blobs."""
        key = self._key(digest)
        with self._translated_errors(f"Cannot look for blob {digest} at s3://{key}"):
            return self._put(key) is not None or self._waited_for(key)

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
            return self._put(f"{self._root}/{store}") is not None

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
        bucket, _, name = key.partition("/")
        try:  # its own `info` also lists objects below a key that is not there
            return self._s3.call_s3("head_object", Bucket=bucket, Key=name)["LastModified"].timestamp()
        except FileNotFoundError:
            return None

    def _whole(self, key: str, digest: str) -> bytes | None:
        """Return an object's bytes, None if there is none: read again if they come incomplete or changed."""
        data = b""
        for attempt in range(READS):
            try:
                data = self._s3.cat_file(key, max_concurrency=1)
                if hashlib.sha256(data).hexdigest() == digest:
                    break
            except FileNotFoundError:
                return None
            except Exception as error:
                if not is_changed(error) and (not is_cut(error) or attempt == READS - 1):
                    raise
            time.sleep(POLL_SECONDS * 2**attempt)
        return data

    def _appears(self, key: str, seconds: float) -> bool:
        """Return whether the server shows an object within that time."""
        until, pause = time.monotonic() + seconds, POLL_SECONDS
        while self._put(key) is None:
            if time.monotonic() > until:
                return False
            time.sleep(pause)
            pause = min(2 * pause, 1.0)
        return True

    def _waited_for(self, key: str) -> bool:
        """Return whether an absent object appears. After one wait in vain others are not waited for, for a while: in a
        store that has lost many blobs they would add up.
        """
        if time.monotonic() < self._absent_at + STALE_SECONDS:
            return False
        found = self._appears(key, LATE_SECONDS)
        self._absent_at = -STALE_SECONDS if found else time.monotonic()
        return found

    def _require_bucket(self) -> None:
        try:
            self._s3.call_s3("head_bucket", Bucket=self._bucket)
        except FileNotFoundError:
            raise Unavailable(f"There is no bucket {self._bucket!r} (another name, another server?)") from None

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
        limits = {
            "connect_timeout": 10, "read_timeout": SILENCE_SECONDS,
            "retries": {"total_max_attempts": TRIES, "mode": "standard"},
        }  # fmt: skip
        server = S3FileSystem(config_kwargs=limits, skip_instance_cache=True, use_listings_cache=False)
        server.retries = 1  # its own attempts multiply those of the client below it
        return server

    @contextmanager
    def _translated_errors(self, what: str) -> Iterator[None]:
        """Translate a server's errors to one line."""
        try:
            yield
        except StorageError:
            raise
        except Exception as error:  # from botocore and aiohttp, which share no base class
            raise server_error(what, self._bucket, error) from None
