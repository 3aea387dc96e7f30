"""The page's first section: its answers are those of the ladder, of the curves and of what went wrong."""

import os
import socket

import pytest

from dashboards.web.document import Card, FigureBlock, FilmBlock, TableBlock
from league.queries.page import league_page
from league.queries.page.league_page import sections
from league.queries.query import Open
from storage.records import CurvePoint, Job, League
from storage.store import Store
from tests.league.leagues import filled, finish, match, snapshot, unlike_sides

FILM = FilmBlock("a film", "film/1.webm")
RATED = (
    match("blue@1", "blue@0", 60, 4), match("blue@4", "blue@1", 150, 50), match("red@4", "red@1", 60, 140),
    match("red@1", "red@0", 60, 4), match("blue@4", "red@4", 160, 40), match("blue@1", "red@1", 32, 32),
)  # fmt: skip


@pytest.fixture
def place(tmp_path):
    return tmp_path / "league-data"


def cards(store: Store, films=(FILM,)) -> list[Card]:
    overview = sections(Open(store), films=films)[0]
    assert overview.id == "overview"
    assert overview.aside[0] == films[0]
    found = [part for part in overview.parts if isinstance(part, Card)]
    assert [card.title for card in found] == ["Who leads", "Is it still learning?", "What is wrong?"]
    return found


def test_who_leads_is_told_with_its_interval_and_whether_that_is_sure(place):
    games = match("blue@4", "red@4", 160, 40), match("blue@4", "blue@0", 60, 4), match("red@4", "red@0", 60, 4)
    with filled(place, *games) as store:
        leads, _, _ = cards(store)
        row = Open(store).ratings().iloc[0]
        assert leads.answer == "blue@4 leads"
        assert leads.lines[0].startswith(
            f"blue@4: {row.elo:.0f} Elo (95 %: {row.low:.0f} to {row.high:.0f}); stronger than red@4: it scores 80.0 %"
        )
        finish(store, matches=[match("red@4", "blue@4", 110, 0)])
        assert cards(store)[0].answer.endswith("leads, not surely")


def test_gains_and_losses_over_the_second_half_of_training_are_told(place):
    with filled(place, *RATED) as store:
        _, learning, _ = cards(store)
        assert learning.answer == "red: worse than at half the training"
        assert learning.lines[0].startswith("The league is stopped: iteration 4, 400 steps, 1:06:40 of training")
        assert learning.lines[1].startswith("red@1 is stronger than red@4: it scores 70.0 %")
        assert learning.lines[2].startswith("blue@4 is stronger than blue@1: it scores 75.0 %")
        finish(store, matches=[match("red@4", "red@1", 400, 100)])
        assert cards(store)[1].answer == "Yes, until it stopped"


def test_players_that_take_turns_are_told_with_the_sum_that_their_budget_limits(place):
    with filled(place) as store:
        turns = '[budget]\ntraining_time = "4h"\n[training.schedule]\nkind = "leapfrog"\n'
        store.set_config("cup", turns)
        told = "iteration 4, 800 steps, 2:13:20 of training, 56 % of its training budget."
        assert cards(store)[1].lines[0] == f"The league is stopped: {told}"


def test_the_course_of_the_ratings_stands_beside_them_or_before_the_scores_in_training(place):
    with filled(place) as store:
        curves = [CurvePoint("cup", "blue", i, 100 * i, float(i), {"score": 0.1 * i}) for i in (1, 2, 3)]
        finish(store, curves=curves)
        leads, learning, wrong = cards(store)
        assert (leads.answer, learning.answer) == ("Not known yet", "Not known yet")
        assert "No rating match has been played yet" in leads.lines[0]
        assert "No snapshot has a known rating yet." in wrong.lines

        def drawn() -> tuple[str, list]:
            figure = sections(Open(store))[0].aside[1]
            assert isinstance(figure, FigureBlock)
            assert figure.figure["layout"]["height"] < 250
            return figure.caption, [trace["y"] for trace in figure.figure["data"] if trace.get("name") == "blue"]

        caption, lines = drawn()
        assert caption.startswith("Score in training")
        assert lines == [pytest.approx([0.1, 0.2, 0.3])]
        finish(store, matches=RATED)
        caption, lines = drawn()
        assert caption.startswith("Elo over training steps")
        assert len(lines[0]) == 3


def test_nothing_wrong_is_told_too_and_what_is_wrong_is_listed(place):
    with filled(place, *RATED) as store:
        *_, wrong = cards(store)
        assert (wrong.answer, wrong.lines, wrong.is_trouble) == ("Nothing known", [], False)
        store.set_paused("cup", "red", "a loss is nan\nat line 5")
        store.queue([Job("cup", "match", "broken")])
        claimed = store.claim("cup", ["match"], "here:1:0", 60)
        assert claimed
        store.fail(claimed[0], "no <good>", tries=1)
        store.heartbeat(
            f"{socket.gethostname()}:999999999:train0", "cup", "train", 999_999_999, socket.gethostname(), {}
        )
        points = [CurvePoint("cup", "blue", i, 100 * i, float(i), {"episodes": 90.0, "voids": 10.0}) for i in (3, 4)]
        finish(store, curves=points)
        *_, wrong = cards(store)
        assert wrong.is_trouble
        assert wrong.answer == "4 things"
        assert "999999999:train0 (train) stopped without a word." in wrong.lines[0]
        assert wrong.lines[1] == "Paused, it learns no more: red: a loss is nan"
        assert wrong.lines[2] == "Set aside: broken, tried 1 times: no <good>"
        assert wrong.lines[3].startswith("10.0 % of training void")
        for i in range(5):
            store.queue([Job("cup", "match", f"broken{i}")])
            claimed = store.claim("cup", ["match"], "here:1:0", 60)
            assert claimed
            store.fail(claimed[0], "no", tries=1)
        *_, wrong = cards(store)
        assert wrong.answer == "9 things"
        assert len(wrong.lines) == 5
        assert wrong.lines[-1] == "5 more."


def test_a_league_that_runs_without_a_working_worker_is_told(place):
    with filled(place, *RATED) as store:
        here = f"{socket.gethostname()}:{os.getpid()}"
        store.heartbeat(f"{here}:train0", "cup", "train", os.getpid(), socket.gethostname(), {})
        assert "The league runs, and no worker does anything yet." in cards(store)[2].lines
        store.heartbeat(f"{here}:train0", "cup", "train", os.getpid(), socket.gethostname(), {"doing": "training"})
        _, learning, wrong = cards(store)
        assert not wrong.lines
        assert "The league is stopping" in learning.lines[0]  # it has no manager


def test_unlike_sides_have_a_leader_each_and_one_team_its_success(tmp_path):
    played = [match(f"blue@{i}", f"red@{j}", 30 + 3 * i - 2 * j, 34) for i in (0, 4) for j in (0, 4)]
    blue, red = unlike_sides(tmp_path / "two", played)
    with Store.open(tmp_path / "two") as store:
        leads, ratings = cards(store)[0], Open(store).ratings()
        first = {
            p.name: ratings.loc[(ratings.player == p.name) & (ratings["rank"] == 1), "name"].item() for p in (blue, red)
        }
        assert leads.answer == f"{first['blue']} leads; {first['red']} leads"
        sides = [line.partition(":")[0] for line in leads.lines]
        assert sides == [f"{first['blue']} of 1 × tank", f"{first['red']} of 1 × drone"]
    with Store.open(tmp_path / "one", create=True) as store:
        store.create_league(League("cup", ""))
        store.add_players([blue])
        store.add_snapshots([snapshot(blue, i, store.blobs.put(b"%d" % i)) for i in (0, 4)])
        finish(store, matches=[match(f"blue@{i}", None, 10 + 5 * i, 22 - 5 * i) for i in (0, 4)])
        leads = cards(store)[0]
        assert leads.answer == "blue@4 leads"
        assert leads.lines[0].startswith("blue@4 succeeds: 93.8 %")


def test_of_many_opponents_the_page_lists_the_newest(place, monkeypatch):
    def tables(store: Store) -> dict[str, int]:
        parts = next(s for s in sections(Open(store)) if s.id == "opponents").parts
        return {part.name: part.markup.count("<tr") - 1 for part in parts if isinstance(part, TableBlock)}

    with filled(place) as store:
        whole = tables(store)
        assert sorted(whole.values()) == [4, 4]  # the present player and three snapshots
        monkeypatch.setattr(league_page, "NEWEST", 2)
        assert tables(store) == {f"{name}: the newest 2 of 4": 2 for name in whole}
