"""Learning curves on the page: what is read in columns is what rows of the same points give."""

import random
from dataclasses import replace

import pytest

from dashboards.web.document import FigureBlock
from dashboards.web.figures import POINTS, curves
from league.queries.columns import NEWEST
from league.queries.opponents import explain_opponents
from league.queries.page.league_page import sections
from league.queries.page.learning_curves import DRAWN, SPEED, LearningCurves
from league.queries.query import Open, curve_rows
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents
from storage.errors import StorageError
from storage.records import CurvePoint
from tests.league.leagues import BLUE, RED, filled, finish, games, snapshot

METRICS = (*DRAWN, SPEED, "event.goal")


@pytest.fixture
def store(tmp_path):
    """A league with curves of 1,234 iterations of blue, some without a metric, and 5 of red."""
    rng = random.Random(0)
    with filled(tmp_path / "store") as store:
        found = []
        for name, count in (("blue", 1234), ("red", 5)):
            for i in range(1, count + 1):
                values = {key: rng.random() for key in (*METRICS, "loss") if key != "entropy" or i % 3}
                found.append(CurvePoint("cup", name, i, 10 * i, i / 7, {"reward": 1.0} if i == 4 else values))
        finish(store, curves=found)
        yield store


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("over", ["steps", "seconds"])
def test_columns_give_the_lines_that_rows_give(store, metric, over):
    opened = Open(store)
    found, rows = LearningCurves.of(opened), curve_rows(opened.points())
    expected = {
        name: [(row[over], row[metric]) for row in rows if row["player"] == name and metric in row]
        for name in ("blue", "red")
    }
    assert {name: list(zip(*line, strict=True)) for name, line in found.lines(metric, over).items()} == expected
    (blue, red) = curves(found.lines(metric, over), metric)["data"]
    assert len(blue["x"]) <= POINTS < len(expected["blue"])
    size = -(-len(expected["blue"]) // POINTS)
    groups = [expected["blue"][i : i + size] for i in range(0, len(expected["blue"]), size)]
    assert blue["x"] == [group[-1][0] for group in groups]
    assert blue["y"] == [sum(y for _, y in group) / len(group) for group in groups]
    assert list(zip(red["x"], red["y"], strict=True)) == expected["red"]


def test_the_newest_rows_and_the_numbers_of_iterations_are_those_of_all_rows(store):
    opened = Open(store)
    found = LearningCurves.of(opened)
    rows = curve_rows(sorted(opened.points(), key=lambda p: (p.iteration, p.player)))
    assert found.newest == rows[-NEWEST:]
    assert (found.total, found.longest) == (1239, 1234)
    assert found.metrics == {*METRICS, "loss"}


def test_events_are_plotted_beside_the_metrics_that_all_arenas_have(store):
    (section,) = (s for s in sections(Open(store)) if s.id == "curves")
    captions = [part.caption for part in section.parts if isinstance(part, FigureBlock)]
    assert len(captions) == len(DRAWN) + 1
    assert captions[-1].startswith("Share of episodes with “goal” over the training steps of each player.")


def test_a_damaged_curve_is_told(store):
    with store._db.writing() as db:
        db.exec_driver_sql("UPDATE curves SET \"values\" = '1], [2' WHERE iteration = 1234")
    with pytest.raises(StorageError, match="'curves' is damaged"):
        LearningCurves.of(Open(store))


def test_older_opponents_keep_their_probabilities(tmp_path):
    with filled(tmp_path / "store") as store:
        store.add_snapshots([snapshot(p, i, store.blobs.put(b"same")) for p in (BLUE, RED) for i in range(5, 60)])
        finish(store, meetings=[games(f"red@{i}", i % 7, 3) for i in range(5, 60)])
        opened, state = Open(store), LeagueState.of(store, "cup")
        role = replace(opened.roles()("main"), opponents=Opponents(kind="pfsp"))
        (whole,) = explain_opponents(role, state, BLUE)["teams"]
        (brief,) = explain_opponents(role, state, BLUE, most=10)["teams"]
        assert brief["opponents"] == whole["opponents"][:10]
        keys = ("opponent", "present", "probability")
        assert brief["older"] == [{key: row[key] for key in keys} for row in whole["opponents"][10:]]
        assert len({row["probability"] for row in brief["older"]}) > 1
        assert "older" not in whole
