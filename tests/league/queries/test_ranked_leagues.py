"""A league of three teams as commands, the page and `league.open` show it."""

import json
from dataclasses import replace

import pytest

import league
from league.commands.cli import main
from league.queries.page.league_page import page
from league.queries.query import Open
from league.queries.ratings.rating_rows import scores_against_initial, side_score
from league.state.league_state import LeagueState
from matchmaking.ratings.fit import fit
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.scores import score_interval
from storage.records import ArenaKey, League, Match, RankedMatch
from storage.store import Store
from tests.league.leagues import CONFIG, C, finish, match, player, snapshot

TAG = ArenaKey("tag", "c0ffee00", "c")
PLAYERS = [player(name, team) for team, name in enumerate(("blue", "red", "green"))]


def lineup(*ages: int, seed: int = 0, **rankings: int) -> RankedMatch:
    """A batch of blue, red and green at these iterations; r122=5 for five episodes that ended 1, 2, 2."""
    names = tuple(f"{p.name}@{age}" for p, age in zip(PLAYERS, ages, strict=True))
    counts = {tuple(map(int, text[1:])): number for text, number in rankings.items()}
    return RankedMatch("cup", TAG, names, counts, 2, (1, 0, 0), seed)


LOG = (
    lineup(0, 0, 0, seed=1, r123=6, r231=5, r312=6, r111=3),
    lineup(4, 0, 0, seed=2, r123=9, r132=8, r213=3),
    lineup(0, 4, 4, seed=3, r312=6, r321=7, r122=2, r213=3),
    lineup(4, 4, 4, seed=4, r123=5, r312=6, r231=7, r113=2),
)


@pytest.fixture
def place(tmp_path) -> str:
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("cup", CONFIG))
        store.add_players(PLAYERS)
        store.start_run("cup", CONFIG, "here", {})
        names = [(p, i) for p in PLAYERS for i in (0, 4)]
        store.add_snapshots([snapshot(p, i, store.blobs.put(f"{p.name}@{i}".encode())) for p, i in names])
        finish(store, matches=LOG)
    return str(tmp_path / "store")


@pytest.fixture
def ran(place, capsys, monkeypatch):
    """Run a command: exit code, what it printed, what it complained of."""
    monkeypatch.setenv("COLUMNS", "160")

    def run(name, *args):
        with pytest.raises(SystemExit) as left:
            main([name, *args, "--store", place])
        return left.value.code, *capsys.readouterr()

    return run


def test_the_state_reads_lineups_as_they_come_and_as_sums(place):
    with Store.open(place) as store:
        first = LeagueState.of(store, "cup")
        assert (first.arena, first.read) == (TAG, 4)
        finish(store, matches=[lineup(4, 0, 4, seed=5, r123=4, r312=1)])
        later, anew = LeagueState.of(store, "cup", first), LeagueState.of(store, "cup")
        assert later.read == anew.read == 5
        assert later.ladder.ratings.elo.tolist() == anew.ladder.ratings.elo.tolist()
        assert later.ladder.ratings.elo.tolist() != first.ladder.ratings.elo.tolist()
        finish(store, matches=[match("blue@4", "red@4", 3, 1)])  # the arena has changed
        assert LeagueState.of(store, "cup", later).arena == C
        assert not LeagueState.of(store, "cup", later).ladder.payoff.rankings


def test_ratings_are_those_of_the_rankings(ran, place):
    code, out, _ = ran("ratings", "--format", "json")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(out)}
    want = fit(sum_matches(LOG), anchors=["blue@0", "red@0", "green@0"])
    assert {name: row["elo"] for name, row in rows.items()} == pytest.approx(
        dict(zip(want.names, want.elo.tolist(), strict=True)), abs=1e-6
    )
    counts = ("games", "wins", "draws", "losses", "voids", "opponents")
    assert [rows["blue@4"][key] for key in counts] == [80, 56, 2, 22, 8, 4]
    assert rows["blue@4"]["voids_own"] == pytest.approx(4 / 88)
    with league.open(place) as opened:
        assert opened.ratings().set_index("name").elo["red@4"] == pytest.approx(rows["red@4"]["elo"])
    code, out, _ = ran("ratings")
    assert "Ratings are fitted to whole rankings; in games and w-d-l each other team counts as a game." in out
    code, out, err = ran("ratings", "--ticker")
    assert (code, out, err.count("\n")) == (2, "", 1)


def test_scores_against_two_others_of_one_episode_have_the_intervals_of_episodes():
    """Both initial snapshots of unlike sides, and the games of a side against one other, as the ladder has them."""
    unlike = [PLAYERS[0], *(replace(p, roster="puck:22:2") for p in PLAYERS[1:])]
    pool, ladder = [snapshot(p, i) for p in unlike for i in (0, 4)], Ladder((), LOG)
    score = scores_against_initial(ladder, pool, unlike)["blue@4"]
    assert score == ladder.score("blue@4", "red@0", "green@0")
    assert (score.score, score.games) == (pytest.approx(37 / 40), 40)
    low, high = score_interval(37, 0, 3)
    assert score.high - score.low > 1.04 * (high - low)
    side = side_score(ladder, pool, "rover", "puck:22:2")
    assert (side.score, side.games) == (pytest.approx(84 / 156), 156)
    low, high = score_interval(80, 8, 68)
    assert side.high - side.low > 1.2 * (high - low)


def test_a_lineup_tells_who_played_with_whom(ran, place):
    _, out, _ = ran("matches")
    assert "blue@4, red@0, green@0   1.15, 2.25, 2.60" in out
    _, out, _ = ran("matches", "--format", "json")
    row = json.loads(out)[1]
    assert (row["match"], row["a"], row["wins"], row["voids"]) == (2, None, None, 2)
    assert (row["lineup"], row["rankings"]) == ("blue@4, red@0, green@0", "1,2,3: 9; 1,3,2: 8; 2,1,3: 3")
    with league.open(place) as opened:
        assert opened.matches().lineup.tolist()[1] == row["lineup"]


def test_a_league_of_both_kinds_shows_both(ran, place):
    with Store.open(place) as store:
        finish(store, matches=[match("blue@4", "red@4", 3, 1)])
    _, out, _ = ran("matches", "--format", "json")
    *_, lineups, pair = json.loads(out)
    assert (pair["a"], pair["wins"], pair["lineup"]) == ("blue@4", 3, None)
    assert (lineups["a"], lineups["lineup"]) == (None, "blue@4, red@4, green@4")
    _, out, _ = ran("matches")
    assert "3-0-1" in out
    assert "blue@4, red@4, green@4" in out
    assert "None" not in out


def test_payoff_and_meta_game_count_every_pair_of_a_lineup(ran):
    _, out, _ = ran("payoff", "--format", "json")
    told = json.loads(out)
    assert told["games"][told["rows"].index("blue@4")][told["columns"].index("red@0")] == 20
    code, out, _ = ran("meta")
    assert code == 0
    assert "blue@4" in out


def test_the_page_has_lineups(place):
    with Store.open(place) as store:
        found = page(Open(store, "cup"))
    text = "\n".join(str(block) for section in found.sections for block in section.parts)
    assert "blue@4, red@0, green@0" in text
    assert "counted for a" not in next(str(s.parts) for s in found.sections if s.id == "matches")


@pytest.mark.parametrize(
    "command",
    [
        ["gate", "blue@4", "red@4"],
        ["exploit", "blue@4", "--budget", "100"],
    ],
)
def test_what_is_between_two_is_refused_in_one_line(ran, command):
    code, out, err = ran(*command)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "league cup has 3 teams, and a" in err
    assert "is for two: `league ratings` ranks its players" in err


def test_a_snapshot_that_a_person_let_play_is_kept(place):
    from league.snapshots.retention import may_go

    with Store.open(place) as store:
        assert not any(isinstance(m, Match) for m in store.log("cup"))
        store.add_snapshots([snapshot(PLAYERS[0], i, store.blobs.put(f"{i}".encode())) for i in (2, 3)])
        spared = may_go(Open(store, "cup"), 1)
        assert "blue@3" in spared
        shown = RankedMatch("cup", TAG, ("blue@3", "red@4", "green@4"), {(1, 2, 3): 1}, 0, (0, 0, 0), 9)
        finish(store, matches=[RankedMatch(**{**vars(shown), "purpose": "exhibition"})])
        assert may_go(Open(store, "cup"), 1) == spared - {"blue@3"}


def test_explain_names_the_players_of_each_other_team(ran, place):
    code, out, _ = ran("explain", "blue")
    assert code == 0
    assert "blue meets team 1 (red) as it is now" in out
    assert "blue meets team 2 (green) as it is now" in out
    with Store.open(place) as store:
        assert "Whom blue meets in team 1 (red)" in str(page(Open(store)))
