"""Which snapshots may give up their bytes, and what is told of one that has."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from league.queries.query import Open
from league.snapshots import retention
from league.snapshots.transfer.predecessors import best_of
from storage.maintenance.verify import verify
from storage.records import League
from storage.store import Store
from tests.league.leagues import BLUE, RED, filled, finish, match, snapshot
from tests.league.packs import assert_rated_alike, ran, refused
from tests.storage.sound import DAY, blob, change, older


def iterations(names: set[str]) -> list[int]:
    return sorted(int(name.partition("@")[2]) for name in names)


def test_the_first_of_each_part_of_a_doubling_is_spared():
    every = [snapshot(BLUE, i) for i in range(65)]
    assert iterations(retention.first_of_each_part(every, 1)) == [0, 2, 4, 8, 16, 32, 64]
    assert iterations(retention.first_of_each_part(every, 2)) == [0, 2, 3, 4, 6, 8, 12, 16, 23, 32, 46, 64]


def test_what_was_spared_is_spared_when_more_has_come_and_is_no_longer_dense():
    every = [snapshot(BLUE, i) for i in range(1, 200, 3)]
    for per_doubling in (1, 2, 5):
        some = retention.first_of_each_part(every[:30], per_doubling)
        later = retention.first_of_each_part(
            [s for s in every if s.name in some or s.iteration > every[29].iteration], per_doubling
        )
        assert some <= later == retention.first_of_each_part(every, per_doubling)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a league of two days ago in which blue and red have 17 snapshots each, all of them rated."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROBOT_LEAGUE_BLOBS", raising=False)
    players = [BLUE, RED]
    with filled(tmp_path / "league-data") as store:
        blobs = store.blobs.put
        store.add_snapshots([
            snapshot(p, i, blobs(f"{p.name}@{i}".encode())) for p in players for i in range(17) if i not in (0, 1, 4)
        ])  # fmt: skip
        played = [match(f"{a}@{i}", f"{b}@{i // 2}", 40 + i, 60 - i) for i in range(17) for a, b in (["blue", "red"],)]
        best = [match("red@11", f"blue@{i}", 90, 10) for i in range(17)]
        named = [replace(match("blue@13", "red@0", 5, 5), purpose="gate")]
        finish(store, "played", matches=[*played, *best, *named])
    for path in (tmp_path / "league-data" / "blobs").rglob("*"):
        if path.is_file():
            older(path)
    change(tmp_path / "league-data", f"UPDATE snapshots SET created = created - {2 * DAY}")
    return tmp_path / "league-data"


def test_who_is_needed_stays(folder):
    with Store.open(folder) as store:
        may = retention.may_go(Open(store, "cup"), 1)
    assert may.isdisjoint({"blue@0", "red@0", "blue@16", "red@16", "blue@13", "red@11", "pusher"})
    assert {"blue@3", "blue@5", "red@13", "red@15"} <= may


def allowed(folder: Path) -> set[str]:
    with Store.open(folder) as store:
        return retention.may_go(Open(store, "cup"), 1)


@pytest.mark.parametrize(
    "config",
    [
        'after = ["cup/blue@7"]', '[[players]]\nteam = "blue"\nafter = ["duel", "cup/blue@7"]',
        '[[stages]]\nname = "duel"\nafter = ["cup/blue@7"]', '[learner.skill]\npolicy = "cup/blue@7"',
    ],
)  # fmt: skip
def test_what_another_league_of_the_store_goes_on_from_stays(folder, config):
    before = allowed(folder)
    assert {"blue@7", "red@7"} <= before
    with Store.open(folder) as store:
        store.create_league(League("cup-2", 'after = ["cup-3/red@7"]'))
        store.create_league(League("later", config))
    assert allowed(folder) == before - {"blue@7"}


def test_what_the_league_itself_names_with_its_own_name_stays(folder):
    with Store.open(folder) as store:
        store.set_config("cup", 'after = ["cup/blue@7"]')
    assert "blue@7" not in allowed(folder)


def test_what_is_handed_on_stays_although_another_has_a_higher_rating(folder):
    """blue@5 is the best against blue@0 and weak against red@16; by Elo blue@11 is better."""
    log = [match(f"blue@{i}", "blue@0", 120, 40) for i in range(1, 17)]
    log += [match("blue@5", "blue@0", 152, 8), match("blue@5", "red@16", 20, 140), match("blue@11", "red@16", 130, 30)]
    with Store.open(folder) as store:
        finish(store, "scored", matches=log)
        chosen = best_of(store, "cup", "blue")
        assert chosen is not None
        assert chosen[0].name == "blue@5"
        ratings = Open(store, "cup").shown().ladders[0].ratings
        assert ratings.elo[ratings.names.index("blue@11")] > ratings.elo[ratings.names.index("blue@5")]
        may = retention.may_go(Open(store, "cup"), 1)
        assert may.isdisjoint({"blue@5", "blue@11"})
        assert {"blue@6", "blue@7"} <= may


def test_nothing_is_thinned_where_settings_cannot_be_read(folder, capsys):
    with Store.open(folder) as store:
        store.create_league(League("later", 'after = ["cup/blue@7"'))
    told = refused(capsys, "thin", "--snapshots", "1")
    assert "The settings of league 'later' are damaged, so nothing is removed" in told


def test_thinned_by_the_command_ratings_are_what_they_were_and_a_thinned_one_says_so(folder, capsys, tmp_path):
    before = json.loads(ran(capsys, "ratings", "--format", "json")[1])
    code, out, err = ran(capsys, "thin", "--snapshots", "1")
    assert (code, err) == (0, "")
    with Store.open(folder) as store:
        gone = [s for s in store.snapshots("cup") if s.thinned is not None]
        assert len(gone) > 15
        assert not any(blob(folder, s.digest).exists() for s in gone)
    assert f"thinned {len(gone)} snapshots" in " ".join(out.split())
    after = json.loads(ran(capsys, "ratings", "--format", "json")[1])
    assert after == before
    name = gone[0].name
    for command in (
        ("play", name, "red@16"), ("gate", "blue@16", name), ("export", name, "-o", "out.policy"),
        ("exploit", name, "--budget", "1000"),
    ):  # fmt: skip
        assert f"{name} of league cup has been thinned: its matches count" in refused(capsys, *command)
    assert "there is nothing to remove" in " ".join(ran(capsys, "thin", "--snapshots", "1")[1].split())
    assert "thinned" in ran(capsys, "snapshots")[1]
    report = verify(str(folder), age=0)
    assert [f for f in report.findings if "holds no" not in f.problem and f.kind != "corrupt"] == []
    assert ran(capsys, "pack", "cup.zip")[0] == 0
    assert ran(capsys, "unpack", "cup.zip", "--store", "there")[0] == 0
    with Store.open(folder) as source, Store.open(tmp_path / "there") as there:
        assert_rated_alike(source, there)
        assert [s.thinned for s in there.snapshots("cup")] == [s.thinned for s in source.snapshots("cup")]
        assert not any(there.blobs.has(s.digest) for s in gone)
