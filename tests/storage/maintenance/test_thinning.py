"""What nobody needs is removed, and nothing that a row still names, whatever is put meanwhile."""

import multiprocessing
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.blobs.blobs import BlobEntry, open_blobs
from storage.database import schema as t
from storage.errors import StorageError
from storage.maintenance.thinning import Removed, RetentionPolicy
from storage.maintenance.verify import verify
from storage.records import Checkpoint, Job, League, Player, Snapshot
from storage.store import Store
from tests.storage import sound
from tests.storage.conftest import KEY, finish_a_job
from tests.storage.sound import DAY, blob, change, contents, older


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a store all of whose files and rows are two days old."""
    with Store.open(tmp_path / "store", create=True) as store:
        sound.fill(store)
    age(tmp_path / "store")
    return tmp_path / "store"


def age(folder: Path) -> None:
    for path in (folder / "blobs").rglob("*"):
        if path.is_file():
            older(path)
    for table, column in (("checkpoints", "created"), ("matches", "created"), ("workers", "seen")):
        change(folder, f"UPDATE {table} SET {column} = {column} - {2 * DAY}")


def policy(keep: int = 8, **more: object) -> RetentionPolicy:
    return RetentionPolicy(DAY, {"cup": keep}, **more)  # type: ignore[arg-type]


def thin(folder: Path, chosen: RetentionPolicy) -> Removed:
    with Store.open(folder) as store:
        return store.thin(store.find_removable(chosen))


def files(folder: Path) -> set[str]:
    return {str(path) for path in (folder / "blobs").rglob("*") if path.is_file()}


def test_a_store_of_what_is_needed_keeps_all_of_it(folder: Path):
    change(folder, "DELETE FROM workers")
    before = contents(folder)
    with Store.open(folder) as store:
        assert not store.find_removable(policy())
    assert contents(folder) == before


@pytest.mark.parametrize(("state", "kept"), [("queued", True), ("leased", True), ("done", False)])
def test_what_a_job_that_is_to_be_done_points_to_stays(folder: Path, state: str, kept: bool):
    with Store.open(folder) as store:
        copied = store.blobs.put(b"a checkpoint whose row has gone")
        store.queue([Job("cup", "train", "turn", {"copies": {"blue": ["red", copied, "red@1"]}})])
        if state != "queued":
            claimed = store.claim("cup", ["train"], "w:1:1", 60)
            while claimed is not None and claimed[1].key != "turn":
                claimed = store.claim("cup", ["train"], "w:1:1", 60)
            assert claimed is not None
            if state == "done":
                store.finish(claimed[0])
    older(blob(folder, copied))
    thin(folder, policy())
    assert blob(folder, copied).exists() == kept


def test_what_nobody_names_goes_and_what_is_young_stays(folder: Path):
    with Store.open(folder) as store:
        stray, young = store.blobs.put(b"stray"), store.blobs.put(b"young")
    left = folder / "blobs" / stray[:2] / ".01234567.0123456789abcdef"
    fresh = left.with_name(".89abcdef.0123456789abcdef")
    foreign = folder / "blobs" / stray[:2] / "notes.txt"
    for path in (left, fresh, foreign):
        path.write_bytes(b"half")
    for path in (left, foreign, blob(folder, stray)):
        older(path)
    before = files(folder)
    with Store.open(folder) as store:
        waste = store.find_removable(policy())
        assert [entry.name for entry in waste.blobs] == [stray]
        assert [entry.name for entry in waste.files] == [str(left)]
        assert waste.workers == ["host:1:x"]
        assert files(folder) == before
        assert store.thin(waste) == Removed(0, 0, 1, 1, 1, 9)
        assert store.workers("cup", 1e9) == []
    assert before - files(folder) == {str(blob(folder, stray)), str(left)}
    assert blob(folder, young).is_file()
    assert verify(str(folder)).findings == []
    assert not thin(folder, policy()).bytes


def test_of_each_player_the_newest_checkpoints_stay(folder: Path):
    with Store.open(folder) as store:
        newest = store.newest_checkpoints("cup")
        done = store.thin(store.find_removable(policy(1)))
        assert (done.checkpoints, done.blobs) == (2, 2)
        assert {c.player: c for c in store.checkpoints("cup")} == newest
        for checkpoint in newest.values():
            store.blobs.get(checkpoint.digest)
    assert verify(str(folder), age=0).findings == []


def test_a_checkpoint_that_has_just_been_written_stays_beside_the_newest(folder: Path):
    with Store.open(folder) as store:
        state = store.blobs.put(sound.policy(7))
        finish_a_job(store, checkpoints=[Checkpoint("cup", "blue", state, 30, 3, 1.5, KEY)])
        finish_a_job(store, checkpoints=[Checkpoint("cup", "blue", state, 40, 4, 2.0, KEY)])
        store.thin(store.find_removable(policy(1)))
        assert [(c.player, c.iteration) for c in store.checkpoints("cup")] == [("red", 2), ("blue", 3), ("blue", 4)]


def test_thinning_one_league_leaves_the_checkpoints_of_another(folder: Path):
    with Store.open(folder) as store:
        store.create_league(League("plate", ""))
        store.add_players([Player("plate", "blue", 0, "main", "ant:3:2")])
        state = store.blobs.put(sound.policy(7))
        for i in (1, 2, 3):
            finish_a_job(store, "plate", checkpoints=[Checkpoint("plate", "blue", state, 10 * i, i, 0.5 * i, KEY)])
    age(folder)
    assert thin(folder, policy(1)).checkpoints == 2
    with Store.open(folder) as store:
        assert [c.iteration for c in store.checkpoints("plate")] == [1, 2, 3]


def test_recordings_go_by_number_or_age_and_their_matches_stay(folder: Path):
    with Store.open(folder) as store:
        before = store.matches("cup")
        for chosen in (policy(), policy(recordings=2), policy(recorded_for=3 * DAY)):
            assert not store.find_removable(chosen).recordings
        assert len(store.find_removable(policy(recorded_for=1.5 * DAY)).recordings) == 2
        done = store.thin(store.find_removable(policy(recordings=1)))
        assert (done.recordings, done.blobs) == (1, 1)
        after = store.matches("cup")
        assert [m.recording for m in after] == [None, None, before[2].recording]
        assert [(m.id, m.wins, m.seed) for m in after] == [(m.id, m.wins, m.seed) for m in before]
    assert verify(str(folder), age=0).findings == []


def test_a_blob_that_another_row_names_too_stays(folder: Path):
    with Store.open(folder) as store:
        first = store.checkpoints("cup")[0].digest
    change(folder, f"UPDATE snapshots SET digest = '{first}' WHERE name = 'blue@1'")
    with Store.open(folder) as store:
        done = store.thin(store.find_removable(policy(1)))
        assert (done.checkpoints, done.blobs) == (2, 2)  # the other checkpoint's, and what blue@1 named before
        store.blobs.get(first)
    assert verify(str(folder), age=0).findings == []


def test_what_is_put_between_finding_and_removing_stays(folder: Path):
    with Store.open(folder) as store:
        stray = store.blobs.put(b"stray")
        older(blob(folder, stray))
        waste = store.find_removable(policy())
        assert [entry.name for entry in waste.blobs] == [stray]
        store.blobs.put(b"stray")  # a turn is done again, and gives the same bytes; its row comes later
        assert store.thin(waste).blobs == 0
        assert store.blobs.get(stray) == b"stray"
        older(blob(folder, stray))
        finish_a_job(store, checkpoints=[Checkpoint("cup", "blue", stray, 30, 3, 1.5, KEY)])
        assert store.thin(waste).blobs == 0
        assert store.blobs.get(stray) == b"stray"


def test_who_puts_the_same_bytes_while_they_are_removed_has_them(tmp_path: Path):
    blobs = open_blobs(tmp_path)
    digest = blobs.put(b"again")
    path = tmp_path / digest[:2] / digest[2:]
    now = path.stat().st_mtime
    for _ in range(200):
        older(path)
        removers = [
            threading.Thread(target=lambda: blobs.remove(BlobEntry(digest, 5, 0.0), before=now - DAY)) for _ in range(3)
        ]
        for remover in removers:
            remover.start()
        blobs.put(b"again")
        for remover in removers:
            remover.join()
        assert blobs.get(digest) == b"again"
    assert [file.name for file in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("UPDATE checkpoints SET digest = 'abc' WHERE id = 1", "a row of checkpoints names no blob"),
        ("UPDATE snapshots SET digest = x'ff' WHERE name = 'red@1'", "a row of snapshots names no blob"),
        ("DROP TABLE matches", "no such table"),
        ("ALTER TABLE matches DROP COLUMN recording", "no such column"),
    ],
)
def test_of_a_damaged_store_nothing_is_removed(folder: Path, statement: str, says: str):
    with Store.open(folder) as store:
        older(blob(folder, store.blobs.put(b"stray")))
    change(folder, statement)
    before = contents(folder)
    with pytest.raises(StorageError, match=says):
        thin(folder, policy(1))
    assert contents(folder) == before


def test_of_a_damaged_file_nothing_is_removed(folder: Path):
    data = (folder / "league.db").read_bytes()
    older(blob(folder, open_blobs(folder / "blobs").put(b"stray")))
    blobs, refused = files(folder), 0
    for page in range(1, len(data) // 4096):
        (folder / "league.db").write_bytes(data[: 4096 * page] + bytes(4096) + data[4096 * (page + 1) :])
        try:
            thin(folder, policy())
        except StorageError:
            refused += 1
            assert files(folder) == blobs
    assert refused >= len(data) // 4096 - 2


def test_blobs_that_are_sought_in_the_wrong_place_are_not_thinned(folder: Path, tmp_path: Path):
    shutil.copytree(folder / "blobs", tmp_path / "moved")
    digest = open_blobs(folder / "blobs").put(b"of another store")
    for path in files(folder):
        if digest[2:] not in path:
            Path(path).unlink()
    older(blob(folder, digest))
    with pytest.raises(StorageError, match="say where, by --blobs"):
        thin(folder, policy())
    assert blob(folder, digest).is_file()


def thin_at_once(where: str) -> None:
    with Store.open(where) as store:
        store.thin(store.find_removable(policy(1, recordings=0)))


def test_several_that_thin_at_once_do_it_once(folder: Path):
    context = multiprocessing.get_context("spawn")
    thinners = [context.Process(target=thin_at_once, args=(str(folder),)) for _ in range(3)]
    for thinner in thinners:
        thinner.start()
    for thinner in thinners:
        thinner.join()
    assert [thinner.exitcode for thinner in thinners] == [0] * 3
    assert verify(str(folder), age=0).findings == []
    with Store.open(folder) as store:
        assert len(store.checkpoints("cup")) == 2
        assert [m.recording for m in store.matches("cup")] == [None] * 3


def test_a_thinned_snapshot_keeps_its_row_and_what_it_has_played(folder: Path):
    many(folder)
    with Store.open(folder) as store:
        before, log = store.snapshots("cup"), store.totals("cup", "rating")
        revision = store.revision("cup")
        every = policy(snapshots={"cup": {s.name for s in before}})
        done = store.thin(store.find_removable(every))
        assert (done.snapshots, done.blobs) == (3, 3)  # blue@1, blue@2, red@1: neither first, newest nor a script
        assert store.snapshot_count("cup") == (len(before), 3)
        assert store.revision("cup") > revision  # a plan that runs looks again
        after = store.snapshots("cup")
        thinned = [s for s in after if s.thinned is not None]
        assert [s.name for s in thinned] == ["blue@1", "red@1", "blue@2"]
        assert [replace(s, thinned=None) for s in after] == before
        assert store.totals("cup", "rating") == log
        for s in after:
            assert store.blobs.has(s.digest) == (s.thinned is None)
        assert not store.find_removable(every)
    assert verify(str(folder), age=0).findings == []


def test_what_a_waiting_job_names_is_not_thinned_and_no_job_is_queued_that_names_a_thinned_one(folder: Path):
    many(folder)
    every = policy(snapshots={"cup": {"blue@1", "blue@2", "red@1"}})
    waiting = Job("cup", "match", "batch", {"pairs": [["blue@1", "idle"]]})
    with Store.open(folder) as store:
        found = store.find_removable(every)
        store.queue([waiting])  # between finding and removing
        store.queue([Job("cup", "fails", "set aside", {"past": {"red@1": 1}})])
        lease, _ = store.claim("cup", ["fails"], "w:1:1", 60) or (None, None)
        assert lease is not None
        assert store.fail(lease, "no", tries=1)
        assert len(found.snapshots) == 3
        assert store.thin(found).snapshots == 1
        assert [s.name for s in store.snapshots("cup") if s.thinned is not None] == ["blue@2"]
        gone, fine = (Job("cup", "match", key, {"pairs": [[key, "idle"]]}) for key in ("blue@2", "blue@4"))
        assert store.queue([gone, fine]) == 1
        assert [job.key for job in store.jobs("cup", "queued", "match")] == ["batch", "blue@4"]


def test_a_young_snapshot_is_not_thinned(folder: Path):
    many(folder)
    change(folder, f"UPDATE snapshots SET created = created + {2 * DAY} WHERE name = 'blue@2'")
    assert thin(folder, policy(snapshots={"cup": {"blue@1", "blue@2"}})).snapshots == 1


def test_bytes_that_another_snapshot_needs_stay(folder: Path):
    many(folder)
    with Store.open(folder) as store:
        first = next(s for s in store.snapshots("cup") if s.name == "blue@1")
        store.add_snapshots([replace(first, name="copy", player=None, origin="imported")])
        done = store.thin(store.find_removable(policy(snapshots={"cup": {"blue@1", "copy"}})))
        assert (done.snapshots, done.blobs) == (1, 0)
        assert store.blobs.has(first.digest)


def many(folder: Path) -> None:
    """Give blue and red a history, of two days ago, with matches."""
    with Store.open(folder) as store:
        put = store.blobs.put
        store.add_snapshots([
            Snapshot("cup", f"{name}@{i}", put(sound.policy(50 + i + 10 * team)), "ant:3:2", name, iteration=i)
            for team, name in enumerate(("blue", "red"))
            for i in ((2, 4) if name == "blue" else (2,))
        ])  # fmt: skip
        finish_a_job(store, matches=[sound.match(9, a="blue@2")])
        change(folder, "DELETE FROM workers")
    age(folder)
    change(folder, f"UPDATE snapshots SET created = created - {2 * DAY}")


def test_every_database_is_thinned_alike(place: tuple[str, str]):
    where, blobs = place
    with Store.open(where, create=True, blobs=blobs) as store:
        sound.fill(store)
        store.blobs.put(b"stray")
        with store._db.writing() as db:
            for table, column in ((t.checkpoints, "created"), (t.matches, "created"), (t.workers, "seen")):
                db.execute(sa.update(table).values({column: table.c[column] - 2 * DAY}))
        for path in Path(blobs).rglob("*"):
            if path.is_file():
                older(path)
        before = store.totals("cup", "rating")
        done = store.thin(store.find_removable(policy(1, recordings=1)))
        assert done == Removed(2, 1, 1, 4, 0, done.bytes)
        assert store.totals("cup", "rating") == before
    assert verify(where, blobs, age=0).findings == []
