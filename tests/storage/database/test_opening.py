"""Finding, making and refusing stores; migrations; what importing costs."""

import multiprocessing
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import sqlalchemy as sa

from storage.database import schema
from storage.database.urls import blobs_are_exclusive, database_url
from storage.errors import NewerStore, NotAStore, OldStore, OutdatedStore, StorageError, Unavailable
from storage.records import ArenaKey, League, RankedMatch
from storage.store import Store
from tests.storage.conftest import fill, finish_a_job, match

LEAGUE = League("cup", "seed = 1")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_is_written_is_there_for_who_opens_it_next(place: tuple[str, str]):
    where, blobs = place
    with Store.open(where, create=True, blobs=blobs) as store:
        store.create_league(LEAGUE)
        digest = store.blobs.put(b"a policy")
    for create in (False, True):
        with Store.open(where, create=create, blobs=blobs) as store:
            assert store.league("cup").config == LEAGUE.config
            assert store.blobs.get(digest) == b"a policy"


def test_nothing_there_is_told_with_the_remedy(place: tuple[str, str]):
    with pytest.raises(NotAStore, match=r"No league store at .*`league run` makes one"):
        Store.open(place[0], blobs=place[1])


def test_looking_for_a_store_makes_no_folder(tmp_path: Path):
    with pytest.raises(NotAStore):
        Store.open(tmp_path / "absent")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_and_the_url_of_its_file_are_the_same_store(tmp_path: Path):
    folder = tmp_path / "a ?#%26b"  # nothing in a folder's name is special
    with Store.open(folder, create=True) as store:
        store.create_league(LEAGUE)
        digest = store.blobs.put(b"a policy")
    with Store.open(folder) as store:
        assert [league.name for league in store.leagues()] == ["cup"]
    folder = folder.rename(tmp_path / "moved")
    with Store.open(f"sqlite:///{folder}/league.db") as store:
        assert [league.name for league in store.leagues()] == ["cup"]
        assert store.blobs.get(digest) == b"a policy"


def test_reading_changes_no_file(tmp_path: Path):
    with Store.open(tmp_path, create=True) as store:
        store.create_league(LEAGUE)
    before = contents(tmp_path)
    with Store.open(tmp_path) as store:
        store.leagues()
        store.jobs("cup")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("create", [False, True])
def test_something_else_is_left_as_it_is(tmp_path: Path, create: bool):
    text, photos, music = tmp_path / "notes.txt", tmp_path / "photos.db", tmp_path / "music.db"
    text.write_text("not a database\n" * 100)
    db = sqlite3.connect(photos)
    db.execute("CREATE TABLE photos (name)")
    db.close()
    db = sqlite3.connect(tmp_path / "played.db")
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("CREATE TABLE music (name)")
    for end in ("", "-wal"):  # as after a crash: what was written last is still in the log
        shutil.copy(tmp_path / f"played.db{end}", f"{music}{end}")
    db.close()
    before = contents(tmp_path)
    for where, complaint in (
        (str(text), "is a file"),
        (f"sqlite:///{text}", "nor any SQLite database"),
        (f"sqlite:///{photos}", "something else .it has 'photos'"),
        (f"sqlite:///{music}", "something else .it has 'music'"),
        (f"sqlite:///{tmp_path}", "is a folder"),
    ):
        with pytest.raises(NotAStore, match=complaint):
            Store.open(where, create=create)
    after = contents(tmp_path)
    assert {path: after[path] for path in before} == before


def test_a_store_that_was_being_made_when_killed_is_made_anew(tmp_path: Path):
    (tmp_path / "league.db").touch()
    with pytest.raises(NotAStore, match="makes one"):
        Store.open(tmp_path)
    with Store.open(tmp_path, create=True) as store:
        assert store.leagues() == []


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"Cannot make a store at .*file/runs/league.db: Not a directory") as caught:
        Store.open(tmp_path / "file" / "runs", create=True)
    assert "\n" not in str(caught.value)


def test_a_store_of_somebody_else_is_one_line(tmp_path: Path):
    with Store.open(tmp_path / "theirs", create=True) as store:
        store.create_league(LEAGUE)
    (tmp_path / "theirs").chmod(0o500)
    if os.access(tmp_path / "theirs", os.W_OK):
        pytest.skip("this user, root, may write everywhere")
    with pytest.raises(StorageError, match="no permission to write"):
        Store.open(tmp_path / "theirs")
    (tmp_path / "theirs").chmod(0o000)
    with pytest.raises(StorageError, match="Permission denied"):
        Store.open(tmp_path / "theirs", create=True)
    (tmp_path / "theirs").chmod(0o700)


def test_a_full_disk_is_one_line_and_writes_nothing(tmp_path: Path):
    with Store.open(tmp_path, create=True) as store:
        store.create_league(LEAGUE)

        @sa.event.listens_for(store._db.engine, "begin")
        def _fill(db: sa.Connection) -> None:
            db.exec_driver_sql("PRAGMA max_page_count = 1")  # SQLite then says what it says on a full disk

        with pytest.raises(Unavailable, match=r"the disk is full; nothing was half written.*wait and try again"):
            store.set_config("cup", "x" * 1_000_000)
        assert store.league("cup").config == LEAGUE.config


def test_a_newer_store_is_refused_and_both_schemas_named(place: tuple[str, str], monkeypatch: pytest.MonkeyPatch):
    where, blobs = place
    monkeypatch.setattr(schema, "MIGRATIONS", [print] * 9)
    Store.open(where, create=True, blobs=blobs).close()
    monkeypatch.undo()
    for create in (False, True):
        known = schema.newest_schema()
        with pytest.raises(NewerStore, match=f"has schema 11, but this program knows only up to {known}: update"):
            Store.open(where, create=create, blobs=blobs)


@pytest.mark.parametrize("create", [False, True])
def test_a_store_of_the_first_schema_is_refused_and_left_as_it_is(place: tuple[str, str], create: bool):
    where, blobs = place
    Store.open(where, create=True, blobs=blobs).close()
    with Store.open(where, blobs=blobs) as store, store._db.writing() as db:
        db.execute(sa.update(schema.changes).values(schema=1))
        db.execute(sa.text("ALTER TABLE leagues ADD COLUMN arena TEXT"))
    with pytest.raises(OldStore, match=r"has schema 1, .*can be brought up to date .2.*give another place") as caught:
        Store.open(where, create=create, blobs=blobs)
    assert "\n" not in str(caught.value)


def test_a_store_of_schema_2_is_brought_up_to_date_and_its_matches_cost_what_nobody_knows(
    place: tuple[str, str], tmp_path: Path
):
    where, blobs = place
    with Store.open(where, create=True, blobs=blobs) as store:
        fill(store)
        finish_a_job(store, matches=[match(1)])
        with store._db.writing() as db:
            for column in ("seconds", "due", "causes"):
                db.execute(sa.text(f"ALTER TABLE matches DROP COLUMN {column}"))
            db.execute(sa.text("DROP TABLE meetings"))
            db.execute(sa.text("DROP TABLE dropped"))
            db.execute(sa.text("DROP TABLE ranked_matches"))
            db.execute(sa.text("ALTER TABLE snapshots DROP COLUMN thinned"))
            db.execute(sa.text("DROP INDEX jobs_to_claim"))
            db.execute(sa.text("CREATE INDEX jobs_to_claim ON jobs (league, state, priority)"))
            db.execute(sa.update(schema.changes).where(schema.changes.c.schema > 0).values(schema=2))
    copy = tmp_path / "store" / "league.db.schema-2"
    if "://" in where:  # what is on a server is brought up to date by those who ask for it
        says = rf"has schema 2, and this program's is {schema.newest_schema()}: .*`league migrate`"
        with pytest.raises(OutdatedStore, match=says) as caught:
            Store.open(where, blobs=blobs, create=True)
        assert "\n" not in str(caught.value)
    with Store.open(where, blobs=blobs, migrate=True) as store:
        finish_a_job(store, matches=[replace(match(2), seconds=1.5, due=7.25)])
        assert [(m.seed, m.seconds, m.due) for m in store.matches("cup")] == [(1, 0.0, None), (2, 1.5, 7.25)]
        assert store.booked("cup") == (1.5, 7.25)
        assert {m.causes for m in store.matches("cup")} == {0}
        assert store.meetings("cup") == []
        assert store.ranked_matches("cup") == []
        assert {s.thinned for s in store.snapshots("cup")} == {None}
        indexes = {index["name"]: index["column_names"] for index in sa.inspect(store._db.engine).get_indexes("jobs")}
        assert indexes["jobs_to_claim"] == ["league", "state", "kind", "priority", "id"]
    if "://" not in where:
        assert blobs_are_exclusive(blobs, database_url(where))
        db = sqlite3.connect(copy)
        assert db.execute("SELECT max(schema) FROM robot_league").fetchone() == (2,)
        assert db.execute("SELECT seed FROM matches").fetchall() == [(1,)]
        db.close()


def test_a_store_of_schema_8_is_brought_up_to_date_and_its_rankings_share_no_seeds(place: tuple[str, str]):
    where, blobs = place
    rankings = {(1, 2, 3): 2}
    row = RankedMatch("cup", ArenaKey("tag", "beef", "c"), ("blue@0", "red@0", "blue@0"), rankings, 0, (0, 0, 0), 1)
    with Store.open(where, create=True, blobs=blobs) as store:
        fill(store)
        finish_a_job(store, matches=[row])
        with store._db.writing() as db:
            db.execute(sa.text("ALTER TABLE ranked_matches DROP COLUMN seed_clusters"))
            db.execute(sa.update(schema.changes).where(schema.changes.c.schema > 0).values(schema=8))
    shared = {((1, 2, 3), (2, 1, 3)): 1}
    with Store.open(where, blobs=blobs, migrate=True) as store:
        finish_a_job(store, matches=[replace(row, seed=2, seed_clusters=shared)])
        assert [(m.seed, m.rankings, m.seed_clusters) for m in store.ranked_matches("cup")] == [
            (1, rankings, {}), (2, rankings, shared),
        ]  # fmt: skip


def add_notes(db: sa.Connection) -> None:
    db.execute(sa.text("CREATE TABLE notes (body TEXT)"))


def fill_notes_and_fail(db: sa.Connection) -> None:
    db.execute(sa.text("INSERT INTO notes VALUES ('half')"))
    db.execute(sa.text("INSERT INTO nowhere VALUES (1)"))


def fill_notes(db: sa.Connection) -> None:
    db.execute(sa.text("INSERT INTO notes VALUES ('whole')"))


def test_each_migration_is_whole_recorded_and_made_once(place: tuple[str, str], monkeypatch: pytest.MonkeyPatch):
    where, blobs = place
    Store.open(where, create=True, blobs=blobs).close()
    made_so_far, today = schema.MIGRATIONS, schema.newest_schema()
    monkeypatch.setattr(schema, "MIGRATIONS", [*made_so_far, add_notes, fill_notes_and_fail])
    with pytest.raises(StorageError, match="nowhere"):
        Store.open(where, blobs=blobs, migrate=True)
    monkeypatch.setattr(schema, "MIGRATIONS", [*made_so_far, add_notes, fill_notes])
    for _ in range(2):
        with Store.open(where, blobs=blobs, migrate=True) as store, store._db.engine.connect() as db:
            made = db.execute(sa.select(schema.changes.c.schema, schema.changes.c.change)).all()
            notes = db.execute(sa.text("SELECT body FROM notes")).all()
        assert sorted(map(tuple, made)) == [
            (today, "created"), (today + 1, "add_notes"), (today + 2, "fill_notes")
        ]  # fmt: skip
        assert notes == [("whole",)]


def test_a_store_that_cannot_be_copied_is_not_brought_up_to_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    Store.open(tmp_path, create=True).close()
    monkeypatch.setattr(schema, "MIGRATIONS", [*schema.MIGRATIONS, add_notes])
    copy = tmp_path / f"league.db.schema-{schema.newest_schema() - 1}"
    copy.mkdir()
    with pytest.raises(StorageError, match=r"could not be copied before .* and stays") as caught:
        Store.open(tmp_path)
    assert "\n" not in str(caught.value)
    copy.rmdir()
    monkeypatch.undo()
    Store.open(tmp_path).close()  # it is what it was
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith((".league", "league.db.schema"))]


def make(where: str, blobs: str, name: str) -> None:
    with Store.open(where, create=True, blobs=blobs) as store:
        store.create_league(League(name, ""))


def test_a_store_made_by_many_at_once_is_one_store(place: tuple[str, str]):
    context = multiprocessing.get_context("spawn")
    makers = [context.Process(target=make, args=(*place, f"cup {i}")) for i in range(6)]
    for maker in makers:
        maker.start()
    for maker in makers:
        maker.join()
    assert [maker.exitcode for maker in makers] == [0] * 6
    with Store.open(place[0], blobs=place[1]) as store:
        assert {league.name for league in store.leagues()} == {f"cup {i}" for i in range(6)}


def test_opening_a_store_loads_nothing_heavy():
    code = "import storage.store, sys; print({'jax', 'torch', 'mujoco', 'pandas', 'numpy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.fixture(params=["SQL_ASCII", "LATIN1", "UTF8"])
def encoded(request: pytest.FixtureRequest, server_url: str) -> Iterator[tuple[str, str]]:
    """A database of its own on the server, and its encoding."""
    name = f"league_test_{request.param.lower()}_{os.getpid()}"
    url = sa.make_url(server_url).difference_update_query(["options"])
    server = sa.create_engine(url, isolation_level="AUTOCOMMIT")
    with server.connect() as db:
        db.execute(sa.text(f"CREATE DATABASE {name} ENCODING '{request.param}' LOCALE 'C' TEMPLATE template0"))
    yield url.set(database=name).render_as_string(hide_password=False), request.param
    with server.connect() as db:
        db.execute(sa.text(f"DROP DATABASE {name} WITH (FORCE)"))
    server.dispose()


def test_a_server_s_database_that_cannot_hold_every_text_is_refused_before_anything_is_written(
    encoded: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    where, encoding = encoded
    monkeypatch.setenv("PGCLIENTENCODING", "LATIN1")
    name = "Łódź · 东京"
    if encoding == "UTF8":
        with Store.open(where, create=True, blobs=str(tmp_path)) as store:
            store.create_league(League(name, "seed = 1"))
            assert [league.name for league in store.leagues()] == [name]
        return
    with pytest.raises(StorageError, match=f"encoding {encoding}, and a store needs UTF8; nothing was written") as told:
        Store.open(where, create=True, blobs=str(tmp_path))
    assert "\n" not in str(told.value)
    with pytest.raises(NotAStore):
        Store.open(where, blobs=str(tmp_path))
    server = sa.create_engine(sa.make_url(where).set(drivername="postgresql+psycopg"))
    assert sa.inspect(server).get_table_names() == []
    server.dispose()


@pytest.mark.parametrize("encoded", ["SQL_ASCII", "LATIN1"], indirect=True)
def test_a_store_that_was_made_in_another_encoding_still_opens(
    encoded: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("storage.database.opening._require_unicode", lambda *_: None)
    with Store.open(encoded[0], create=True, blobs=str(tmp_path)) as store:
        store.create_league(League("cup", "seed = 1"))
    monkeypatch.undo()
    with Store.open(encoded[0], blobs=str(tmp_path)) as store:
        store.create_league(League("café", "seed = 2"))
        assert {league.name for league in store.leagues()} == {"cup", "café"}


@pytest.mark.parametrize("schema", [1, 99, None])
@pytest.mark.parametrize("create", [False, True])
def test_nothing_is_left_beside_a_file_that_is_refused(tmp_path: Path, schema: int | None, create: bool):
    Store.open(tmp_path, create=True).close()
    with sqlite3.connect(tmp_path / "league.db") as db:
        if schema is None:  # a database of something else, which keeps a log as well
            db.execute("DROP TABLE robot_league")
        else:
            db.execute("UPDATE robot_league SET schema = ?", [schema])
    db.close()
    before = contents(tmp_path)
    with pytest.raises((OldStore, NewerStore, NotAStore)):
        Store.open(tmp_path, create=create)
    assert contents(tmp_path) == before


def test_a_file_that_others_have_open_is_looked_at_with_what_their_log_holds(tmp_path: Path):
    with Store.open(tmp_path, create=True) as store:
        store.create_league(LEAGUE)
        assert (tmp_path / "league.db-wal").exists()
        with Store.open(tmp_path) as other:
            assert other.leagues() == store.leagues()
