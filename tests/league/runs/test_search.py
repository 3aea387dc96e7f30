"""A search by Optuna: its points become leagues, it goes on from the store, and it says what it lacks."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from league.config.experiment import dumps
from league.queries.query import Open
from league.runs.sweeps import search, sweep_file
from league.runs.sweeps.objective import objective, too_early
from storage.records import Checkpoint, League
from storage.store import Store
from tests.league.conftest import said
from tests.league.leagues import C, filled, finish, match, player, snapshot

TEXT = """
arena.name = "rock-paper-scissors"
training.worlds = 64
budget.steps = 2048
budget.rating_time = "1s"
rating.worlds = 64
rating.pairings = 2

[sweep]
name = "found"
trials = 1
objective = "elo"

[sweep.grid]
learner.lr = { low = 1e-4, high = 1e-1, log = true }
learner.epochs = { low = 1, high = 3 }
training.opponents.kind = ["latest", "uniform"]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "search.toml").write_text(TEXT)
    return tmp_path


def test_without_optuna_one_line_names_the_extra(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)  # an import of it fails, whether it is installed or not
    code, _, err = said(capsys, "sweep", "search.toml")
    assert (code, err.count("\n")) == (2, 1)
    assert "pip install 'robot-league[sweep]'" in err


def test_a_dry_run_says_what_is_searched(folder, capsys):
    code, out, _ = said(capsys, "sweep", "search.toml", "--dry-run")
    assert code == 0
    assert "searches 1 points of learner.lr from 0.0001 to 0.1, learner.epochs from 1 to 3" in out


def test_a_search_stops_where_a_league_was_begun_with_other_settings(folder, capsys):
    pytest.importorskip("optuna")
    cell = {"training.opponents.kind": "latest", "learner.lr": 0.00276, "learner.epochs": 2}  # lists before ranges
    (run,) = sweep_file.read(Path("search.toml")).of_cell(cell)
    kept = replace(run.config, training=replace(run.config.training, rollout_length=7))
    with Store.open("league-data", create=True) as store:
        store.create_league(League(run.name, dumps(kept)))
    code, out, err = said(capsys, "sweep", "search.toml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    other = "it was begun with another training.rollout_length: give the sweep another name, or remove the league"
    assert f"league {run.name}: {other}" in err


def test_an_objective_of_snapshots_from_the_first_half_of_training_says_so(tmp_path):
    with filled(tmp_path, match("blue@1", "blue@0", 60, 40), match("red@4", "red@0", 70, 30)) as store:
        found = Open(store, "cup")
        assert objective(found) == pytest.approx(0.65)
        assert too_early(found).startswith("of snapshots at 100 of 400 steps; a longer budget.rating_time")
        finish(store, matches=[match("blue@4", "blue@0", 80, 20)])
        assert objective(found) == pytest.approx(0.75)
        assert too_early(found) == ""


def test_exploiters_do_not_count_for_an_objective_unless_nobody_else_has_learnt(tmp_path):
    hunter = replace(player("hunter", 1), role="main_exploiter")
    with filled(tmp_path, match("blue@4", "blue@0", 80, 20), match("red@4", "red@0", 90, 10)) as store:
        store.add_players([hunter])
        put = store.blobs.put
        store.add_snapshots([snapshot(hunter, i, put(f"hunter@{i}".encode())) for i in (0, 1)])
        finish(store, checkpoints=[Checkpoint("cup", "hunter", put(b"new"), 4000, 40, 4000.0, C)])
        finish(store, matches=[match("hunter@1", "hunter@0", 50, 50)])
        assert objective(Open(store, "cup")) == pytest.approx(0.85)
        assert too_early(Open(store, "cup")) == ""


@pytest.mark.slow
def test_a_search_goes_on_from_the_store(folder, capsys):
    pytest.importorskip("optuna")
    code, out, err = said(capsys, "sweep", "search.toml")
    assert (code, err) == (0, "")
    assert "Best of 1 points" in out
    code, out, _ = said(capsys, "sweep", "search.toml")
    assert "nothing was left to run" in out
    (folder / "search.toml").write_text(TEXT.replace("trials = 1", "trials = 2"))
    code, out, _ = said(capsys, "sweep", "search.toml")
    assert "Best of 2 points" in out
    with Store.open("league-data") as store:
        assert len(store.leagues()) == 2
    found = search.Search(sweep_file.read(Path("search.toml")), "league-data")
    assert not list(found.rounds(1))
    best = found.best()
    assert best is not None
    assert 1e-4 <= best[0]["learner.lr"] <= 1e-1
    assert best[0]["learner.epochs"] in (1, 2, 3)
