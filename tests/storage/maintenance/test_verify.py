"""What is missing, orphaned or corrupt in a store is found, whatever it is; and nothing is changed by looking."""

import os
import random
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from storage.database.schema import newest_schema
from storage.errors import NewerStore, NotAStore, OldStore, StorageError
from storage.maintenance.findings import StoreFinding
from storage.maintenance.verify import verify
from storage.store import Store
from tests.storage import sound
from tests.storage.sound import blob, change, contents, older


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a sound store."""
    with Store.open(tmp_path / "store", create=True) as store:
        sound.fill(store)
    return tmp_path / "store"


def found(folder: Path) -> list[StoreFinding]:
    """What there is to find; by looking nothing may change."""
    before = contents(folder)
    report = verify(str(folder))
    assert contents(folder) == before
    for finding in report.findings:
        assert (finding.place + finding.problem).isprintable()
        assert len(finding.place + finding.problem) < 800
    return report.findings


def test_nothing_is_found_in_a_sound_store(place: tuple[str, str]):
    where, blobs = place
    told = []
    with Store.open(where, create=True, blobs=blobs) as store:
        assert verify(where, blobs).findings == []  # nothing was ever put
        sound.fill(store)
        for _ in range(2):  # while it is open, and after that
            report = verify(where, blobs, progress=lambda *said: told.append(said))
            assert report.findings == []
            assert (report.blobs, report.recordings) == (11, 2)
            assert report.rows == 1 + 1 + 2 + 4 + 5 + 3 + 2 + 2 + 1 + 5 + 1
            store.close()
    assert ("matches", 3, None) in told
    assert ("blobs", 10, 11) in told


def test_a_sound_store_is_left_to_the_byte(folder: Path):
    assert found(folder) == []


def test_what_a_crash_left_in_the_log_is_read_and_stays_there(folder: Path, tmp_path: Path):
    with Store.open(folder) as store:
        store.queue([])
        store.set_config("cup", "broken =")
        crashed = tmp_path / "crashed"
        shutil.copytree(folder, crashed)
    assert (crashed / "league.db-wal").stat().st_size
    (finding,) = found(crashed)
    assert finding[:2] == ("corrupt", "leagues cup")
    assert "not TOML" in finding.problem


def damage_bytes(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    ("damage", "kind", "says"),
    [
        (Path.unlink, "missing", "missing"),
        (damage_bytes, "corrupt", "its bytes do not hash"),
        (lambda path: os.truncate(path, 5), "corrupt", "its bytes do not hash"),
        (lambda path: os.truncate(path, 0), "corrupt", "its bytes do not hash"),
        (pipe, "corrupt", "it is no file"),
        (directory, "corrupt", "it is no file"),
    ],
)
def test_every_blob_that_a_row_names_is_read(folder: Path, damage: Callable[[Path], None], kind: str, says: str):
    with Store.open(folder) as store:
        digests = {
            "snapshots cup/blue@1": next(s.digest for s in store.snapshots("cup") if s.name == "blue@1"),
            "checkpoints cup/red/2": store.newest_checkpoints("cup")["red"].digest,
            "matches cup/3": str(store.matches("cup")[2].recording),
        }
    for digest in digests.values():
        damage(blob(folder, digest))
    findings = {finding.place: finding for finding in found(folder)}
    assert findings.keys() == {f"blob {digest}" for digest in digests.values()}
    for row, digest in digests.items():
        finding = findings[f"blob {digest}"]
        assert finding.kind == kind
        assert says in finding.problem
        assert f"{row} names it" in finding.problem


def test_a_folder_of_blobs_that_is_gone_is_told_once(folder: Path):
    shutil.rmtree(folder / "blobs")
    (finding,) = found(folder)
    assert finding[:2] == ("missing", "blobs")
    assert "rows name 11" in finding.problem


@pytest.mark.parametrize(
    ("query", "data", "says"),
    [
        ("UPDATE matches SET recording = ? WHERE id = 1", b"no film", "damaged or cut short"),
        ("UPDATE matches SET recording = ? WHERE id = 1", sound.episode("blue@0", "red@0"), "recording of 'blue@0'"),
        (
            "UPDATE matches SET recording = ?, purpose = 'training' WHERE id = 1",
            sound.episode("blue@1", "green@0"),
            "recording of 'blue@1' against 'green@0'",
        ),
        ("UPDATE snapshots SET digest = ? WHERE name = 'blue@1'", b"no policy", "not stored arrays"),
        ("UPDATE checkpoints SET digest = ? WHERE id = 4", b"no state", "not stored arrays"),
        ("UPDATE snapshots SET digest = ? WHERE name = 'idle'", b'{"script": "other"}', "the script 'idle'"),
        ("UPDATE snapshots SET digest = ? WHERE name = 'idle'", b"[" * 100_000, ""),
    ],
)
def test_bytes_that_are_whole_and_of_something_else_are_found(folder: Path, query: str, data: bytes, says: str):
    with Store.open(folder) as store:
        digest = store.blobs.put(data)
    db = sqlite3.connect(folder / "league.db")
    with db:
        db.execute(query, [digest])
    db.close()
    (finding,) = found(folder)
    assert finding[:2] == ("corrupt", f"blob {digest}")
    assert says in finding.problem


def test_only_what_is_old_and_named_by_no_row_is_orphaned(folder: Path):
    with Store.open(folder) as store:
        stray, young = (store.blobs.put(data) for data in (b"stray", b"young"))
        needed = store.snapshots("cup")[0].digest
    left = folder / "blobs" / "ab" / ".01234567.0123456789abcdef"
    left.parent.mkdir(exist_ok=True)
    for path in (left, left.with_name(".89abcdef.0123456789abcdef"), folder / "blobs" / "readme"):
        path.write_bytes(b"half")
    for path in (left, blob(folder, stray), blob(folder, needed), folder / "blobs" / "readme"):
        older(path)
    assert sorted(found(folder)) == [
        ("orphaned", f"blob {stray}", "no row names it", 5),
        ("orphaned", f"file {left}", "a writer that was killed left it", 4),
    ]
    assert {finding.place for finding in verify(str(folder), age=0).findings} > {f"blob {young}", f"blob {stray}"}


@pytest.mark.parametrize(
    ("statement", "place", "says"),
    [
        ("UPDATE matches SET wins = 'five' WHERE id = 2", "matches cup/2", "wins is no whole number"),
        ("UPDATE matches SET wins = 2.5 WHERE id = 2", "matches cup/2", "wins is no whole number"),
        ("UPDATE matches SET wins = -1 WHERE id = 2", "matches cup/2", "wins is -1, below 0"),
        ("UPDATE runs SET host = 'a' || char(10) || 'b'", "runs cup/1", "host 'a\\nb' has characters that"),
        ("UPDATE matches SET side_wins = 6 WHERE id = 2", "matches cup/2", "of 5 wins, 6 were on the first side"),
        ("UPDATE matches SET voids_a = 1, voids_b = 1 WHERE id = 2", "matches cup/2", "of 1 voids"),
        ("UPDATE matches SET ww = 3 WHERE id = 2", "matches cup/2", "at least 7 wins, and 5 are counted"),
        ("UPDATE matches SET dd_wl = 9 WHERE id = 2", "matches cup/2", "13 seed pairs are more than 8 games have"),
        ("UPDATE matches SET purpose = 'fun' WHERE id = 2", "matches cup/2", "'fun' is none of"),
        ("UPDATE matches SET seconds = 9e999 WHERE id = 2", "matches cup/2", "seconds is no number"),
        ("UPDATE matches SET b = 'nobody' WHERE id = 2", "matches cup/2", "b 'nobody' is none of the snapshots"),
        ("UPDATE matches SET a = x'ff00' WHERE id = 2", "matches cup/2", "a is no text"),
        ("UPDATE matches SET a = CAST(x'ff' AS TEXT) WHERE id = 2", "matches cup/2", "a is no text in UTF-8"),
        ("UPDATE matches SET recording = '../../x' WHERE id = 2", "matches cup/2", "'../../x' is no blob's name"),
        ("UPDATE matches SET id = 7 WHERE id = 2", "matches cup/7", "id 7 is none of the 3"),
        ("DELETE FROM matches WHERE id = 2", "leagues cup", "counts 3 matches, and the rows of 2 are there"),
        ("UPDATE leagues SET matches = 9", "leagues cup", "counts 9 matches, and the rows of 3 are there"),
        ("UPDATE leagues SET config = '= nonsense'", "leagues cup", "not TOML"),
        ("UPDATE runs SET versions = '{'", "runs cup/1", "versions is no JSON"),
        ("UPDATE runs SET versions = '[1]'", "runs cup/1", "versions is no JSON object"),
        ('UPDATE curves SET "values" = \'{"loss": NaN}\' WHERE iteration = 1', "curves cup/blue/1", "is no JSON"),
        ('UPDATE curves SET "values" = \'{"loss": "high"}\' WHERE iteration = 1', "curves cup/blue/1", "no figure"),
        ("UPDATE curves SET player = 'green' WHERE iteration = 1", "curves cup/green/1", "none of the players"),
        ("UPDATE meetings SET chance = 1.5 WHERE id = 1", "meetings cup/blue/1", "chance is 1.5"),
        ("UPDATE phases SET learners = '{}'", "phases cup/1/0", "learners is no JSON list"),
        ("UPDATE phases SET since = '{\"blue\": -3}'", "phases cup/1/0", "no iteration for 'blue'"),
        ("UPDATE jobs SET payload = '7' WHERE key = 'waits'", "jobs cup/waits", "payload is no JSON object"),
        ("UPDATE jobs SET state = 'lost' WHERE key = 'waits'", "jobs cup/waits", "'lost' is none of"),
        ("UPDATE jobs SET holder = NULL WHERE key = 'leased'", "jobs cup/leased", "leased without a holder"),
        ("UPDATE jobs SET attempt = 99999999999", "jobs cup/job 0", "attempt is no whole number of 32 bits"),
        ("UPDATE workers SET status = 'busy'", "workers cup/host:1:x", "status is no JSON"),
        ("UPDATE workers SET pid = 'x'", "workers cup/host:1:x", "pid is no whole number"),
        ("UPDATE players SET team = -1 WHERE name = 'red'", "players cup/red", "team is -1"),
        ("UPDATE snapshots SET initial = 7 WHERE name = 'red@1'", "snapshots cup/red@1", "neither true nor false"),
        ("UPDATE snapshots SET origin = 'stolen' WHERE name = 'red@1'", "snapshots cup/red@1", "'stolen' is none of"),
        ("UPDATE snapshots SET script = 'x' WHERE name = 'red@1'", "snapshots cup/red@1", "origin is trained"),
        ("UPDATE checkpoints SET digest = 'abc' WHERE id = 1", "checkpoints cup/blue/1", "'abc' is no blob's name"),
        ("UPDATE checkpoints SET league = 'cap' WHERE id = 1", "checkpoints cap/blue/1", "league 'cap' is not there"),
        ("UPDATE robot_league SET schema = -4 WHERE schema > 0", "table robot_league", "-4 is no number of a schema"),
        ("DELETE FROM robot_league", "table robot_league", "None is no number of a schema"),
    ],
)
def test_rows_that_cannot_be_are_found(folder: Path, statement: str, place: str, says: str):
    change(folder, statement)
    findings = found(folder)
    assert [f for f in findings if f.kind == "corrupt" and f.place == place and says in f.problem], findings
    assert len(findings) <= 5  # one fault does not make a hundred


@pytest.mark.parametrize(
    "table", ["matches", "snapshots", "checkpoints", "players", "leagues", "workers", "robot_league"]
)
def test_a_table_that_is_missing_is_found_and_no_blob_called_orphaned(folder: Path, table: str):
    change(folder, f"PRAGMA foreign_keys = OFF; DROP TABLE {table}")
    for path in (folder / "blobs").rglob("*"):
        if path.is_file():
            older(path)
    findings = found(folder)
    assert ("missing", f"table {table}", "the database has no such table", 0) in findings
    if table not in ("workers", "robot_league"):
        assert not verify(str(folder)).references_known
    assert not [finding for finding in findings if finding.kind == "orphaned"]


@pytest.mark.parametrize(("table", "column"), [("matches", "seed"), ("matches", "recording"), ("leagues", "config")])
def test_a_column_that_is_missing_is_found(folder: Path, table: str, column: str):
    change(folder, f"ALTER TABLE {table} DROP COLUMN {column}")
    for path in (folder / "blobs").rglob("*"):
        if path.is_file():
            older(path)
    assert [f for f in found(folder) if f.kind != "corrupt"] == [
        ("missing", f"table {table}", f"it has no column {column!r}", 0)
    ]


def test_another_schema_is_refused_and_not_brought_up_to_date(folder: Path):
    for schema, kind, says in (
        (1, OldStore, "has schema 1"),
        (3, StorageError, f"has schema 3, and today's is {newest_schema()}: `league migrate` brings it"),
        (99, NewerStore, f"knows only up to {newest_schema()}"),
    ):
        change(folder, f"UPDATE robot_league SET schema = {schema} WHERE schema > 0")
        before = contents(folder)
        with pytest.raises(kind, match=says):
            verify(str(folder))
        assert contents(folder) == before


def cases(number: int) -> Iterator[random.Random]:
    for seed in range(number):
        yield random.Random(seed)


@pytest.mark.slow
def test_flipped_bits_anywhere_in_the_database_are_survived(folder: Path, tmp_path: Path):
    data = (folder / "league.db").read_bytes()
    unnoticed, refused = [], []
    for rng in cases(150):
        damaged = bytearray(data)
        bits = rng.choice((1, 1, 3, 30, 300))
        for _ in range(bits):
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        (folder / "league.db").write_bytes(damaged)
        try:
            if not found(folder):
                unnoticed.append(bits)
        except StorageError as error:  # such as another schema
            refused.append(str(error))
    assert max(unnoticed) < 300  # most of so small a file is empty, so one bit may well mean nothing
    assert len(unnoticed) < 100
    assert not [line for line in refused if "\n" in line or len(line) > 600]


def test_a_database_cut_short_anywhere_is_found_or_no_store(folder: Path):
    data = (folder / "league.db").read_bytes()
    for rng in cases(40):
        (folder / "league.db").write_bytes(data[: rng.randrange(len(data) - 1)])
        assert found(folder)
    (folder / "league.db").write_bytes(b"")
    assert [finding[:2] for finding in found(folder)] == [("missing", "database")]


def test_overwritten_pages_are_survived_and_what_can_be_read_is_read(folder: Path):
    data = (folder / "league.db").read_bytes()
    for rng in cases(40):
        damaged = bytearray(data)
        at = 4096 * rng.randrange(1, len(data) // 4096)
        damaged[at : at + 4096] = rng.choice((bytes(4096), rng.randbytes(4096), data[:4096]))
        (folder / "league.db").write_bytes(damaged)
        assert all(finding.kind != "orphaned" for finding in found(folder))


@pytest.mark.parametrize("name", ["league.db", "league.db-wal", "league.db-journal"])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_is_refused_and_waited_for_by_nobody(folder: Path, name: str, make: Callable[[Path], None]):
    (folder / name).unlink(missing_ok=True)
    make(folder / name)
    with pytest.raises(StorageError, match=f"{name} is (no file|a folder)") as caught:
        verify(str(folder))
    assert "\n" not in str(caught.value)
    if name == "league.db":
        with pytest.raises(NotAStore):
            Store.open(folder)


def test_something_else_is_no_store(tmp_path: Path):
    (tmp_path / "league.db").write_text("not a database\n" * 100)
    with pytest.raises(NotAStore, match="nor any SQLite database"):
        verify(str(tmp_path))
    (tmp_path / "league.db").unlink()
    change(tmp_path, "CREATE TABLE photos (name)")
    with pytest.raises(NotAStore, match="it has 'photos'"):
        verify(str(tmp_path))
    with pytest.raises(NotAStore, match="No league store"):
        verify(str(tmp_path / "absent"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["league.db"]


def test_an_id_that_is_no_number_is_refused_where_the_log_is_summed(folder: Path):
    change(folder, "UPDATE matches SET id = '*' WHERE id = 1")
    with Store.open(folder) as store, pytest.raises(StorageError, match="a row of table 'matches' is damaged"):
        store.totals("cup", "rating")


def test_a_store_that_this_user_may_not_write_is_not_called_corrupt(folder: Path):
    as_others = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    command = [*as_others, sys.executable, "-m", "league", "verify", "--store", str(folder)]
    folder.chmod(0o500)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    folder.chmod(0o700)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert "no permission to write there" in done.stderr
