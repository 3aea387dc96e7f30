"""Whole leagues in games that are not ours: a person's own file, a game without bodies, a game of one team."""

import pytest

from league.commands.analyse.ratings import ratings
from storage.store import Store
from tests.league.conftest import ROOT, SMALLER, call

SMALL = (*SMALLER, "--steps", "1500", "--budget.rating_time", "5m")  # it ends when all have met
RACE = f"{ROOT / 'tests' / 'arenas' / 'race.py'}:race"
SOLO = f"{ROOT / 'tests' / 'arenas' / 'solo.py'}:solo"


def check_rated(folder, arena, capsys):
    """Both teams have learnt what their budget allows, and each newest snapshot has met its initial one."""
    with Store.open(folder / "league-data") as store:
        matches = store.matches("small", "rating")
        assert {c.iteration for c in store.newest_checkpoints("small").values()} == {3}
        assert not store.jobs("small", "failed")
        assert {m.arena.arena for m in matches} == {arena}
        met = {(m.a, m.b) for m in matches}
        assert {("blue@3", "blue@0"), ("red@3", "red@0")} <= met | {(b, a) for a, b in met}
    assert ratings(["--store", str(folder / "league-data")]) == 0
    assert "blue@3" in capsys.readouterr().out


@pytest.mark.slow
def test_a_game_of_ones_own_is_trained_and_rated(tmp_path, capsys):
    done = call("run", "--arena.name", RACE, *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    check_rated(tmp_path, RACE, capsys)


@pytest.mark.slow
def test_a_game_without_bodies_is_trained_and_rated(rated_league, capsys):
    check_rated(rated_league, "rock-paper-scissors", capsys)


@pytest.mark.slow
def test_a_team_alone_is_trained_and_measured_by_its_success(tmp_path, capsys):
    done = call("run", "--arena.name", SOLO, *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with Store.open(tmp_path / "league-data") as store:
        matches = store.matches("small", "rating")
        assert {m.b for m in matches} == {None}
        newest = max(store.snapshots("small"), key=lambda s: s.iteration)
        assert newest.name in {m.a for m in matches}
        assert not store.jobs("small", "failed")
    assert ratings(["--store", str(tmp_path / "league-data")]) == 0
    told = capsys.readouterr().out
    assert newest.name in told
    assert "success" in told


def test_a_game_that_does_not_exist_leaves_no_league_behind(tmp_path):
    done = call("run", "--arena.name", f"{ROOT / 'tests' / 'arenas' / 'race.py'}:rice", *SMALL, cwd=tmp_path)
    assert done.returncode == 2
    assert "did you mean race" in done.stderr
    assert not list(tmp_path.iterdir())
