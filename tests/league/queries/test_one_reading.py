"""Commands sum the log of matches once: in an old league that takes longer than all else, on the server too."""

from pathlib import Path

import pytest
from sqlalchemy import Engine, event

import league
from league.commands.analyse.explain import explain
from league.commands.analyse.payoffs import forgetting, meta, payoff
from league.commands.analyse.ratings import ratings
from league.commands.run.status import status
from league.commands.store.policies import export
from league.commands.store.thin import thin
from league.commands.watch.report import report
from league.queries.page import league_page
from league.queries.query import Open
from storage.recordings.recording import to_bytes
from storage.records import Job
from storage.store import Store
from tests.dashboards.cars import cars
from tests.league.leagues import WARP, C, filled, finish, match
from tests.league.snapshots.test_policy_file import league_at
from tests.league.snapshots.test_policy_file import match as exported

LADDERS = 2


@pytest.fixture
def folder(tmp_path) -> Path:
    """A league with two ladders and recorded matches."""
    with filled(tmp_path / "store") as store:
        recording = store.blobs.put(to_bytes(cars()))
        finish(store, matches=[match("blue@4", "red@4", 40, 24, recording=recording), match("blue@4", "blue@0", 60, 4)])
        finish(store, matches=[match("red@4", "blue@4", 60, 4, arena=WARP)])
        finish(store, matches=[match("red@4", "red@0", 60, 4, recording=recording), match("red@1", "red@0", 32, 32)])
    return tmp_path / "store"


@pytest.fixture
def sums():
    """Statements that sum the wins of matches by pairs, as they are sent; without those up to a time."""
    found: list[str] = []

    def note(connection, cursor, statement: str, *others: object) -> None:
        if "sum(matches.wins)" in statement and "GROUP BY matches.a" in statement and "created <=" not in statement:
            found.append(statement)

    event.listen(Engine, "before_cursor_execute", note)
    yield found
    event.remove(Engine, "before_cursor_execute", note)


@pytest.mark.parametrize(
    ("command", "words", "times"),
    [
        (ratings, [], LADDERS), (ratings, ["--all"], LADDERS), (payoff, [], LADDERS), (meta, [], LADDERS),
        (payoff, ["--format", "csv"], LADDERS), (forgetting, [], LADDERS), (explain, ["blue"], LADDERS),
        (status, [], 0), (report, ["--films", "0", "-o", "{out}"], LADDERS),
    ],
)  # fmt: skip
def test_a_command_sums_each_ladder_once(folder, tmp_path, sums, command, words, times):
    words = [word.format(out=tmp_path / "page.html") for word in words]
    assert command([*words, "--store", str(folder)]) == 0
    assert len(sums) == times


def test_a_policy_and_its_card_sum_each_ladder_once(tmp_path, sums):
    with league_at(tmp_path / "home", "home") as store:
        store.queue([Job("home", "any", "played")])
        claimed = store.claim("home", ["any"], "x", 60)
        assert claimed is not None
        store.finish(claimed[0], matches=[exported("blue@4", "blue@0", 30, 4, 6)])
    assert export(["blue@4", "-o", str(tmp_path / "blue.safetensors"), "--store", str(tmp_path / "home")]) == 0
    assert len(sums) == 1


def test_thinning_the_page_and_a_notebook_sum_each_ladder_once(folder, sums):
    assert thin(["--store", str(folder), "--snapshots", "1", "--dry-run"]) == 0
    assert len(sums) == LADDERS
    with league.open(str(folder)) as opened:
        opened.payoff()
    assert len(sums) == 2 * LADDERS
    with Store.open(str(folder)) as store:
        league_page.page(Open(store))
    assert len(sums) == 3 * LADDERS


def test_the_films_of_a_report_are_chosen_by_the_ladder_of_the_page(folder, sums):
    from league.queries.recordings import HIGHLIGHTS, highlights

    with Store.open(str(folder)) as store:
        opened = Open(store)
        ladder = opened.shown().ladders[0]
        sums.clear()
        found = highlights(opened, len(HIGHLIGHTS), ladder)
        assert ladder.arena == C
        assert not sums
        assert found == highlights(opened, len(HIGHLIGHTS))  # which sums the log
        assert len(sums) == LADDERS
