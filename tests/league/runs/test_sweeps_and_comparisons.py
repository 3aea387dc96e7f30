"""A sweep as a user runs it, of which one run fails, and the comparison of the others."""

import json
import shutil
from contextlib import ExitStack, chdir, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from league.commands import cli
from league.config.schema import ConfigError
from league.runs.comparison.cells import cells, members
from league.runs.comparison.curve_bands import Band, unrated
from league.runs.sweeps import sweep_file
from league.runs.sweeps.search import Search
from league.runs.sweeps.sweep_work import SweepWork
from storage.store import Store
from tests.league.conftest import said
from tests.markup import Markup
from tests.storage.sound import change

TEXT = """
arena.name = "rock-paper-scissors"
training.worlds = 64
budget.steps = 4096
budget.rating_time = "2s"
workers.nice = 0

[rating]
worlds = 64
pairings = 4
episodes_per_pair = 16
final_episodes_per_pair = 16

[sweep]
name = "lr"
parallel = 3

[sweep.grid]
rating.scripts = [[], ["rock"], ["nobody"]]
"""
NAMES = ["lr.scripts-none.s1", "lr.scripts-rock.s1", "lr.scripts-nobody.s1"]


class Swept(NamedTuple):
    """A sweep of three runs: its folder, its exit code and what it printed."""

    folder: Path
    code: int
    out: str
    err: str


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Swept:
    found = tmp_path_factory.mktemp("swept")
    (found / "grid.toml").write_text(TEXT)
    out, err, ends = StringIO(), StringIO(), pytest.raises(SystemExit)
    with chdir(found), redirect_stdout(out), redirect_stderr(err), ends as ended:
        cli.main(["sweep", "grid.toml"])
    return Swept(found, int(ended.value.code or 0), out.getvalue(), err.getvalue())


@pytest.fixture
def inside(swept, monkeypatch) -> Path:
    monkeypatch.chdir(swept.folder)
    return swept.folder


def states(capsys) -> list[str]:
    code, out, _ = said(capsys, "sweep", "grid.toml", "--dry-run", "--format", "json")
    assert code == 0
    return [row["state"] for row in json.loads(out)]


def test_a_dry_run_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("grid.toml").write_text(TEXT)
    assert states(capsys) == ["waits"] * 3
    assert [each.name for each in tmp_path.iterdir()] == ["grid.toml"]


def test_one_run_fails_in_one_line_and_the_others_finish(swept, inside, capsys):
    assert (swept.code, swept.err) == (1, "")
    (failed,) = [line for line in swept.out.splitlines() if " failed: " in line]
    assert NAMES[2] in failed
    assert "nobody" in failed
    assert "2 of 3 runs have finished; 1 failed" in swept.out
    assert states(capsys) == ["finished", "finished", "waits"]


def test_finished_runs_are_skipped_and_a_larger_budget_is_not(inside):
    found, told = sweep_file.read(Path("grid.toml")), []
    outcome = SweepWork("league-data", 2, told.append).work_off(found.runs()[:2])
    assert (outcome.finished, told) == (NAMES[:2], [])
    more = replace(found, base={**found.base, "budget": {"steps": 8192, "rating_time": "0s"}})
    with Store.open("league-data") as store:
        assert sweep_file_states(store, more.runs()[:2]) == ["begun", "begun"]


def sweep_file_states(store, runs) -> list[str]:
    from league.runs.sweeps.run_state import run_state

    return [run_state(store, run.config) for run in runs]


def test_a_league_that_was_begun_with_other_settings_is_left_alone(inside):
    found, told = sweep_file.read(Path("grid.toml")), []
    other = replace(found, base={**found.base, "learner": {"gamma": 0.5}})
    outcome = SweepWork("league-data", 2, told.append).work_off(other.runs()[:1])
    assert "begun with another learner.gamma" in outcome.failed[NAMES[0]]


def test_a_search_counts_no_league_that_was_begun_with_other_settings(inside):
    pytest.importorskip("optuna")
    found = sweep_file.read(Path("grid.toml"))
    found = replace(found, grid={"rating.scripts": [[], ["rock"]]}, settings=replace(found.settings, trials=2))
    other = replace(found, base={**found.base, "learner": {"gamma": 0.5}})
    began_first = f"({NAMES[0]}|{NAMES[1]})"  # they ran at the same time
    search = Search(found, "league-data")
    assert not list(search.rounds(1))
    assert search.best() is not None
    with pytest.raises(ConfigError, match=rf"{began_first}: it was begun with another learner.gamma: give the sweep"):
        Search(other, "league-data")
    cell = {"rating.scripts": []}
    assert search.tell(search.study.ask(search.distributions), found.of_cell(cell)) is not None
    assert search.tell(search.study.ask(search.distributions), other.of_cell(cell)) is None


def test_cells_are_compared_on_one_ladder_whose_matches_are_kept(inside, capsys):
    args = ("compare", "--sweep", "lr", "--format", "json")
    code, out, err = said(capsys, *args, "--for", "20s", "--episodes", "128", "-o", "compare.html")
    assert code == 0, err
    found = json.loads(out)
    rows = found["ladder"]
    assert {row["league"] for row in rows} == set(NAMES[:2])
    assert {row["name"] for row in rows} == {f"{name}.{team}@2" for name in NAMES[:2] for team in ("blue", "red")}
    assert all(row["known"] and row["low"] < row["elo"] < row["high"] for row in rows)
    assert sum(row["elo"] for row in rows) / 4 == pytest.approx(1000)
    assert [cell["leagues"] for cell in found["cells"]] == [1, 1]
    assert len(found["verdicts"]) == 1
    page = Markup(Path("compare.html").read_text("utf-8"))
    assert len(page.tables["Ladder"]) == 5
    again = json.loads(said(capsys, *args, "--no-play")[1])
    assert again["ladder"] == rows
    assert states(capsys) == ["finished", "finished", "waits"]  # nothing of the compared leagues has changed


def test_matches_under_another_engine_are_told_and_are_on_no_ladder(inside, tmp_path, monkeypatch, capsys):
    """As where one host has compared on its GPU and another one compares on its CPU."""
    shutil.copytree(inside / "league-data", tmp_path / "league-data")
    monkeypatch.chdir(tmp_path)
    args = ("compare", "--sweep", "lr", "--format", "json")
    code, _, err = said(capsys, *args, "--for", "20s", "--episodes", "64", "--into", "alone")
    assert code == 0, err
    with Store.open("league-data") as store:
        played = sum(m.episodes for m in store.matches("alone"))
    change(tmp_path / "league-data", "UPDATE matches SET engine = 'warp' WHERE league = 'alone' AND id <= 2")
    with Store.open("league-data") as store:
        under_warp = sum(m.episodes for m in store.matches("alone") if m.arena.engine == "warp")
    code, out, err = said(capsys, "compare", "--sweep", "lr", "--no-play", "--into", "alone")
    assert code == 0, err
    assert f"Not on the ladder: {under_warp:,} episodes under engine warp" in " ".join(out.split())
    rows = json.loads(said(capsys, *args, "--no-play", "--into", "alone")[1])["ladder"]
    assert sum(row["games"] for row in rows) == 2 * (played - under_warp)
    change(tmp_path / "league-data", "UPDATE matches SET engine = 'warp' WHERE league = 'alone'")
    code, out, err = said(capsys, "compare", "--sweep", "lr", "--no-play", "--into", "alone")
    assert code == 0, err
    assert f"{played:,} episodes under engine warp" in " ".join(out.split())


def test_a_curve_that_ends_for_want_of_ratings_says_so(inside):
    with ExitStack() as until, Store.open("league-data") as store:
        groups = cells(members(NAMES[:2], None, store, until))
        short = Band("", 1, *(np.array([1024.0]),) * 4)
        assert unrated(groups, [short]).startswith("Rated snapshots reach 1,024 of 4,096 steps")
        assert unrated(groups, [Band("", 1, *(np.array([2048.0]),) * 4)]) == unrated(groups, []) == ""


def test_a_league_of_another_store_can_be_compared(inside, capsys):
    shutil.copytree("league-data", "other")
    args = ("compare", NAMES[0], f"other#{NAMES[1]}", "--metric", "entropy", "--for", "0s", "--format", "json")
    code, out, err = said(capsys, *args, "--into", "mixed")
    assert code == 0, err
    found = json.loads(out)
    assert [each["steps"] for each in found["curves"]] == [2048, 4096] * 2
    assert all(each["low"] == each["mean"] == each["high"] for each in found["curves"])
    with Store.open("league-data") as store:
        kept = {s.name for s in store.snapshots("mixed")}
    assert f"other.{NAMES[1]}.blue@2" in kept


def test_a_pattern_leaves_out_the_league_that_keeps_the_matches(inside, capsys):
    args = ("compare", "--sweep", "lr", "--into", "lr.kept", "--format", "json")
    assert said(capsys, *args, "--for", "20s", "--episodes", "128")[0] == 0
    code, out, err = said(capsys, *args, "--no-play")
    assert code == 0, err
    assert {row["league"] for row in json.loads(out)["ladder"]} == set(NAMES[:2])


def test_leagues_that_have_not_met_say_that_their_ratings_are_not_known(inside, capsys):
    for name in NAMES[:2]:
        args = ("compare", name, "--into", "apart", "--for", "20s", "--episodes", "128")
        assert "not known yet" not in said(capsys, *args)[1]
    out = said(capsys, "compare", *NAMES[:2], "--into", "apart", "--no-play")[1]
    assert f"Ratings are not known yet (–) in {NAMES[0]}, {NAMES[1]}:" in " ".join(out.split())


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ((), "league compare needs leagues"),
        (("nobody",), "There is no league 'nobody'"),
        (("no*",), "There is no league 'no*'"),
        (("--sweep", "nix"), "There is no sweep 'nix' here; there is: lr."),
        ((NAMES[0], "--into", NAMES[1]), f"--into {NAMES[1]} is a league with players of its own"),
        ((NAMES[0], "--into", NAMES[1], "--no-play"), "give a new name"),
        ((NAMES[0], "--metric", "nix"), "metric 'nix' was not recorded; there are: vs_initial"),
        ((NAMES[0], "--for", "soon"), "--for"),
    ],
)
def test_what_cannot_be_compared_is_one_line(args, says, inside, capsys):
    code, out, err = said(capsys, "compare", *args)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err


def test_the_store_lists_its_leagues(inside, capsys):
    rows = json.loads(said(capsys, "list", "--format", "json")[1])
    found = {row["league"]: row for row in rows}
    assert found.keys() >= set(NAMES[:2])
    first = found[NAMES[0]]
    assert (first["arena"], first["state"], first["steps"]) == ("rock-paper-scissors", "stopped", 4096)
    assert first["newest"] in ("blue@2", "red@2")
    assert first["active"].endswith("Z")
