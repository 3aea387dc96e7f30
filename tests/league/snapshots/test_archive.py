"""Leagues packed into one file and unpacked into another store are what they were."""

import contextlib
import sqlite3
import zipfile

import pytest

from league.config import experiment as configuration
from league.snapshots import archive
from storage.errors import StorageError, UnknownName
from storage.maintenance import archive as archives
from storage.records import ArenaKey, Match, Player, RankedMatch, Snapshot
from storage.store import Store
from tests.conftest import SERVER, server_place
from tests.league.conftest import BODILESS, call
from tests.league.leagues import finish, match
from tests.league.packs import assert_rated_alike, curriculum, league_of, refused, rows
from tests.league.snapshots.test_archive_refused import edited, rebuilt


@pytest.fixture(params=["sqlite", "server"] if SERVER else ["sqlite"])
def target(request, tmp_path):
    """Where a store may be made, and where its blobs go."""
    if request.param == "sqlite":
        yield str(tmp_path / "target"), str(tmp_path / "target" / "blobs")
    else:
        for url in server_place():
            yield url, str(tmp_path / "target" / "blobs")


def test_a_league_is_what_it_was_in_any_other_store(tmp_path, packed, target):
    where, blobs = target
    archive.unpack(packed, where, blobs)
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


def test_a_pack_from_before_void_causes_were_kept_still_arrives(tmp_path, packed):
    without = edited(',"causes":0', "", count=-1)
    rebuilt(packed, {"rows/matches.jsonl": without}, manifest=lambda m: m.update(schema=6), honest=True)
    archive.unpack(packed, str(tmp_path / "target"), str(tmp_path / "target" / "blobs"))
    with Store.open(tmp_path / "source") as source, Store.open(tmp_path / "target") as there:
        assert len(there.matches("cup")) == 5
        assert rows(there)["matches"] == rows(source)["matches"]


def test_a_pack_from_before_seeds_of_rankings_were_kept_still_arrives(tmp_path):
    cup = RankedMatch(
        "cup", ArenaKey("tag", "beef", "c"), ("red@0", "blue@0", "red@4"), {(1, 2, 3): 2}, 0, (0, 0, 0), 1,
        seed_clusters={((1, 2, 3), (2, 1, 3)): 1},
    )  # fmt: skip
    with league_of(tmp_path / "source") as source:
        finish(source, "lineup", matches=[cup])
        archive.pack(source, tmp_path / "pack.zip")
    without = {"rows/ranked_matches.jsonl": edited(',"seed_clusters":{"1,2,3;2,1,3":1}', "")}
    rebuilt(tmp_path / "pack.zip", without, manifest=lambda m: m.update(schema=8), honest=True)
    archive.unpack(tmp_path / "pack.zip", str(tmp_path / "target"), str(tmp_path / "target" / "blobs"))
    with Store.open(tmp_path / "target") as there:
        assert [(m.rankings, m.seed_clusters) for m in there.ranked_matches("cup")] == [(cup.rankings, {})]


def test_back_from_there_it_is_the_same_archive(tmp_path, packed, target):
    where, blobs = target
    archive.unpack(packed, where, blobs)
    with Store.open(where, blobs=blobs) as there:
        archive.pack(there, tmp_path / "again.zip")
    with zipfile.ZipFile(packed) as first, zipfile.ZipFile(tmp_path / "again.zip") as second:
        names = [name for name in first.namelist() if name != "manifest.json"]
        assert sorted(names) == sorted(set(second.namelist()) - {"manifest.json"})
        assert len(names) > 15
        assert all(sorted(first.read(n).splitlines()) == sorted(second.read(n).splitlines()) for n in names)


def test_the_newest_state_is_enough_to_go_on_and_to_be_rated(tmp_path, packed):
    with Store.open(tmp_path / "source") as source:
        archive.pack(source, tmp_path / "newest.zip", newest=True)
        archive.pack(source, tmp_path / "unrecorded.zip", recordings=False)
        archive.unpack(tmp_path / "newest.zip", str(tmp_path / "new"))
        archive.unpack(tmp_path / "unrecorded.zip", str(tmp_path / "unrecorded"))
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


@pytest.mark.parametrize("name", ["cup", "cup.walk", "cup.push"])
def test_a_league_brings_along_what_it_needs(tmp_path, name):
    with curriculum(tmp_path / "source") as store:
        # Oldest first, and two that were made within one tick of the clock by name.
        assert sorted(archive.needed(store, [name])) == ["base", "cup", "cup.push", "cup.walk"]
        assert archive.needed(store, ["base"]) == ["base"]
        done = archive.pack(store, tmp_path / "some.zip", [name])
    assert sorted(done.leagues) == ["base", "cup", "cup.push", "cup.walk"]


def test_a_policy_that_comes_with_the_league_need_not_travel(tmp_path):
    with curriculum(tmp_path / "source") as store:
        store.set_config("other", 'league = "other"\nafter = ["anymal-push", "base"]\n')
        assert sorted(archive.needed(store, ["other"])) == ["base", "other"]
        store.set_config("other", 'league = "other"\nafter = ["anymal-psh"]\n')
        with pytest.raises(UnknownName, match="no league 'anymal-psh'"):
            archive.needed(store, ["other"])


@pytest.mark.parametrize("start", ["base/blue@4", "gone/my.safetensors"])
@pytest.mark.parametrize("text", [
    'league = "other"\nafter = ["START"]\n',
    'league = "other"\n\n[[players]]\nteam = "red"\n\n[[players]]\nteam = "blue"\nafter = ["START"]\n',
])  # fmt: skip
def test_starts_from_snapshots_and_files_and_those_of_players_travel(tmp_path, text, start):
    with curriculum(tmp_path / "source") as store:
        store.set_config("other", text.replace("START", start))
        assert sorted(archive.needed(store, ["other"])) == (["base", "other"] if "base" in start else ["other"])
    names = {"other": "new", "base": "newer"}
    renamed = text.replace("other", "new").replace("START", start.replace("base", "newer"))
    assert archive._config(text.replace("START", start), names, None) == renamed


def test_a_curriculum_gets_another_name_with_its_stages(tmp_path):
    with curriculum(tmp_path / "source") as store:
        store.set_config("cup", store.league("cup").config.replace('after = ["base"]', "after = []"))
        for stage, before in (("walk", "[]"), ("push", '["cup.walk"]')):
            store.set_config(f"cup.{stage}", f'league = "cup.{stage}"\nafter = {before}\n')
        archive.pack(store, tmp_path / "cup.zip", ["cup"])
        kept = store.league("cup").config
    archive.unpack(tmp_path / "cup.zip", str(tmp_path / "new"), str(tmp_path / "elsewhere"), "bowl.2")
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
    changed = archive.with_values(text, {("league",): "x", ("after",): ["a.b", "c"]})
    before, after = configuration.loads(text), configuration.loads(changed)
    assert (after.league, after.after) == ("x", ("a.b", "c"))
    assert configuration.dumps(after) == changed
    assert sum(a != b for a, b in zip(text.splitlines(), changed.splitlines(), strict=True)) == 2
    assert before.arena == after.arena
    with pytest.raises(StorageError, match="could not be changed"):
        archive.with_values('league = """\ncup"""\n', {("league",): "bowl"})


def test_several_leagues_keep_their_names(tmp_path, capsys):
    with curriculum(tmp_path / "source") as store:
        archive.pack(store, tmp_path / "all.zip")
    told = refused(capsys, "unpack", str(tmp_path / "all.zip"), "--store", str(tmp_path / "new"), "--as", "x")
    assert "--as renames one league" in told
    assert not (tmp_path / "new").exists()
    archive.unpack(tmp_path / "all.zip", str(tmp_path / "new"))
    with Store.open(tmp_path / "new") as store:
        assert sorted(league.name for league in store.leagues()) == ["base", "cup", "cup.push", "cup.walk", "other"]
        assert 'blobs = "none"' in store.league("cup").config  # beside this store, and no longer at the old place


def test_what_happens_while_it_is_packed_is_in_none_of_its_tables(tmp_path, packed, target, monkeypatch):
    where, blobs = target
    archive.unpack(packed, where, blobs)
    with Store.open(where, blobs=blobs) as store, Store.open(where, blobs=blobs) as other:
        before = rows(store)
        plain = archives.ArchiveWriter.rows

        def meanwhile(self, table, found):
            if table == "players":
                other.add_players([Player("cup", "late", 0, "main", "rover")])
                blob = other.blobs.put(b"late")
                other.add_snapshots([Snapshot("cup", "late@0", blob, "rover", "late")])
                finish(other, "late", matches=[match("late@0", "red@0", 1, 0)])
            return plain(self, table, found)

        monkeypatch.setattr(archives.ArchiveWriter, "rows", meanwhile)
        archive.pack(store, tmp_path / "moment.zip")
        assert len(rows(store)["matches"]) == len(before["matches"]) + 1
    archive.unpack(tmp_path / "moment.zip", str(tmp_path / "new"))
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


def played(log: list[Match]) -> dict[tuple, tuple]:
    """What came of each match: when which is played depends on the clock, and a recording names its league."""
    return {(m.a, m.b, m.seed): (m.wins, m.draws, m.losses, m.voids, m.pairs, m.steps) for m in log}


@pytest.mark.slow
def test_an_unpacked_league_goes_on_as_the_original_would(tmp_path):
    at_home, away = tmp_path / "home", tmp_path / "away"
    at_home.mkdir()
    away.mkdir()
    run = ("run", *BODILESS, "--deterministic", "--budget.rating_time", "30s")
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
