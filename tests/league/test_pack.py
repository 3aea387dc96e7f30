"""Leagues packed into one file and unpacked into another store are what they were, or nothing is written at all."""

import contextlib
import hashlib
import io
import json
import os
import re
import shutil
import sqlite3
import stat
import struct
import zipfile
from pathlib import Path

import pandas as pd
import pytest
import sqlalchemy as sa

from league import cli, moving
from league.config import experiment as configuration
from league.query import Open
from storage import archive as archives
from storage import tables as t
from storage.errors import StorageError, UnknownName
from storage.records import Checkpoint, CurvePoint, Job, League, Match, Phase, Player, Snapshot
from storage.store import Store
from tests.league.conftest import ROOT, TINY, call
from tests.league.leagues import C, filled, finish, match
from tests.storage.conftest import SERVER, server_place, server_url  # noqa: F401  (a fixture)


@pytest.fixture(params=["sqlite", "server"] if SERVER else ["sqlite"])
def target(request, tmp_path):
    """Where a store may be made, and where its blobs go."""
    if request.param == "sqlite":
        yield str(tmp_path / "target"), str(tmp_path / "target" / "blobs")
    else:
        for url in server_place():
            yield url, str(tmp_path / "target" / "blobs")


def league_of(folder: Path) -> Store:
    """A league with something in every table: matches with recordings, two checkpoints, a phase, jobs in all states."""
    store = filled(folder)
    blob = store.blobs.put
    finish(store, matches=[
        match("blue@4", "red@4", 6, 2, recording=blob(b"episode 1")), match("blue@4", "blue@0", 9, 1, 2),
        match("red@4", "pusher", 3, 5), match("red@0", "blue@0", 4, 4), match("pusher", "blue@4", 5, 3),
    ])  # fmt: skip
    later = [Checkpoint("cup", p, blob(f"later {p}".encode()), 800, 8, 5000.125, C) for p in ("blue", "red")]
    finish(store, checkpoints=later, curves=[
        CurvePoint("cup", p, i, 100 * i, 0.1 * i, {"reward": 1 / (i + 2), "score": 0.5})
        for p in ("red", "blue") for i in (1, 2, 10)
    ])  # fmt: skip
    phase = Phase("cup", "1", 0, ("blue",), {"blue": 0, "red": 0}, {"iterations": 50})
    store.queue([Job("cup", "any", "waits", {"a": [1, None]}), Job("cup", "other", "leased")], [phase])
    assert store.claim("cup", ["other"], "host:1:x", 60) is not None
    store.set_paused("cup", "red", "for a reason")
    assert store.lead("cup", "host:2:manager", 60)
    store.beat("host:1:x", "cup", "other", 1, "host", {"doing": "it"})
    return store


def rows(store: Store, name: str = "cup") -> dict[str, list]:
    """All that a league's rows say, less what a database gives or a process leaves."""
    found = {}
    for table in moving.moving.TABLES.values():
        chosen = moving.moving.columns(table)
        query = sa.select(*chosen).where((table.c.name if table is t.leagues else table.c.league) == name)
        found[table.name] = sorted(map(repr, store._db.rows(query)))
    return found


def ratings(store: Store, name: str = "cup") -> pd.DataFrame:
    return Open(store, name).ratings()


def assert_rated_alike(a: Store, b: Store, name: str | None = None) -> None:
    one = a.leagues()[0].name
    assert len(ratings(a, one)) > 5
    pd.testing.assert_frame_equal(ratings(a, one), ratings(b, name or one), rtol=0, atol=1e-9)


def ran(capsys, *args: str) -> tuple[int, str, str]:
    """Run a command here: exit code, what it printed, what it complained of."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(args))
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


def refused(capsys, *args: str) -> str:
    """Run a command that is refused: its one line."""
    code, out, err = ran(capsys, *args)
    assert (code, out) == (2, ""), err
    assert err.startswith("league: ")
    assert err.count("\n") == 1
    assert len(err) < 600
    return err


@pytest.fixture
def packed(tmp_path) -> Path:
    """The archive of such a league."""
    with league_of(tmp_path / "source") as store:
        moving.pack(store, tmp_path / "cup.zip")
    return tmp_path / "cup.zip"


def test_a_league_is_what_it_was_in_any_other_store(tmp_path, packed, target):
    where, blobs = target
    moving.unpack(packed, where, blobs)
    with Store.open(tmp_path / "source") as source, Store.open(where, blobs=blobs) as there:
        before, after = rows(source), rows(there)
        before["jobs"] = [row.replace("'leased', 1,", "'queued', 1,") for row in before["jobs"]]
        assert after == {name: sorted(found) for name, found in before.items()}
        assert [job.key for job in there.jobs("cup", "queued")] == ["waits", "leased"]
        assert there.leader("cup") is None
        assert there.workers("cup", 1e9) == []
        assert_rated_alike(source, there)
        for snapshot in source.snapshots("cup"):
            assert there.blobs.get(snapshot.digest) == source.blobs.get(snapshot.digest)
        assert {c.digest for c in there.checkpoints("cup")} == {c.digest for c in source.checkpoints("cup")}
        recorded = [m.recording for m in there.matches("cup") if m.recording]
        assert [there.blobs.get(digest) for digest in recorded] == [b"episode 1"]
        finish(there, "next", matches=[match("red@4", "blue@4", 1, 1)])  # it goes on: its log is numbered on
        assert [m.id for m in there.matches("cup")] == [1, 2, 3, 4, 5, 6]


def test_back_from_there_it_is_the_same_archive(tmp_path, packed, target):
    where, blobs = target
    moving.unpack(packed, where, blobs)
    with Store.open(where, blobs=blobs) as there:
        moving.pack(there, tmp_path / "again.zip")
    with zipfile.ZipFile(packed) as first, zipfile.ZipFile(tmp_path / "again.zip") as second:
        names = [name for name in first.namelist() if name != "manifest.json"]
        assert sorted(names) == sorted(set(second.namelist()) - {"manifest.json"})
        assert len(names) > 15
        assert all(sorted(first.read(n).splitlines()) == sorted(second.read(n).splitlines()) for n in names)


def test_the_newest_state_is_enough_to_go_on_and_to_be_rated(tmp_path, packed):
    with Store.open(tmp_path / "source") as source:
        moving.pack(source, tmp_path / "newest.zip", newest=True)
        moving.pack(source, tmp_path / "unrecorded.zip", recordings=False)
        moving.unpack(tmp_path / "newest.zip", str(tmp_path / "new"))
        moving.unpack(tmp_path / "unrecorded.zip", str(tmp_path / "unrecorded"))
        with Store.open(tmp_path / "new") as new, Store.open(tmp_path / "unrecorded") as unrecorded:
            assert {c.player: c.iteration for c in new.checkpoints("cup")} == {"blue": 8, "red": 8}
            assert new.newest_checkpoints("cup").keys() == source.newest_checkpoints("cup").keys()
            assert len(unrecorded.checkpoints("cup")) == len(source.checkpoints("cup")) == 4
            for store in (new, unrecorded):
                assert not any(m.recording for m in store.matches("cup"))
                assert_rated_alike(store, source)
                assert rows(store)["curves"] == rows(source)["curves"]
            sizes = [(tmp_path / name).stat().st_size for name in ("newest.zip", "unrecorded.zip", "cup.zip")]
            assert sizes == sorted(set(sizes))


def curriculum(folder: Path) -> Store:
    """League `cup` of two stages, after league `base`, and a league `other` that has to do with none of them."""
    store = Store.open(folder, create=True)
    text = 'league = "cup"\n# of others\nafter = ["base"]\n[storage]\nblobs = "/old/place"\n'
    stages = '[[stages]]\nname = "walk"\n[[stages]]\nname = "push"\n[[stages]]\nname = "match"\n'
    for name, config in {
        "base": 'league = "base"\n', "other": 'league = "other"\n', "cup": text + stages,
        "cup.walk": 'league = "cup.walk"\nafter = ["base"]\n',
        "cup.push": 'league = "cup.push"\nafter = ["cup.walk", "base"]\n',
    }.items():  # fmt: skip
        store.create_league(League(name, config))
    store.add_players([Player("cup.push", "blue", 0, "main", "ant:3:1")])
    digest = store.blobs.put(b"policy")
    store.add_snapshots([Snapshot("cup.push", "blue@0", digest, "ant:3:1", "blue", parent="cup.walk/blue@8")])
    return store


@pytest.mark.parametrize("name", ["cup", "cup.walk", "cup.push"])
def test_a_league_brings_along_what_it_needs(tmp_path, name):
    with curriculum(tmp_path / "source") as store:
        # Oldest first, and two that were made within one tick of the clock by name.
        assert sorted(moving.needed(store, [name])) == ["base", "cup", "cup.push", "cup.walk"]
        assert moving.needed(store, ["base"]) == ["base"]
        done = moving.pack(store, tmp_path / "some.zip", [name])
    assert sorted(done.leagues) == ["base", "cup", "cup.push", "cup.walk"]


def test_a_policy_that_comes_with_the_league_need_not_travel(tmp_path):
    with curriculum(tmp_path / "source") as store:
        store.set_config("other", 'league = "other"\nafter = ["anymal-push", "base"]\n')
        assert sorted(moving.needed(store, ["other"])) == ["base", "other"]
        store.set_config("other", 'league = "other"\nafter = ["anymal-psh"]\n')
        with pytest.raises(UnknownName, match="no league 'anymal-psh'"):
            moving.needed(store, ["other"])


def test_a_curriculum_gets_another_name_with_its_stages(tmp_path):
    with curriculum(tmp_path / "source") as store:
        store.set_config("cup", store.league("cup").config.replace('after = ["base"]', "after = []"))
        for stage, before in (("walk", "[]"), ("push", '["cup.walk"]')):
            store.set_config(f"cup.{stage}", f'league = "cup.{stage}"\nafter = {before}\n')
        moving.pack(store, tmp_path / "cup.zip", ["cup"])
        kept = store.league("cup").config
    moving.unpack(tmp_path / "cup.zip", str(tmp_path / "new"), str(tmp_path / "elsewhere"), "bowl.2")
    with Store.open(tmp_path / "new", blobs=tmp_path / "elsewhere") as store:
        configs = {league.name: league.config for league in store.leagues()}
        renamed = kept.replace('"cup"', '"bowl.2"').replace("/old/place", str(tmp_path / "elsewhere"))
        assert configs == {
            "bowl.2": renamed,
            "bowl.2.walk": 'league = "bowl.2.walk"\nafter = []\n',
            "bowl.2.push": 'league = "bowl.2.push"\nafter = ["bowl.2.walk"]\n',
        }
        assert [s.parent for s in store.snapshots("bowl.2.push")] == ["bowl.2.walk/blue@8"]


def test_a_real_configuration_with_another_name_differs_in_nothing_else():
    text = configuration.dumps(configuration.default("matching-pennies"))
    changed = moving.with_values(text, {("league",): "x", ("after",): ["a.b", "c"]})
    before, after = configuration.loads(text), configuration.loads(changed)
    assert (after.league, after.after) == ("x", ("a.b", "c"))
    assert configuration.dumps(after) == changed
    assert sum(a != b for a, b in zip(text.splitlines(), changed.splitlines(), strict=True)) == 2
    assert before.arena == after.arena
    with pytest.raises(StorageError, match="could not be changed"):
        moving.with_values('league = """\ncup"""\n', {("league",): "bowl"})


def test_several_leagues_keep_their_names(tmp_path, capsys):
    with curriculum(tmp_path / "source") as store:
        moving.pack(store, tmp_path / "all.zip")
    told = refused(capsys, "unpack", str(tmp_path / "all.zip"), "--store", str(tmp_path / "new"), "--as", "x")
    assert "--as renames one league" in told
    assert not (tmp_path / "new").exists()
    moving.unpack(tmp_path / "all.zip", str(tmp_path / "new"))
    with Store.open(tmp_path / "new") as store:
        assert sorted(league.name for league in store.leagues()) == ["base", "cup", "cup.push", "cup.walk", "other"]
        assert 'blobs = "none"' in store.league("cup").config  # beside this store, and no longer at the old place


def test_what_happens_while_it_is_packed_is_in_none_of_its_tables(tmp_path, packed, target, monkeypatch):
    where, blobs = target
    moving.unpack(packed, where, blobs)
    with Store.open(where, blobs=blobs) as store, Store.open(where, blobs=blobs) as other:
        before = rows(store)
        plain = archives.Writer.rows

        def meanwhile(self, table, found):
            if table == "players":
                other.add_players([Player("cup", "late", 0, "main", "rover")])
                blob = other.blobs.put(b"late")
                other.add_snapshots([Snapshot("cup", "late@0", blob, "rover", "late")])
                finish(other, "late", matches=[match("late@0", "red@0", 1, 0)])
            return plain(self, table, found)

        monkeypatch.setattr(archives.Writer, "rows", meanwhile)
        moving.pack(store, tmp_path / "moment.zip")
        assert len(rows(store)["matches"]) == len(before["matches"]) + 1
    moving.unpack(tmp_path / "moment.zip", str(tmp_path / "new"))
    with Store.open(tmp_path / "new") as new:
        assert all(
            rows(new)[table] == before[table] for table in ("leagues", "players", "snapshots", "matches", "jobs")
        )


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        ("UPDATE matches SET wins = 'six' WHERE id = 1", "damaged"),
        ("UPDATE curves SET \"values\" = '[]' WHERE iteration = 1", "values is no JSON object"),
        ("UPDATE curves SET \"values\" = '{' WHERE iteration = 1", "a row of table 'curves' is damaged"),
        ("UPDATE leagues SET matches = 2", "id 3 is none of the 2"),
        ("UPDATE snapshots SET digest = '../x' WHERE name = 'red@0'", "is not a blob's name"),
    ],
)
def test_what_could_not_be_unpacked_is_not_packed(packed, tmp_path, capsys, spoil, says):
    with contextlib.closing(sqlite3.connect(tmp_path / "source" / "league.db")) as db:
        db.execute(spoil)
        db.commit()
    assert says in refused(capsys, "pack", str(tmp_path / "b.zip"), "--store", str(tmp_path / "source"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cup.zip", "source"]


# What is refused -----------------------------------------------------------------------------------------------------


def rebuilt(path: Path, change=None, add=(), manifest=None, honest: bool = False) -> None:
    """Write an archive anew: members changed by name (None: left out), members added, the manifest changed.

    `honest`: the manifest tells the truth of the members as they are now.
    """
    with zipfile.ZipFile(path) as old:
        infos = {info.filename: (info, old.read(info)) for info in old.infolist()}
    told = json.loads(infos.pop("manifest.json")[1])
    for name, data in (change or {}).items():
        data = data(infos[name][1]) if callable(data) else data
        infos[name] = (infos[name][0], data)
    for name, (_, data) in infos.items():
        if honest and data is not None and name.startswith("rows/"):
            digest, table = hashlib.sha256(data).hexdigest(), name[5:-6]
            told["rows"][table] = {"rows": len(data.splitlines()), "bytes": len(data), "sha256": digest}
    if manifest is not None:
        told = manifest(told) or told
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as new:
        for name, (info, data) in infos.items():
            if data is not None:
                fresh = zipfile.ZipInfo(name)
                fresh.compress_type = info.compress_type
                new.writestr(fresh, data)
        for info, data in add:
            new.writestr(info, data)
        new.writestr("manifest.json", told if isinstance(told, (str, bytes)) else json.dumps(told))
    path.write_bytes(out.getvalue())


def link(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


def edited(old: str, new: str, count: int = 1):
    """A change of a member's text that does happen."""

    def change(data: bytes) -> bytes:
        assert old.encode() in data
        return data.replace(old.encode(), new.encode(), count)

    return change


def manifest(change):
    return lambda path: rebuilt(path, manifest=change)


def declares(path: Path, name: str, size: int) -> None:
    """Let the directory of a zip declare another unpacked size of a member."""
    data = bytearray(path.read_bytes())
    at = data.rfind(name.encode()) - 46
    assert data[at : at + 4] == b"PK\x01\x02"
    data[at + 24 : at + 28] = struct.pack("<I", size)
    path.write_bytes(data)


BLOB = hashlib.sha256(b"episode 1").hexdigest()
HOSTILE = {
    "cut off": (lambda p: p.write_bytes(p.read_bytes()[:-40]), "it is cut off"),
    "cut in half": (lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]), "it is cut off"),
    "empty": (lambda p: p.write_bytes(b""), "no archive of leagues"),
    "text": (lambda p: p.write_text("hello" * 100), "no archive of leagues"),
    "pickle": (lambda p: p.write_bytes(b"\x80\x04\x95\x00cos\nsystem\n(S'x'\ntR."), "no archive of leagues"),
    "another zip": (lambda p: zipfile.ZipFile(p, "w").close(), "without manifest.json"),
    "absolute": (lambda p: rebuilt(p, add=[("/etc/passwd", b"x")]), "would lie outside"),
    "parent": (lambda p: rebuilt(p, add=[("blobs/../../x", b"x")]), "would lie outside"),
    "windows": (lambda p: rebuilt(p, add=[("C:\\x", b"x")]), "would lie outside"),
    "backslashes": (lambda p: rebuilt(p, add=[("blobs\\..\\x", b"x")]), "would lie outside"),
    "link": (lambda p: rebuilt(p, add=[(link("rows/matches.jsonl"), b"/etc/passwd")]), "is a link"),
    "unknown": (lambda p: rebuilt(p, add=[("readme.txt", b"x")]), "'readme.txt', which no archive of leagues has"),
    "long name": (lambda p: rebuilt(p, add=[("x" * 9000, b"x")]), "which no archive of leagues has"),
    "workers": (lambda p: rebuilt(p, add=[("rows/workers.jsonl", b"")]), "which no archive of leagues has"),
    "folder": (lambda p: rebuilt(p, add=[("blobs/", b"")]), "which no archive of leagues has"),
    "unnamed blob": (lambda p: rebuilt(p, add=[(f"blobs/{'0' * 64}", b"x")]), "its manifest does not name"),
    "missing blob": (lambda p: rebuilt(p, {f"blobs/{BLOB}": None}), "it lacks"),
    "missing rows": (lambda p: rebuilt(p, {"rows/matches.jsonl": None}), "it lacks"),
    "other bytes": (lambda p: rebuilt(p, {f"blobs/{BLOB}": b"episode 2"}), "do not hash to its name"),
    "other length": (lambda p: rebuilt(p, {f"blobs/{BLOB}": b"episode 10"}), "its manifest tells of 9"),
    "other rows": (lambda p: rebuilt(p, {"rows/matches.jsonl": edited('"wins":6', '"wins":7')}), "not those that its"),
    "declared bomb": (lambda p: declares(p, "manifest.json", 2**32 - 2), "declares 4,294,967,294 bytes"),
    "declared blob": (lambda p: declares(p, f"blobs/{BLOB}", 2**31 - 1), "and has 9"),
    "declared less": (lambda p: declares(p, "rows/matches.jsonl", 20), "its manifest tells of"),
    "newer": (manifest(lambda m: m.update(archive=7)), "has format 7, but this program knows only up to 1"),
    "no format": (manifest(lambda m: m.pop("archive") and None), "does not say which format"),
    "true format": (manifest(lambda m: m.update(archive=True)), "does not say which format"),
    "newer schema": (manifest(lambda m: m.update(schema=99)), "are of schema 99, and this"),
    "older schema": (manifest(lambda m: m.update(schema=1)), "then open that store"),
    "manifest no JSON": (manifest(lambda m: "{]"), "it is damaged"),
    "manifest a list": (manifest(lambda m: "[]"), "does not say which format"),
    "manifest deep": (manifest(lambda m: "[" * 200_000), "brackets within brackets"),
    "manifest bare": (manifest(lambda m: {"archive": 1}), "does not say what it holds"),
    "sizes of text": (manifest(lambda m: m["blobs"].update({BLOB: "9"})), "is damaged"),
    "no leagues": (manifest(lambda m: m.update(leagues=[])), "which leagues it holds"),
    "other leagues": (manifest(lambda m: m.update(leagues=["cap"])), "is not one that the manifest"),
    "more leagues": (manifest(lambda m: m["leagues"].append("cap")), "no row tells of league 'cap'"),
    "league a path": (manifest(lambda m: m.update(leagues=["../x"])), "a name is made of letters"),
}  # fmt: skip
ROWS = {
    "no JSON": ("matches", edited('"wins":6', '"wins":six'), "it is damaged"),
    "a list": ("players", lambda data: b"[]\n" + data, "row 1 of players is no JSON object"),
    "not a number": ("matches", edited('"wins":6', '"wins":NaN'), "NaN is no figure"),
    "infinite": ("checkpoints", edited('"seconds":5000.125', '"seconds":1e999'), "seconds is no number"),
    "huge": ("matches", edited('"wins":6', '"wins":' + "9" * 30), "wins is no whole number of 64 bits"),
    "very huge": ("matches", edited('"wins":6', '"wins":' + "9" * 9000), "it is damaged"),
    "text for a number": ("matches", edited('"wins":6', '"wins":"6"'), "wins is no whole number"),
    "unknown column": ("players", edited('"team":0', '"team":0,"x":1'), "unknown column 'x'"),
    "missing column": ("players", edited('"team":0,', ""), "missing column 'team'"),
    "no value": ("players", edited('"team":0', '"team":null'), "team has no value"),
    "null character": ("players", edited('"role":"main"', '"role":"a\\u0000b"'), "role holds a null character"),
    "half a character": ("players", edited('"role":"main"', '"role":"\\ud800"'), "role is no text in UTF-8"),
    "of another league": ("runs", edited('"league":"cup"', '"league":"cap"'), "'cap' is not one that the manifest"),
    "of no player": ("checkpoints", edited('"player":"red"', '"player":"reb"'), "'reb' is none of the players"),
    "of no snapshot": ("matches", edited('"a":"blue@4"', '"a":"blue@5"'), "'blue@5' is none of the snapshots"),
    "of no blob": ("snapshots", edited('"digest":"', '"digest":"../../'), "is no blob of the archive"),
    "unknown word": ("snapshots", edited('"origin":"trained"', '"origin":"found"'), "is none of trained"),
    "twice": ("players", lambda data: data + data, "'blue' is there twice"),
    "numbered twice": ("matches", lambda data: data + data, "id 1 does not follow"),
    "beyond the count": ("leagues", edited('"matches":5', '"matches":3'), "id 4 is none of the 3"),
    "blob unnamed": ("matches", edited(f'"{BLOB}"', "null"), "is named by no row"),
    "settings": ("leagues", edited('"config":"[', '"config":"[[['), "is not TOML"),
    "values no object": ("curves", edited('"values":{', '"values":7,"x":{'), "unknown column 'x'"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_archive_is_refused_in_one_line(case, packed, tmp_path, capsys):
    spoil, says = HOSTILE[case]
    with pytest.warns(UserWarning, match="Duplicate") if case == "link" else contextlib.nullcontext():
        spoil(packed)
    assert says in refused(capsys, "unpack", str(packed), "--store", str(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("case", ROWS)
def test_rows_that_cannot_be_are_refused_though_their_digests_are_right(case, packed, tmp_path, capsys):
    table, spoil, says = ROWS[case]
    rebuilt(packed, {f"rows/{table}.jsonl": spoil}, honest=True)
    assert says in refused(capsys, "unpack", str(packed), "--store", str(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_what_is_large_is_refused_before_it_is_read(packed, tmp_path, capsys, monkeypatch):
    for name, says in (("LINE_LIMIT", "a row of leagues is longer"), ("ROWS_LIMIT", "bytes are possible|are possible")):
        with monkeypatch.context() as patch:
            patch.setattr(archives, name, 100)
            with pytest.raises(archives.ArchiveError, match=says):
                moving.unpack(packed, str(tmp_path / "new"))
            with Store.open(tmp_path / "source") as store, pytest.raises(StorageError, match="more than an archive"):
                moving.pack(store, tmp_path / "large.zip")
    with Store.open(tmp_path / "source") as store:
        store.blobs.put(b"x" * 200)
        monkeypatch.setattr(archives, "BLOB_LIMIT", 8)
        with pytest.raises(StorageError, match="more than an archive"):
            moving.pack(store, tmp_path / "large.zip")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cup.zip", "source"]


def test_every_flipped_byte_is_seen_or_changes_nothing(packed, tmp_path):
    data = packed.read_bytes()
    moving.unpack(packed, str(tmp_path / "right"))
    with Store.open(tmp_path / "right") as store:
        right = rows(store)
    seen = 0
    for at in range(0, len(data), 97):
        packed.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        place = tmp_path / "new"
        try:
            moving.unpack(packed, str(place))
        except StorageError:
            seen += 1
            assert not place.exists()
        else:
            with Store.open(place) as store:
                assert rows(store) == right
            shutil.rmtree(place)
    assert seen > 50


def test_a_league_that_is_there_already_stays_as_it_is(packed, tmp_path, capsys):
    where = str(tmp_path / "source")
    before = (tmp_path / "source" / "league.db").read_bytes()
    assert "There is a league 'cup' in" in refused(capsys, "unpack", str(packed), "--store", where)
    assert (tmp_path / "source" / "league.db").read_bytes() == before
    code, out, _ = ran(capsys, "unpack", str(packed), "--store", where, "--as", "bowl")
    assert code == 0
    assert "still tell the old name" in out
    with Store.open(where) as store:
        cup, bowl = rows(store), rows(store, "bowl")
        assert [row.replace("'cup'", "'bowl'") for row in cup["matches"]] == bowl["matches"]
        assert_rated_alike(store, store, "bowl")


def test_nothing_is_left_of_a_pack_that_failed(packed, tmp_path, capsys):
    (tmp_path / "source" / "blobs" / BLOB[:2] / BLOB[2:]).unlink()
    where = ("--store", str(tmp_path / "source"))
    told = refused(capsys, "pack", str(tmp_path / "b.zip"), *where)
    assert "is missing" in told
    assert "--no-recordings packs without it" in told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cup.zip", "source"]
    assert ran(capsys, "pack", str(tmp_path / "b.zip"), *where, "--no-recordings")[0] == 0


def test_bad_asks_get_one_line(packed, tmp_path, capsys):
    where = ("--store", str(tmp_path / "source"))
    os.mkfifo(tmp_path / "pipe")
    for args, says in (
        (("pack",), "league pack needs DEST"),
        (("pack", str(packed), *where), "exists already"),
        (("pack", str(tmp_path), *where), "is a folder"),
        (("pack", str(tmp_path / "no" / "x.zip"), *where), "No such file or directory"),
        (("pack", "x.zip", *where, "--league", "cap"), "There is no league 'cap' here; there is: cup."),
        (("pack", "x.zip", *where, "--newst"), "did you mean --newest"),
        (("pack", "x.zip", "--store", str(tmp_path / "none")), "No league store"),
        (("unpack",), "league unpack needs ARCHIVE"),
        (("unpack", str(tmp_path / "none.zip")), "No such file"),
        (("unpack", str(tmp_path)), "is no file"),
        (("unpack", str(tmp_path / "pipe")), "is no file"),
        (("unpack", str(packed), "--as", "a/b"), "a name is made of letters"),
        (("unpack", str(packed), "--as", ""), "must be a name"),
        (("unpack", str(packed), "--store", "mysql://x"), "is possible"),
        (("unpack", "nul\0"), "is no name of a file"),
    ):  # fmt: skip
        assert says in refused(capsys, *args)


def test_no_password_is_printed(packed, tmp_path, capsys, server_url):  # noqa: F811
    given = sa.make_url(server_url)
    word = str(given.password or "hunter2")  # a server that trusts everybody takes any
    secret = given.set(password=word).render_as_string(hide_password=False)
    code, out, err = ran(capsys, "unpack", str(packed), "--store", secret, "--blobs", str(tmp_path / "b"))
    assert code == 0
    assert word not in out + err


def test_several_leagues_are_asked_for_by_several_flags(tmp_path, capsys):
    with curriculum(tmp_path / "source"):
        pass
    where = ("--store", str(tmp_path / "source"))
    code, out, _ = ran(capsys, "pack", str(tmp_path / "a.zip"), *where, "--league", "other", "--league=cup.walk")
    assert code == 0
    named = re.search(r"Packed leagues ([^(]*) \(", out)
    assert named
    assert sorted(named[1].split(", ")) == ["base", "cup", "cup.push", "cup.walk", "other"]
    assert "With what they need to go on: base, cup, cup.push." in out


def test_moving_loads_nothing_heavy(packed, tmp_path):
    import subprocess
    import sys

    script = (
        "import sys; from league.commands import moving, exchange; "
        f"moving.unpack([{str(packed)!r}, '--store', {str(tmp_path / 'new')!r}]); "
        "print([m for m in ('jax', 'torch', 'mujoco', 'pandas') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr


def played(log: list[Match]) -> dict[tuple, tuple]:
    """What came of each match: when which is played depends on the clock, and a recording names its league."""
    return {(m.a, m.b, m.seed): (m.wins, m.draws, m.losses, m.voids, m.pairs, m.steps) for m in log}


@pytest.mark.slow
def test_an_unpacked_league_goes_on_as_the_original_would(tmp_path):
    at_home, away = tmp_path / "home", tmp_path / "away"
    at_home.mkdir()
    away.mkdir()
    run = ("run", *TINY, "--deterministic", "--budget.rate", "30s")
    assert call(*run, "--budget.steps", "8192", cwd=at_home).returncode == 0
    assert call("pack", str(tmp_path / "tiny.zip"), "--newest", cwd=at_home).returncode == 0
    assert call("unpack", str(tmp_path / "tiny.zip"), "--as", "mini", cwd=away).returncode == 0
    with Store.open(at_home / "league-data") as home, Store.open(away / "league-data") as there:
        assert_rated_alike(home, there, "mini")
        before = home.matches("tiny")
    assert call("run", "--steps", "8192", cwd=at_home).returncode == 0
    assert call("run", "--steps", "8192", cwd=away).returncode == 0
    with Store.open(at_home / "league-data") as home, Store.open(away / "league-data") as there:
        assert [league.name for league in there.leagues()] == ["mini"]
        mine, theirs = home.newest_checkpoints("tiny"), there.newest_checkpoints("mini")
        assert {n: (c.digest, c.iteration, c.step) for n, c in mine.items()} == {
            n: (c.digest, c.iteration, c.step) for n, c in theirs.items()
        }
        assert min(c.iteration for c in mine.values()) == 8
        assert {s.name: s.digest for s in home.snapshots("tiny")} == {s.name: s.digest for s in there.snapshots("mini")}
        left, right = played(home.matches("tiny")), played(there.matches("mini"))
        both = left.keys() & right.keys()
        assert len(both) > len(before) > 5
        assert {key: left[key] for key in both} == {key: right[key] for key in both}
