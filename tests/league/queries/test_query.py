"""Ladders, measures and tables over leagues whose figures can be worked out by hand."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest

import league
from dashboards.text import clock
from league.commands.analyse import tables
from league.commands.analyse.ratings import ratings
from league.commands.ladder_text import ratings_table
from league.config import presets
from league.config.schema import ConfigError
from league.queries import query
from league.queries.query import Open, choose
from league.queries.ratings.rating_rows import rating_rows, side_score
from league.scheduling.progress_metrics import (
    can_meet,
    initial_opponents,
    milestones,
    reference_opponents,
    score_against_initial,
)
from league.state.league_state import LeagueState
from matchmaking.ratings.ladder import Ladder, Pool
from matchmaking.ratings.scores import score_interval
from storage.errors import StorageError
from storage.records import CurvePoint
from tests.league.leagues import BLUE, RED, WARP, C, filled, finish, match, player, snapshot

ANT = player("ants", 1, "ant")
OTHER_ANT = player("ants-2", 1, "ant")


def frozen(*players):
    return [snapshot(p, i) for i in (0, 1, 4) for p in players]


# The measures


def test_a_players_name_is_its_newest_snapshot(tmp_path):
    with filled(tmp_path / "store") as store:
        opened = Open(store, "cup")
        assert opened.snapshot("blue").name == "blue@4"
        assert opened.snapshot("blue@1").name == "blue@1"
        with pytest.raises(StorageError, match=r"There is no snapshot 'blu' here"):
            opened.snapshot("blu")


def test_with_equal_rosters_initial_is_ones_own():
    pool = frozen(BLUE, RED)
    assert [s.name for s in initial_opponents(pool[4], pool, [BLUE, RED])] == ["blue@0"]
    assert initial_opponents(pool[0], pool, [BLUE, RED]) == []


def test_with_unlike_rosters_initial_is_every_opponents_pooled():
    players = [BLUE, ANT, OTHER_ANT]
    pool = [*frozen(*players), snapshot(None, 0, name="idle")]
    newest = pool[6]
    assert newest.name == "blue@4"
    assert [s.name for s in initial_opponents(newest, pool, players)] == ["ants@0", "ants-2@0"]
    assert [s.name for s in initial_opponents(pool[7], pool, players)] == ["blue@0"]
    log = [match("blue@4", "ants@0", 6, 2), match("ants-2@0", "blue@4", 4, 12), match("blue@4", "ants@4", 0, 99)]
    ladder = Ladder([s.name for s in pool], log)
    score = score_against_initial(ladder, newest, pool, players)
    assert score is not None
    assert (score.score, score.games) == (18 / 24, 24)
    assert (score.low, score.high) == pytest.approx(score_interval(18, 0, 6))
    assert score_against_initial(ladder, pool[8], pool, players) is None  # ants-2@4 has not met blue@0


def test_initial_is_the_marked_snapshot_and_not_the_first_one_kept():
    imported = replace(snapshot(BLUE, 7), initial=True, origin="imported")
    pool = [replace(snapshot(BLUE, 0), initial=False), imported, snapshot(BLUE, 8), snapshot(RED, 0)]
    assert initial_opponents(pool[2], pool, [BLUE, RED]) == [imported]


def test_scripts_and_one_team_arenas_have_no_initial_opponents():
    pool = [*frozen(BLUE), snapshot(None, 0, name="pusher")]
    assert initial_opponents(pool[-1], pool, [BLUE, RED]) == []
    assert initial_opponents(pool[1], pool, [BLUE]) == []
    assert not can_meet(pool[1], pool[0], [BLUE])


def test_yardsticks_are_initial_milestones_and_scripts_that_it_can_meet():
    config = presets.preset("quickstart")
    config = replace(config, rating=replace(config.rating, milestones=("1s", "3s", "1h"), scripts=("pusher",)))
    pool = [*frozen(BLUE, RED), snapshot(None, 0, name="pusher"), snapshot(None, 0, name="idle")]
    state = LeagueState(players=[BLUE, RED], snapshots=pool)
    assert {name: s.name for name, s in milestones(config, state, "blue").items()} == {
        "1s": "blue@1",
        "3s": "blue@4",
    }
    assert [s.name for s in reference_opponents(config, state, pool[4])] == ["blue@0", "blue@1", "pusher"]
    unlike = LeagueState(
        players=[BLUE, ANT], snapshots=[*frozen(BLUE, ANT), *pool[-2:], snapshot(None, 0, name="ant-idle")]
    )
    assert [s.name for s in reference_opponents(config, unlike, unlike.history("blue")[-1])] == [
        "ants@0"
    ]  # pusher is a rover
    assert [s.name for s in reference_opponents(config, unlike, unlike.history("ants")[-1])] == ["blue@0", "pusher"]


# Ladders by arena key


def test_each_key_has_a_ladder_of_its_own(tmp_path):
    log = [match("blue@4", "blue@0", 8, 0), match("blue@4", "blue@0", 0, 6, arena=WARP), match("red@4", "red@0", 4, 4)]
    with filled(tmp_path / "store", *log), league.open(str(tmp_path / "store")) as opened:
        assert opened.ladders() == [C, WARP]
        by = lambda frame: frame.set_index("name").vs_initial  # noqa: E731
        assert by(opened.ratings())["blue@4"] == 1
        assert by(opened.ratings(engine="warp"))["blue@4"] == 0
        assert (opened.ratings(engine="warp").engine == "warp").all()
        with pytest.raises(StorageError, match=r"under engine 'jax'; there are: sumo-2v2 under c, sumo-2v2 under warp"):
            opened.ratings(engine="jax")


def test_the_newest_key_comes_first_and_a_choice_takes_the_newest_that_fits(tmp_path):
    older = C._replace(config_hash="0ld")
    log = [match("blue@1", "blue@0", 1, 0, arena=key) for key in (older, C, WARP, C, WARP)]
    with filled(tmp_path / "store", *log) as store:
        keys = Open(store).ladders()
    assert keys == [WARP, C, older]
    assert choose(keys, engine="c") == C
    assert choose([], None, None) is None


def test_standing_reads_only_what_is_new_and_nothing_where_nothing_changed(tmp_path, monkeypatch):
    store = filled(tmp_path / "store", match("blue@4", "blue@0", 6, 2))
    first = LeagueState.of(store, "cup")
    assert first.ladder.score("blue@4", "blue@0").games == 8
    assert (first.newest and first.newest.iteration, first.arena, first.read) == (4, C, 1)
    monkeypatch.setattr(store, "snapshots", lambda *_: pytest.fail("read though nothing has changed"))
    assert LeagueState.of(store, "cup", first) is first
    monkeypatch.undo()
    asked = []
    log = store.log
    monkeypatch.setattr(store, "log", lambda *a, after=0: asked.append(after) or log(*a, after=after))
    finish(store, matches=[match("blue@4", "blue@0", 2, 0), match("blue@4", "blue@0", 9, 9, purpose="showing")])
    second = LeagueState.of(store, "cup", first)
    assert second.ladder.score("blue@4", "blue@0").games == 10
    assert asked == [1]
    store.close()


def test_a_standing_read_at_once_is_the_one_that_was_read_piece_by_piece(tmp_path):
    store, grown, seconds = filled(tmp_path / "store", match("blue@4", "blue@0", 6, 2)), None, 0.0
    for due in (None, 3.0, 3.0, 7.0, None):
        seconds += 0.25
        logged = [match(a, "red@0", 2, 4, seconds=seconds, due=due) for a in ("blue@4", "red@4")]
        finish(store, matches=[*logged, match("red@4", "red@0", 1, 1, due=50.0, purpose="exhibition")])
        grown = LeagueState.of(store, "cup", grown)
        once = LeagueState.of(store, "cup")
        assert (once.read, once.played, once.batches) == (grown.read, grown.played, grown.batches)
        for name in ("home", "away", "pairs", "voids", "last"):
            assert (getattr(once.ladder.payoff, name) == getattr(grown.ladder.payoff, name)).all()
    assert grown is not None
    assert grown.batches is not None
    assert grown.batches.due == 7.0
    assert grown.batches.seconds == 2 * 1.0
    store.close()


def test_standing_goes_over_to_the_ladder_of_the_newest_matches_or_of_the_one_asked_for(tmp_path):
    store = filled(tmp_path / "store", match("blue@4", "blue@0", 6, 2), match("red@1", "red@0", 1, 1, arena=WARP))
    both = LeagueState.of(store, "cup")
    assert (both.arena, both.ladder.payoff.games.sum() // 2) == (WARP, 2)
    back = LeagueState.of(store, "cup", both, arena=C)
    assert back.ladder.score("blue@4", "blue@0").games == 8
    finish(store, matches=[match("red@4", "red@0", 4, 0), match("red@4", "red@0", 2, 0, arena=WARP)])
    assert LeagueState.of(store, "cup", back, arena=C).ladder.payoff.games.sum() // 2 == 12
    # A key under which nothing was played yet has an empty ladder, and so everything is still to be rated.
    new = LeagueState.of(store, "cup", back, arena=C._replace(engine="jax"))
    assert new.ladder.names == both.ladder.names
    assert not new.ladder.payoff.games.any()
    store.close()


# What the commands print


@pytest.fixture
def printed(tmp_path, capsys, monkeypatch):
    """Run a table's command on a store with those matches: what it prints."""
    monkeypatch.setenv("COLUMNS", "80")

    def run(command, *args: str, log=(), points=()) -> str:
        place = tmp_path / "store"
        if not place.exists():
            with filled(place, *log) as store:
                finish(store, curves=points)
        assert command([*args, "--store", str(place)]) == 0
        return capsys.readouterr().out

    return run


def rated_log():
    even = [match(f"blue@{i}", f"red@{j}", 40, 40) for i in (0, 1) for j in (0, 1)]
    broken = match("red@1", "blue@0", 20, 20, voids=20, voids_a=10)
    return [*even, broken, match("blue@4", "red@4", 1, 0)]


def test_what_is_not_known_is_not_printed_as_a_number(printed):
    table = printed(ratings, log=rated_log())
    (line,) = [line for line in table.splitlines() if line.split()[1:2] == ["blue@4"]]
    assert line.split() == ["–", "blue@4", "–", "–", "1", "1*", "1.000", "–", "0"]
    assert "–: not yet known (an interval wider than 1000 Elo, or no game)." in " ".join(table.split())
    rows = {row["name"]: row for row in json.loads(printed(ratings, "--format", "json"))}
    assert (rows["blue@4"]["known"], rows["blue@0"]["known"]) == (False, True)
    assert rows["blue@4"]["high"] - rows["blue@4"]["low"] > 1000
    assert [r["name"] for r in rows.values()][-1] == "pusher"  # it has not played


def test_voids_are_shown_by_their_cause_and_flagged_above_the_setting(printed):
    table = printed(ratings, log=rated_log())
    cells = {line.split()[1]: line.split()[8:] for line in table.splitlines() if "@" in line}
    # Of red@1's 220 episodes 10 were its own doing and 10 of unclear cause; the setting is 5 %.
    assert cells["red@1"] == ["4.5", "+", "4.5?"]
    assert cells["blue@0"] == ["0.0", "+", "4.5"]
    assert "?: above" in " ".join(table.split())
    rows = json.loads(printed(ratings, "--format", "json"))
    assert {row["name"]: row["flagged"] for row in rows if row["flagged"]} == {"red@1": "?"}
    pool = [snapshot(BLUE, 0), snapshot(RED, 0)]
    worse = Ladder([], [match("blue@0", "red@0", 5, 5, voids=10, voids_b=9)])
    assert "45.0 + 5.0!" in ratings_table(worse, pool, [BLUE, RED], 0.02)


@pytest.mark.parametrize(
    ("won", "told"),
    [  # of 100 games on each side; the error of the logit is 1 / sqrt(200 · p · (1 - p))
        (80, "Playing the first side is worth +241 Elo (± 60): against an equal it scores 80.0 %, not 50."),
        (52, "Playing the first side is worth +14 Elo (± 48), so perhaps nothing."),
    ],
)
def test_what_the_first_side_is_worth_is_said_with_its_interval(won, told, printed):
    uneven = replace(match("blue@1", "red@1", 100, 100), side_wins=won, side_losses=100 - won)
    assert told in " ".join(printed(ratings, log=[uneven]).split())


def test_unlike_sides_have_a_table_each_and_are_told_against_each_other():
    ants = player("ants", 1, "ant:3:2+ant:3:2")
    lone = replace(BLUE, roster="rover:5:2")
    pool = [*frozen(lone, ants), snapshot(None, 0, name="idle", roster=ants.roster)]
    log = [match("blue@4", "ants@4", 30, 10), match("ants@0", "blue@4", 8, 32), match("blue@4", "idle", 20, 16, 4)]
    ladder = Ladder(Pool.of(pool, [ants, lone]), log)
    assert side_score(ladder, pool, ants.roster, lone.roster)[::3] == (36 / 120, 120)
    text = ratings_table(ladder, pool, [ants, lone])
    rover, ant = text.index("1 × rover:\n"), text.index("2 × ant:\n")
    assert rover < text.index("blue@4") < text.index("blue@0") < ant < min(map(text.index, ("ants@4", "idle")))
    said = " ".join(text.split())
    low, high = (f"{100 * float(end):.1f}" for end in score_interval(82, 4, 34))
    assert f"1 × rover against 2 × ant: 70.0 % ({low}-{high}) of 120 in all." in said
    assert "By these ratings blue@4 scores 7" in said
    assert "% against ants@4. Between what stands at 1000 on either side the arena leans to 1 × rover by " in said
    rows = {row["name"]: row for row in rating_rows(ladder, pool, [ants, lone])}
    assert (rows["ants@0"]["elo"], rows["ants@0"]["rank"], rows["blue@4"]["rank"]) == (1000, 2, 1)
    assert rows["blue@4"]["tilt"] > 0 > rows["idle"]["tilt"]
    alike = Ladder([s.name for s in frozen(BLUE, RED)], log[:0])
    assert "rover" not in ratings_table(alike, frozen(BLUE, RED), [BLUE, RED])


def test_other_ladders_are_named_with_the_way_to_see_them(printed):
    log = [
        match("blue@1", "blue@0", 6, 2), match("blue@1", "blue@0", 6, 2, arena=WARP),
        match("blue@1", "blue@0", 6, 2, arena=C._replace(arena="sumo-1v1")),
        match("blue@1", "blue@0", 4, 4, arena=C._replace(config_hash="abad1dea")),
    ]  # fmt: skip
    text = printed(ratings, log=log)
    assert "Elo with 95 % intervals in sumo-2v2 under c (rules abad1dea)" in text
    assert "sumo-1v1 under c (rules c0ffee00): league ratings --arena sumo-1v1\n" in text
    assert "sumo-2v2 under warp (rules c0ffee00): league ratings --engine warp\n" in text
    assert "sumo-2v2 under c (rules c0ffee00): older rules, --all" in text
    assert "in sumo-1v1 under c" in printed(ratings, "--arena", "sumo-1v1")
    everything = printed(ratings, "--all")
    assert everything.count("Elo with 95 %") == 4
    assert "Other ladders" not in everything
    assert len(json.loads(printed(ratings, "--all", "--format", "json"))) == 4 * 7


def test_a_league_without_matches_says_so(printed):
    assert "No rating match has been played yet." in printed(ratings)


def test_one_team_is_measured_by_its_success(printed):
    flag = C._replace(arena="flag")
    log = [match("blue@4", None, 15, 1, arena=flag), match("blue@0", None, 2, 6, arena=flag, voids=2)]
    text = printed(ratings, log=log)
    assert "Success with 95 % intervals in flag under c" in text
    lines = [line.split() for line in text.splitlines() if "@" in line]
    assert lines[0][:3] == ["1", "blue@4", "0.938"]
    assert lines[1][:3] == ["2", "blue@0", "0.250v"]  # 2 voids beside 8 games are too many
    assert "Elo" not in text
    low, high = score_interval(15, 0, 1)
    assert lines[0][3:5] == [f"{low:.3f}", f"{high:.3f}"]


def test_matches_shows_the_newest_and_says_how_to_see_more(printed):
    log = [match("blue@1", "blue@0", i, 0) for i in range(2, 72)]
    text = printed(tables.matches, log=log)
    numbers = [int(line.split()[0]) for line in text.splitlines() if "blue@1" in line]
    assert numbers == list(range(41, 71))
    assert "The newest 30 of 70; `league matches --store" in text
    assert "--last 120` shows more, --all everything." in " ".join(text.split())
    assert printed(tables.matches, "--last", "2").count("blue@1") == 2
    whole = printed(tables.matches, "--all")
    assert (whole.count("blue@1"), "newest" in whole) == (70, False)
    assert len(json.loads(printed(tables.matches, "--format", "json"))) == 70
    assert len(json.loads(printed(tables.matches, "--format", "json", "--last", "3"))) == 3


def test_a_league_without_matches_has_their_columns(printed, tmp_path):
    assert printed(tables.matches, "--format", "csv") == ",".join(query.MATCH_COLUMNS) + "\n"
    assert tuple(query.match_rows([match("blue@1", "blue@0", 3, 1)])[0]) == query.MATCH_COLUMNS
    with league.open(tmp_path / "store") as opened:
        assert tuple(opened.matches().columns) == tuple(opened.recordings().columns) == query.MATCH_COLUMNS


def test_curves_come_out_as_they_went_in(printed):
    points = [
        CurvePoint("cup", p, i, 10 * i, i / 8, {"score": 1 / i, "entropy": -0.5, "kl": i / 3})
        for p in ("blue", "red")
        for i in (1, 2, 3)
    ]
    rows = json.loads(printed(tables.curves, "--format", "json", points=points))
    assert len(rows) == 6
    assert rows[4] == {
        "player": "blue", "iteration": 3, "steps": 30, "seconds": 0.375, "score": 1 / 3, "entropy": -0.5, "kl": 1.0
    }  # fmt: skip
    newest = [line.split()[:2] for line in printed(tables.curves, "--last", "2").splitlines() if "10" not in line]
    assert ["blue", "3"] in newest
    assert ["red", "3"] in newest
    text = printed(tables.curves, "--player", "red")
    assert "red" in text
    assert "blue" not in text
    assert "kl" in printed(tables.curves, "--format", "csv").splitlines()[0].split(",")
    with pytest.raises(StorageError, match=r"no player 'rde' here; there is: blue, red. Did you mean 'red'"):
        printed(tables.curves, "--player", "rde")


def test_curves_show_the_metrics_that_are_asked_for(printed):
    """A metric may be missing in some iterations, as events are where no episode ended."""
    events = {"event.goal": 0.25}, {}, {"event.goal": 0.0}
    points = [CurvePoint("cup", "blue", i, 10 * i, i / 8, {"kl": i / 3, **own}) for i, own in enumerate(events, 1)]
    given = ("--metrics", "event.goal,kl,steps,kl")  # steps are shown anyway
    text = printed(tables.curves, *given, points=points)
    assert [line.split() for line in text.splitlines() if "blue" in line] == [
        ["blue", "1", "10", "0.2500", "0.3333"],
        ["blue", "2", "20", "–", "0.6667"],
        ["blue", "3", "30", "0.0000", "1.0000"],
    ]
    rows = json.loads(printed(tables.curves, *given, "--format", "json"))
    assert rows[1] == {"player": "blue", "iteration": 2, "steps": 20, "event.goal": None, "kl": 2 / 3}
    with pytest.raises(ConfigError, match=r"nobody recorded goal; there are event\.goal, kl, seconds"):
        printed(tables.curves, "--metrics", "goal")


def test_curves_are_a_data_frame_with_every_figure(tmp_path):
    points = [CurvePoint("cup", "blue", 1, 10, 0.5, {"score": 0.5}), CurvePoint("cup", "blue", 2, 20, 1.0, {"kl": 0.1})]
    with filled(tmp_path / "store") as store:
        finish(store, curves=points)
        frame = Open(store).curves("blue")
    assert frame.steps.tolist() == [10, 20]
    assert frame.score.isna().tolist() == [False, True]


def test_times_are_hours_minutes_and_seconds():
    assert [clock(s) for s in (0, 59.9, 60, 3599, 3600, 36_061)] == [
        "0:00",
        "0:59",
        "1:00",
        "59:59",
        "1:00:00",
        "10:01:01",
    ]


def test_a_summary_row_per_snapshot_even_where_nothing_was_played():
    pool = frozen(BLUE, RED)
    rows = rating_rows(Ladder([s.name for s in pool]), pool, [BLUE, RED])
    assert [row["elo"] for row in rows] == [None] * 6


def test_a_query_loads_neither_what_trains_nor_what_draws():
    heavy = ("jax", "torch", "mujoco", "pandas", "rerun", "agents", "arenas.arena", "arenas.games", "arenas.robots")
    program = (
        "import sys, league.commands.analyse.ratings, league.commands.analyse.tables, league.commands.run.status\n"
        "import league.state.league_state\n"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "[]\n"
