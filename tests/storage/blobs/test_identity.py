"""The mark of a store among its blobs: a place that is not the store's is waited for or refused, never written to."""

from collections.abc import Callable
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.blobs.blobs import is_identity, open_blobs
from storage.blobs.identity import store_identity
from storage.database import schema as t
from storage.errors import DamagedBlob, StorageError, Unavailable
from storage.maintenance.verify import verify
from storage.records import Job, League
from storage.store import Store
from tests.storage.blobs.test_blob_places import bucket, s3_server  # noqa: F401  (fixtures)
from tests.storage.conftest import fill, snapshot


def identities(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if is_identity(path.name)]


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """A folder of blobs on a disk of its own, as far as a store can tell."""
    return tmp_path / "disk" / "blobs"


@pytest.fixture
def league(tmp_path: Path, kept: Path):
    with Store.open(tmp_path / "store", create=True, blobs=kept) as store:
        fill(store)
        yield store


@pytest.mark.parametrize("below", ["an empty folder", "nothing"])
def test_a_folder_of_blobs_that_is_unmounted_is_waited_for_and_not_made_anew(league: Store, kept: Path, below: str):
    named = league.snapshots("cup")[0].digest
    away = kept.rename(kept.with_name("unmounted"))
    if below == "an empty folder":  # as a mount point is
        kept.mkdir()
    league.queue([Job("cup", "any", "a job")])
    claimed = league.claim("cup", ["any"], "tester", 60)
    assert claimed
    verbs: list[Callable[[], object]] = [
        lambda: league.blobs.put(b"a checkpoint"),
        lambda: league.blobs.get(named),
        lambda: league.blobs.has(named),
        lambda: list(league.blobs.entries()),
        lambda: league.finish(claimed[0], snapshots=[snapshot(league, "blue@1")]),
    ]
    for verb in verbs:
        with pytest.raises(Unavailable, match="wait and try again") as caught:
            verb()
        assert "\n" not in str(caught.value)
        assert list(kept.rglob("*")) == []
    assert kept.exists() == (below == "an empty folder")
    if kept.exists():
        kept.rmdir()
    away.rename(kept)
    league.finish(claimed[0], snapshots=[snapshot(league, "blue@1")])
    assert b"blue@1" in [league.blobs.get(each.digest) for each in league.snapshots("cup")]


def test_a_folder_that_goes_while_a_blob_is_written_is_not_taken_for_the_store_s(league: Store, kept: Path):
    whole = league.blobs.kept.put

    def put(data: bytes) -> str:
        kept.rename(kept.with_name("unmounted"))
        kept.mkdir()
        return whole(data)

    league.blobs.kept.put = put  # type: ignore[method-assign]
    with pytest.raises(Unavailable):
        league.blobs.put(b"a checkpoint")


def test_blobs_of_another_store_are_refused_in_one_line(league: Store, kept: Path, tmp_path: Path):
    other = tmp_path / "disk" / "other"
    with Store.open(tmp_path / "second", create=True, blobs=other) as second:
        second.create_league(League("cap", ""))
        second.blobs.put(b"of the second")
    before = sorted(other.rglob("*"))
    with Store.open(tmp_path / "store", blobs=other) as store:
        for verb in (
            lambda: store.blobs.put(b"of the first"),
            lambda: store.blobs.get(store.snapshots("cup")[0].digest),
            lambda: list(store.blobs.entries()),
        ):
            with pytest.raises(StorageError, match=r"are of another store .*--blobs") as caught:
                verb()
            assert "\n" not in str(caught.value)
            assert not isinstance(caught.value, Unavailable)
    assert sorted(other.rglob("*")) == before


def test_stores_may_share_a_place_where_each_has_its_mark(league: Store, kept: Path, tmp_path: Path):
    with Store.open(tmp_path / "second", create=True, blobs=kept) as second:
        second.blobs.put(b"of the second")
        assert len(identities(kept)) == 2
        assert second.blobs.other_identities() == [store_identity(league._db)]
    assert league.blobs.get(league.blobs.put(b"blue@0")) == b"blue@0"


def of_before(store: Store, kept: Path) -> None:
    """Make the store as versions without marks left it."""
    with store._db.writing() as db:
        db.execute(sa.delete(t.changes).where(t.changes.c.schema == t.IDENTITY))
    for mark in identities(kept):
        (kept / mark).unlink()


def test_a_store_of_before_is_marked_by_its_first_writer(league: Store, kept: Path, tmp_path: Path):
    of_before(league, kept)
    with Store.open(tmp_path / "store", blobs=kept) as store:
        assert store.blobs.get(store.snapshots("cup")[0].digest) == b"blue@0"
        assert identities(kept) == []
        store.blobs.put(b"a checkpoint")
        assert identities(kept) == [store_identity(store._db)]


def test_a_store_of_before_whose_disk_is_not_there_is_waited_for(league: Store, kept: Path, tmp_path: Path):
    of_before(league, kept)
    kept.rename(kept.with_name("unmounted"))
    with Store.open(tmp_path / "store", blobs=kept) as store, pytest.raises(Unavailable, match="not mounted"):
        store.blobs.put(b"a checkpoint")
    assert not kept.exists()


def test_a_copy_that_left_the_mark_behind_is_known_by_its_blobs(league: Store, kept: Path, tmp_path: Path):
    (mark,) = identities(kept)
    (kept / mark).unlink()
    league.blobs.put(b"a checkpoint")
    assert identities(kept) == [mark]
    with pytest.raises(DamagedBlob, match="missing"):
        league.blobs.get("0" * 64)


def test_writers_that_mark_at_the_same_time_agree(league: Store, kept: Path, tmp_path: Path):
    of_before(league, kept)
    with Store.open(tmp_path / "store", blobs=kept) as second:
        first = league.blobs
        first._known = None
        mark = first.kept.add_identity

        def late(name: str) -> None:
            mark(name)
            second.blobs.put(b"the second is faster")

        first.kept.add_identity = late  # type: ignore[method-assign]
        first.put(b"a checkpoint")
        assert identities(kept) == [store_identity(second._db)]


def test_a_bucket_that_is_another_store_s_is_refused_and_an_empty_one_waited_for(
    bucket: str,  # noqa: F811
    tmp_path: Path,
):
    place = f"s3://{bucket}/mine"
    with Store.open(tmp_path / "store", create=True, blobs=place) as store:
        fill(store)
        assert open_blobs(place).identities() == [store_identity(store._db)]
        assert len(list(store.blobs.entries())) == 2
    with (
        Store.open(tmp_path / "store", blobs=f"s3://{bucket}/none") as store,
        pytest.raises(Unavailable, match="no mark"),
    ):
        store.blobs.put(b"a checkpoint")
    with Store.open(tmp_path / "second", create=True, blobs=f"s3://{bucket}/other") as second:
        second.blobs.put(b"of the second")
    with (
        Store.open(tmp_path / "store", blobs=f"s3://{bucket}/other") as store,
        pytest.raises(StorageError, match="are of another store"),
    ):
        store.blobs.put(b"a checkpoint")


def test_verify_tells_that_the_mark_is_gone_where_blobs_are(league: Store, kept: Path, tmp_path: Path):
    (mark,) = identities(kept)
    assert not [f for f in verify(str(tmp_path / "store"), str(kept)).findings if f.kind == "missing"]
    kept.rename(kept.with_name("unmounted"))
    kept.mkdir()
    found = verify(str(tmp_path / "store"), str(kept)).findings
    assert [finding.place for finding in found if finding.place.startswith("file ")] == [f"file {mark}"]
