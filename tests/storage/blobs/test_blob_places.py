"""What holds of blobs wherever they are: in a folder, and in a bucket of a server that is spoken to over HTTP."""

import hashlib
import multiprocessing
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from storage.blobs.blobs import Blobs, open_blobs
from storage.blobs.folder import FolderBlobs
from storage.blobs.s3 import BucketBlobs
from storage.errors import DamagedBlob, StorageError, Unavailable
from storage.maintenance.thinning import RetentionPolicy
from storage.maintenance.verify import verify
from storage.store import Store
from tests.storage import sound
from tests.storage.object_storage import moto_server as s3

DATA = b"a policy"
DIGEST = hashlib.sha256(DATA).hexdigest()


@dataclass
class Place:
    """Where blobs are, and a way to change bytes there behind the program's back."""

    url: str
    blobs: Blobs
    write: Callable[[str, bytes], object]  # a path below the place


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    with s3.server() as address:
        yield address


@pytest.fixture
def bucket(s3_server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """A new bucket, which the environment's keys open."""
    for name, value in {**s3.KEYS, "AWS_ENDPOINT_URL": s3_server}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("storage.blobs.s3.LATE_SECONDS", 0.2)
    name = f"blobs-{hashlib.sha256(str(tmp_path).encode()).hexdigest()[:12]}"
    BucketBlobs(name, "")._s3.mkdir(name)
    return name


@pytest.fixture(params=["folder", "bucket"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    if request.param == "folder":
        return Place(str(tmp_path), FolderBlobs(tmp_path), lambda path, data: (tmp_path / path).write_bytes(data))
    url = f"s3://{request.getfixturevalue('bucket')}/leagues/mine"
    blobs = open_blobs(url)
    assert isinstance(blobs, BucketBlobs)
    return Place(url, blobs, lambda path, data: blobs._s3.pipe_file(f"{url}/{path}", data))


def path_of(digest: str) -> str:
    return f"{digest[:2]}/{digest[2:]}"


def test_bytes_come_back_under_their_hash_and_are_kept_once(place: Place):
    assert not place.blobs.has(DIGEST)
    assert place.blobs.put(DATA) == place.blobs.put(bytes(DATA)) == DIGEST
    assert place.blobs.has(DIGEST)
    assert place.blobs.get(DIGEST) == DATA
    assert [(entry.name, entry.bytes, entry.whole) for entry in place.blobs.entries()] == [(DIGEST, len(DATA), True)]
    assert open_blobs(place.url).get(DIGEST) == DATA


def test_damage_is_noticed_at_every_read_and_a_put_heals_it(place: Place):
    place.blobs.put(DATA)
    assert place.blobs.get(DIGEST) == DATA
    for damaged in (b"a policx", b"", DATA[:3]):
        place.write(path_of(DIGEST), damaged)
        with pytest.raises(DamagedBlob, match=f"{DIGEST} is damaged"):
            place.blobs.get(DIGEST)
    place.blobs.put(DATA)
    assert place.blobs.get(DIGEST) == DATA


def test_a_missing_blob_is_named(place: Place):
    place.blobs.put(b"another")
    with pytest.raises(DamagedBlob, match=f"{DIGEST} is missing"):
        place.blobs.get(DIGEST)


@pytest.mark.parametrize("name", ["", "../../secret", DIGEST.upper(), DIGEST[:-1]])
def test_only_a_hash_is_a_name(place: Place, name: str):
    with pytest.raises(StorageError, match="not a blob's name"):
        place.blobs.get(name)


def test_strange_names_are_no_blobs(place: Place):
    place.blobs.put(DATA)
    place.write(f"{DIGEST[:2]}/notes.txt", b"not ours")
    assert [entry.name for entry in place.blobs.entries()] == [DIGEST]


def test_only_what_was_put_before_is_removed(place: Place):
    for data in (DATA, b"another"):
        place.blobs.put(data)
    (entry,) = (each for each in place.blobs.entries() if each.name == DIGEST)
    assert not place.blobs.remove(entry, before=entry.put - 1)
    assert place.blobs.get(DIGEST) == DATA
    assert place.blobs.remove(entry, before=entry.put + 2)
    assert not place.blobs.remove(entry, before=entry.put + 2)
    assert [each.bytes for each in place.blobs.entries()] == [len(b"another")]


def put_often(url: str, times: int) -> None:
    blobs = open_blobs(url)
    for _ in range(times):
        if blobs.get(blobs.put(DATA)) != DATA:
            sys.exit(1)


def test_who_puts_the_same_bytes_while_others_remove_young_ones_has_them(place: Place):
    place.blobs.put(DATA)
    (entry,) = place.blobs.entries()
    putting = multiprocessing.get_context("spawn").Process(target=put_often, args=(place.url, 5))
    putting.start()
    for _ in range(5):
        assert not place.blobs.remove(entry, before=entry.put - 1)
    putting.join()
    assert putting.exitcode == 0
    assert place.blobs.get(DIGEST) == DATA


# A bucket's own


def test_who_puts_while_a_blob_is_being_removed_waits_and_puts_it_once_more(bucket: str):
    blobs = BucketBlobs(bucket, "mine")
    blobs.put(DATA)
    (entry,) = blobs.entries()

    class Slow(BucketBlobs):
        """Asks how old a blob is, and removes it when another has just put it."""

        def _put(self, key: str) -> float | None:
            found = super()._put(key)
            nonlocal putting
            putting = subprocess.Popen([sys.executable, "-c", PUT, f"s3://{bucket}/mine"], stdout=subprocess.PIPE)
            assert putting.stdout is not None
            putting.stdout.readline()
            return found

    putting: subprocess.Popen[bytes] | None = None
    assert Slow(bucket, "mine").remove(entry, before=entry.put + 2)
    assert putting is not None
    assert putting.wait(60) == 0
    assert putting.stdout is not None
    putting.stdout.close()
    assert blobs.get(DIGEST) == DATA


PUT = f"""
import sys, storage.blobs.s3 as buckets
from storage.blobs.blobs import open_blobs
waiting = buckets.time.sleep
buckets.time.sleep = lambda seconds: (print("waits", flush=True), waiting(seconds))
open_blobs(sys.argv[1]).put({DATA!r})
"""


def test_a_store_whose_blobs_are_in_a_bucket_is_verified_and_thinned(bucket: str, tmp_path: Path):
    where, url = str(tmp_path / "store"), f"s3://{bucket}/mine"
    with Store.open(where, create=True, blobs=url) as store:
        sound.fill(store)
        stray = store.blobs.put(b"stray")
        (finding,) = verify(where, url, age=-5).findings  # as if five seconds had passed
        assert finding[:2] == ("orphaned", f"blob {stray}")
        done = store.thin(store.find_removable(RetentionPolicy(-5.0, {"cup": 8})))
        assert (done.blobs, done.bytes, done.checkpoints) == (1, len(b"stray"), 0)
        report = verify(where, url, age=-5)
        assert (report.findings, report.blobs, report.recordings) == ([], 11, 2)


def test_the_mark_of_a_killed_removal_is_left_over_and_holds_nobody_up(bucket: str, monkeypatch: pytest.MonkeyPatch):
    blobs = BucketBlobs(bucket, "")
    blobs.put(DATA)
    blobs._s3.pipe_file(f"{bucket}/{path_of(DIGEST)}.removing", b"")
    (left,) = (each for each in blobs.entries() if not each.whole)
    monkeypatch.setattr("storage.blobs.s3.STALE_SECONDS", -60.0)
    assert blobs.put(DATA) == DIGEST
    assert [each.whole for each in blobs.entries()] == [True]
    assert not blobs.remove(left, before=left.put + 2)


def test_a_bucket_that_is_not_there_is_waited_for_by_readers_and_no_writer_makes_one(bucket: str):
    blobs = open_blobs(f"s3://{bucket}-gone/mine")
    with pytest.raises(Unavailable, match=f"no bucket '{bucket}-gone'"):
        blobs.get(DIGEST)
    with pytest.raises(Unavailable, match=f"no bucket '{bucket}-gone'"):
        list(blobs.entries())
    with pytest.raises(StorageError, match=r"there is no bucket .*: make it first"):
        blobs.put(DATA)


def test_a_server_that_does_not_answer_is_waited_for_and_no_key_is_told(bucket: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    for ask in (lambda b: b.get(DIGEST), lambda b: b.put(DATA)):
        with pytest.raises(Unavailable) as caught:
            ask(BucketBlobs(bucket, ""))
        assert "sesame" not in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "url", ["s3://name:secret@bucket/blobs", "s3://bucket/blobs?secret=secret", "s3://", "s3:bucket", "s3://Bucket/x"]
)
def test_a_place_that_is_no_bucket_is_refused_and_its_key_is_not_told(url: str):
    with pytest.raises(StorageError, match="s3://bucket/prefix is possible") as caught:
        open_blobs(url)
    assert "secret" not in str(caught.value).replace("secret=***", "")
