"""A league says which share of its episodes was void, why, and what helps; scores from what was left are marked."""

import json

import pytest

from arenas.physics.void_causes import Cause
from league.commands.analyse.payoffs import payoff
from league.commands.analyse.ratings import ratings
from league.commands.analyse.tables import curves
from league.commands.run.status import report
from league.commands.status_line import Ticker, _against_initial
from league.config import presets
from league.queries.page.league_page import sections
from league.queries.query import Open, match_rows, score_text
from league.state.league_state import LeagueState
from league.state.void_rates import Voids, of_matches, of_training, sums
from matchmaking.ratings.ladder import Ladder
from storage.records import CurvePoint
from tests.league.leagues import filled, finish, match

FEW_SOUND = match("blue@4", "blue@0", 10, 8, voids=110, causes=Cause.PAIRS)
SETTING = "raise buffers.contacts"


def point(iteration: int, player: str = "blue", **values: float) -> CurvePoint:
    return CurvePoint("cup", player, iteration, 100 * iteration, float(iteration), values)


@pytest.fixture
def opened(tmp_path):
    with filled(tmp_path / "store") as store:
        yield Open(store)


def describe(text: str) -> str:
    return " ".join(text.split())


def test_status_warns_of_void_training_with_its_cause_and_setting(opened):
    figures = {"episodes": 90.0, "voids": 30.0, "void.rows": 29.0, "void.numbers": 1.0}
    finish(opened.store, curves=[CurvePoint("cup", "blue", i, 100 * i, float(i), figures) for i in (2, 3)])
    text = describe(report(opened))
    assert "25.0 % of the newest 240 training episodes were void" in text
    assert "constraint rows fill a world's buffer, numbers are not finite; raise buffers.rows." in text
    assert "`league check ARENA --engine warp`" in text
    opened.store.set_config("cup", '[arena]\nname = "sumo-2v2"\n')
    assert "`league check sumo-2v2 --engine warp`" in describe(report(opened))


def test_status_warns_of_void_rating_matches_with_their_cause_and_setting(opened):
    finish(opened.store, matches=[FEW_SOUND, match("blue@4", "red@4", 40, 32, voids=50, causes=Cause.ROWS)])
    text = describe(report(opened))
    assert "64.0 % of the newest 250 rating episodes were void" in text
    assert "pairs of geoms fill the contact pool, constraint rows fill" in text  # the more frequent cause first
    assert "raise buffers.contacts and buffers.rows." in text


def test_a_cause_that_nobody_recorded_is_said_not_to_be_known(opened):
    finish(opened.store, matches=[match("blue@4", "blue@0", 10, 8, voids=110)])
    text = describe(report(opened))
    assert "episodes were void: of a cause that was not recorded." in text
    assert "league check" not in text


def test_one_void_episode_in_a_hundred_is_no_warning(opened):
    finish(opened.store, curves=[point(2, episodes=99.0, voids=1.0)])
    finish(opened.store, matches=[match("blue@4", "blue@0", 60, 39, voids=1)])
    assert "void" not in report(opened)


def test_old_iterations_and_few_episodes_say_nothing():
    assert of_training([sums([point(1, episodes=1.0, voids=50.0)])]).warns is False
    assert of_training([sums([point(1, episodes=950.0, voids=50.0)])]).warns
    assert of_matches([]) == Voids("rating", 0, 0)


def test_run_says_it_once_and_keeps_the_share_in_its_line(opened, capsys):
    finish(opened.store, matches=[FEW_SOUND])
    ticker, state = Ticker(presets.preset("quickstart"), every=0.0), LeagueState.of(opened.store, "cup")
    for _ in range(2):
        ticker(state, "training", [])
    said = describe(capsys.readouterr().out)
    assert said.count("Warning: 85.9 % of the newest 128 rating episodes were void") == 1
    assert said.count(SETTING) == 1
    assert said.count("86 % of rating void") == 2


def test_match_rows_name_the_causes():
    rows = match_rows([FEW_SOUND, match("blue@4", "red@4", 4, 4)])
    assert [row["void_causes"] for row in rows] == ["pairs", ""]
    assert match_rows([match("a", "b", 4, 4, causes=Cause.PAIRS | Cause.ROWS)])[0]["void_causes"] == "pairs+rows"


def test_curves_show_the_share_of_void_episodes(tmp_path, capsys):
    with filled(tmp_path / "store") as store:
        finish(store, curves=[point(2, episodes=75.0, voids=25.0, score=0.5), point(3, episodes=8.0, voids=0.0)])
    assert curves(["--store", str(tmp_path / "store")]) == 0
    text = capsys.readouterr().out
    assert "void %" in text
    shares = [line.split()[-2] for line in text.splitlines() if "blue" in line]
    assert shares == ["25.0", "0.0"]


def test_a_score_is_suspect_where_voids_exceed_a_tenth_of_its_games():
    ladder = Ladder(["c"], [FEW_SOUND, match("a", "b", 50, 50, voids=10), match("b", "a", 0, 0, voids=1)])
    assert ladder.payoff.suspect == {frozenset(("blue@4", "blue@0")), frozenset(("a", "b"))}
    assert ladder.score("a", "b").voids == ladder.score("b", "a", "c").voids == 11
    assert score_text(ladder.score("blue@4", "blue@0")).endswith(" of 18, 110 more void")
    sound = Ladder([], [match("a", "b", 50, 50, voids=10)])
    assert sound.payoff.suspect == frozenset()
    assert score_text(sound.score("a", "b")).endswith(" of 100")


def test_it_is_marked_in_ratings_payoff_the_line_of_a_run_and_the_page(tmp_path, capsys):
    log = [FEW_SOUND, match("blue@1", "blue@0", 80, 20), match("red@4", "red@0", 50, 50)]
    with filled(tmp_path / "store", *log) as store:
        line = _against_initial(LeagueState.of(store, "cup"))
        page = str(sections(Open(store)))
    where = ("--store", str(tmp_path / "store"))
    assert ratings([*where]) == payoff([*where]) == 0
    table, matrix = capsys.readouterr().out.split("score %")
    (row,) = [line.split() for line in table.splitlines() if "blue@4" in line]
    assert row.count("0.556v") == 2  # win rate and vs initial
    assert "0.800v" not in table
    assert "56v" in matrix
    assert "80v" not in matrix
    for text in (table, matrix, page):
        assert "v: more episodes were void than a tenth of the games" in describe(text)
    assert line == "blue@4 56 % (86 % void), red@4 50 % vs initial"
    assert "56v" in page
    assert "of the newest 328 rating episodes were void" in page
    assert ratings([*where, "--format", "json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert (rows["blue@4"]["suspect"], rows["blue@4"]["vs_initial_suspect"]) == (True, True)
    assert (rows["red@4"]["suspect"], rows["red@4"]["vs_initial_suspect"]) == (False, False)
