import hashlib
import multiprocessing
import resource
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.blobs.blobs import open_blobs
from storage.errors import DamagedBlob, StorageError, Unavailable

DATA = b"a policy"
DIGEST = hashlib.sha256(DATA).hexdigest()


def files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def test_identical_bytes_are_kept_once(tmp_path: Path):
    blobs = open_blobs(tmp_path.as_uri())
    assert blobs.put(DATA) == blobs.put(bytes(DATA))
    assert blobs.put(DATA + b"!") != DIGEST
    assert len(files(tmp_path)) == 2


def test_a_damaged_blob_is_named_and_a_put_heals_it(tmp_path: Path):
    blobs = open_blobs(tmp_path)
    blobs.put(DATA)
    (file,) = files(tmp_path)
    file.write_bytes(b"a policx")
    with pytest.raises(DamagedBlob, match=DIGEST) as caught:
        blobs.get(DIGEST)
    assert caught.value.digest == DIGEST
    assert str(file) in str(caught.value)
    blobs.put(DATA)
    assert blobs.get(DIGEST) == DATA


@pytest.mark.parametrize("ask", ["get", "has"])
def test_a_blob_that_a_killed_removal_left_aside_is_put_back(tmp_path: Path, ask: str):
    blobs = open_blobs(tmp_path)
    blobs.put(DATA)
    (file,) = files(tmp_path)
    file.rename(file.with_name(f".{file.name[:8]}.{'0' * 16}"))
    assert getattr(blobs, ask)(DIGEST) == {"get": DATA, "has": True}[ask]
    assert files(tmp_path) == [file]


def test_a_whole_blob_left_aside_is_not_removed_and_half_of_one_is(tmp_path: Path):
    blobs = open_blobs(tmp_path)
    blobs.put(DATA)
    (file,) = files(tmp_path)
    file.rename(file.with_name(f".{file.name[:8]}.{'0' * 16}"))
    (aside,) = blobs.entries()
    assert not blobs.remove(aside, before=aside.put + 1)
    assert files(tmp_path) == [file]
    half = file.with_name(f".{file.name[:8]}.{'1' * 16}")
    half.write_bytes(DATA[:3])
    (partial,) = [each for each in blobs.entries() if not each.whole]
    assert blobs.remove(partial, before=partial.put + 1)
    assert files(tmp_path) == [file]


@pytest.mark.parametrize("url", ["gs://bucket/blobs", "file://another.host/blobs", "s3:bucket", "file:blobs"])
def test_an_unknown_place_says_what_is_possible(url: str):
    with pytest.raises(StorageError, match=f"{url}.*folder path"):
        open_blobs(url)


def test_a_key_in_a_place_is_not_told():
    with pytest.raises(StorageError, match=r"Cannot keep blobs at 's3://\*\*\*@bucket/blobs'") as caught:
        open_blobs("s3://name:secret@bucket/blobs?password=secret")
    assert "secret" not in str(caught.value)


def test_a_disk_that_takes_no_more_leaves_no_file(tmp_path: Path):
    blobs = open_blobs(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))  # a write past this fails as on a full disk
    try:
        with pytest.raises(StorageError, match="Cannot write a blob of 5000 bytes"):
            blobs.put(bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert files(tmp_path) == []


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of one megabyte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"no disk can be mounted here: {done.stderr.strip()}")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_is_waited_for(small_disk: Path):
    blobs = open_blobs(small_disk / "blobs")
    blobs.put(DATA)
    (small_disk / "film").write_bytes(bytes(900_000))
    with pytest.raises(
        Unavailable, match=r"Cannot write a blob of 500000 bytes.*No space left on device; wait and try again"
    ):
        blobs.put(bytes(500_000))
    assert len(files(small_disk)) == 2
    (small_disk / "film").unlink()
    assert blobs.get(blobs.put(bytes(500_000))) == bytes(500_000)


def test_a_disk_that_is_not_mounted_is_waited_for_and_its_blobs_are_not_called_lost(tmp_path: Path):
    blobs = open_blobs(tmp_path / "disk")
    blobs.put(DATA)
    (tmp_path / "disk").rename(tmp_path / "unplugged")
    with pytest.raises(Unavailable, match=r"folder of blobs is not there.*disk; wait and try again"):
        blobs.get(DIGEST)
    (tmp_path / "unplugged").rename(tmp_path / "disk")
    assert blobs.get(DIGEST) == DATA


def test_a_place_below_a_file_is_refused(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"Cannot write a blob.*Not a directory"):
        open_blobs(tmp_path / "file" / "blobs").put(DATA)


def put_for_ever(folder: str) -> None:
    blobs = open_blobs(folder)
    data = bytearray(32_000_000)  # long enough in the writing to be killed meanwhile
    while True:
        data[0] += 1
        blobs.put(bytes(data))


def test_a_writer_killed_at_any_moment_leaves_only_right_blobs(tmp_path: Path):
    def named(names_start: str) -> list[Path]:
        return [path for path in files(tmp_path) if path.name.startswith(".") == (names_start == ".")]

    context = multiprocessing.get_context("spawn")
    for watched in (".", "a hash"):  # killed as soon as a partial file is seen, then as soon as a blob is
        before = len(named(watched))
        writer = context.Process(target=put_for_ever, args=(str(tmp_path),))
        writer.start()
        while len(named(watched)) == before and writer.is_alive():
            time.sleep(0.0005)
        writer.kill()
        writer.join()
        assert writer.exitcode == -9
    blobs = open_blobs(tmp_path)
    assert named("a hash")
    for path in named("a hash"):
        blobs.get(path.parent.name + path.name)  # raises if it is not what its name says
