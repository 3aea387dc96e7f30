"""Blobs on an S3 server that is slow, fails, disconnects, changes bytes or shows old states; each fault by a proxy."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.blobs import s3
from storage.blobs.s3 import BucketBlobs
from storage.errors import DamagedBlob, StorageError, Unavailable
from storage.maintenance.verify import verify
from storage.store import Store
from tests.faults import harm
from tests.storage import sound
from tests.storage.blobs.test_blob_places import bucket, s3_server  # noqa: F401  (fixtures)
from tests.storage.object_storage import ceph, moto_server
from tests.storage.object_storage.proxy import Faults, Proxy

DATA = b"a policy" * 1000
DIGEST = hashlib.sha256(DATA).hexdigest()


@pytest.fixture
def proxy(bucket: str, s3_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Proxy]:  # noqa: F811
    with Proxy(s3_server) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.url)
        monkeypatch.setattr(s3, "POLL_SECONDS", 0.05)
        monkeypatch.setattr(s3, "LATE_SECONDS", 5.0)
        yield proxy


@pytest.fixture
def blobs(proxy: Proxy, bucket: str) -> BucketBlobs:  # noqa: F811
    return BucketBlobs(bucket, "mine")


def one_line(error: Exception) -> str:
    text = str(error)
    assert "\n" not in text
    assert moto_server.KEYS["AWS_SECRET_ACCESS_KEY"] not in text
    assert "Signature=" not in text
    return text


def test_a_blob_costs_three_requests_to_write_and_one_to_read(blobs: BucketBlobs, proxy: Proxy):
    blobs.put(DATA)
    assert proxy.requests == {"PUT": 1, "HEAD": 2}  # its removal marker, and the object
    proxy.requests.clear()
    assert blobs.get(DIGEST) == DATA
    assert proxy.requests == {"GET": 1}


@pytest.mark.parametrize(
    "fault",
    [
        Faults(status=500, times=1), Faults(status=503, code="SlowDown", times=2),
        Faults(status=500, after=True, times=1), Faults(cut="upload", only="PUT", times=1),
        Faults(cut="download", only="GET", times=2), Faults(damage="shorter", only="GET", times=2),
        Faults(damage="changed", only="GET", times=2), Faults(late=0.3), Faults(stale=1.0),
    ],
    ids=["500", "503", "answer lost", "upload cut", "download cut", "shorter", "changed", "late", "stale"],
)  # fmt: skip
def test_a_fault_that_passes_is_not_noticed(blobs: BucketBlobs, proxy: Proxy, fault: Faults):
    proxy.faults = fault
    assert blobs.put(DATA) == DIGEST
    assert blobs.get(DIGEST) == DATA
    assert fault.done


@pytest.mark.parametrize("code", ["InternalError", "ServiceUnavailable", "SlowDown", "Unheard"])
def test_a_server_that_fails_is_waited_for(
    blobs: BucketBlobs, proxy: Proxy, monkeypatch: pytest.MonkeyPatch, code: str
):
    monkeypatch.setattr(s3, "TRIES", 1)
    proxy.faults = Faults(status=500, code=code)
    for ask in (lambda: blobs.put(DATA), lambda: blobs.get(DIGEST), lambda: list(blobs.entries())):
        with pytest.raises(Unavailable, match=r"the server cannot do it now.*wait and try again") as caught:
            ask()
        one_line(caught.value)
    proxy.faults = Faults()
    assert blobs.get(blobs.put(DATA)) == DATA


def test_a_silent_server_is_asked_a_few_times_and_not_for_an_hour(
    blobs: BucketBlobs, proxy: Proxy, monkeypatch: pytest.MonkeyPatch
):
    blobs.put(DATA)
    monkeypatch.setattr(s3, "SILENCE_SECONDS", 0.2)
    silent = BucketBlobs(blobs._bucket, "mine")
    proxy.faults = Faults(silent=True)
    with pytest.raises(Unavailable, match="does not answer"):
        silent.get(DIGEST)
    assert proxy.requests["silent"] == s3.TRIES


def test_who_writes_to_a_server_that_shows_it_late_writes_once(blobs: BucketBlobs, proxy: Proxy):
    proxy.faults = Faults(stale=0.5)
    blobs.put(DATA)
    assert proxy.requests["stale"] > 0
    assert proxy.requests["PUT"] == 1


def test_a_server_that_never_shows_what_is_written_is_not_written_to_for_ever(
    blobs: BucketBlobs, proxy: Proxy, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(s3, "LATE_SECONDS", 0.1)
    monkeypatch.setattr(s3, "STALE_SECONDS", 0.3)
    proxy.faults = Faults(stale=60.0)
    with pytest.raises(Unavailable, match="the server does not show it"):
        blobs.put(DATA)


def test_a_blob_that_a_server_shows_late_is_not_called_missing(blobs: BucketBlobs, proxy: Proxy):
    for ask in (lambda: blobs.get(DIGEST) == DATA, lambda: blobs.has(DIGEST)):
        proxy.faults = Faults(stale=0.5)
        blobs._s3.pipe_file(blobs._key(DIGEST), DATA)  # as another process does, before it waits
        assert ask()
        assert proxy.requests["stale"] > 0
        proxy._shown.clear()


def test_the_second_of_many_missing_blobs_is_not_waited_for(
    blobs: BucketBlobs, proxy: Proxy, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(s3, "LATE_SECONDS", 0.3)
    for asked in ("more", "once"):
        proxy.requests.clear()
        with pytest.raises(DamagedBlob, match="missing"):
            blobs.get(DIGEST)
        assert (proxy.requests["GET"] + proxy.requests["HEAD"] > 2) == (asked == "more")  # the bucket is asked for


@pytest.mark.parametrize(
    ("code", "said"),
    [("InvalidAccessKeyId", "does not know the key"), ("SignatureDoesNotMatch", "secret does not belong"),
     ("RequestTimeTooSkewed", "clock"), ("AccessDenied", "may not"), ("Unheard", "AWS_ACCESS_KEY_ID")],
)  # fmt: skip
def test_what_a_server_refuses_is_said_in_one_line(blobs: BucketBlobs, proxy: Proxy, code: str, said: str):
    proxy.faults = Faults(status=403, code=code)
    with pytest.raises(StorageError, match=f"refuses it.*{said}") as caught:
        blobs.put(DATA)
    assert not isinstance(caught.value, Unavailable)
    one_line(caught.value)


@pytest.mark.parametrize(("name", "value"), [("AWS_PROFILE", "nobody"), ("AWS_ENDPOINT_URL", "nonsense")])
def test_settings_of_a_server_that_are_not_possible_are_not_waited_for(
    bucket: str,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    value: str,
):
    monkeypatch.setenv(name, value)
    with pytest.raises(StorageError, match=f"not possible.*{name}") as caught:
        BucketBlobs(bucket, "").put(DATA)
    assert not isinstance(caught.value, Unavailable)
    one_line(caught.value)


PUT = "import sys; from storage.blobs.blobs import open_blobs; open_blobs(sys.argv[1]).put(b'x')"


@pytest.mark.slow
@pytest.mark.skipif(not ceph.is_installed(), reason="needs Debian's packages ceph-mon, ceph-osd and radosgw")
def test_a_real_server_keeps_blobs_and_refuses_wrong_keys_and_clocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    server = ceph.Ceph(tmp_path / "ceph")
    try:
        for name, value in {**moto_server.KEYS, "AWS_ENDPOINT_URL": server.url}.items():
            monkeypatch.setenv(name, value)
        blobs = BucketBlobs("blobs", "mine")
        blobs._s3.mkdir("blobs")
        assert blobs.get(blobs.put(DATA)) == DATA
        server.restart_gateway()
        (entry,) = blobs.entries()
        assert blobs.remove(entry, before=entry.put + 2)
        assert not blobs.has(DIGEST)
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            with monkeypatch.context() as patch:
                patch.setenv(name, "hush-hush")
                with pytest.raises(StorageError, match="refuses it") as caught:
                    BucketBlobs("blobs", "mine").put(DATA)
            assert "hush-hush" not in one_line(caught.value)
        if library := harm.faketime():
            wrong = {**os.environ, "LD_PRELOAD": str(library), "FAKETIME": "+2h"}
            command = [sys.executable, "-c", PUT, "s3://blobs/mine"]
            done = subprocess.run(command, env=wrong, capture_output=True, text=True, timeout=60)
            assert "RequestTimeTooSkewed" in done.stderr
            assert "clock" in done.stderr
    finally:
        server.stop()


@pytest.mark.parametrize("status", [503, 403])
@pytest.mark.parametrize(("when", "says"), [("rows", "Cannot list the blobs"), ("blobs", "Cannot read blob")])
def test_a_server_that_fails_is_no_damage_of_a_store(
    blobs: BucketBlobs, proxy: Proxy, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, when: str, says: str, status: int
):
    monkeypatch.setattr(s3, "TRIES", 1)
    where, failing = str(tmp_path / "store"), Faults(status=status, code="Unheard")
    with Store.open(where, create=True, blobs=blobs.location) as store:
        sound.fill(store)
    proxy.faults = Faults() if when == "blobs" else failing

    def progress(what: str, *_: object) -> None:
        proxy.faults = failing if what == "blobs" else proxy.faults

    with pytest.raises(Unavailable if status == 503 else StorageError, match=says) as caught:
        verify(where, blobs.location, progress=progress)
    one_line(caught.value)
