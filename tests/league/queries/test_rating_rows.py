"""`league ratings` and what `league.open(...).ratings()` gives: columns, choices, times past, formats, the ticker."""

import datetime as dt
import io
import json
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pytest
import sqlalchemy as sa

import league
from league.commands.cli import main
from league.commands.ladder_text import ratings_table
from league.config.schema import ConfigError
from league.queries.ratings.rating_rows import moment, rating_rows, when
from matchmaking.ratings.payoff import sum_matches
from storage.database import schema
from storage.errors import StorageError, UnknownName
from storage.store import Store
from tests.league.leagues import WARP, filled, match

NOON = datetime(2026, 11, 20, 12, tzinfo=UTC).timestamp()
DAY = 86_400
LOG = (
    match("blue@1", "blue@0", 30, 10, voids=4, voids_a=1),
    match("red@1", "red@0", 24, 16),
    match("blue@1", "red@1", 20, 16, 4),
    match("blue@4", "blue@0", 38, 2),
    match("pusher", "blue@4", 20, 20),
)


def date(store: Store, table: sa.Table, seconds: float, *where) -> None:
    with store._db.writing() as db:
        db.execute(sa.update(table).where(*where).values(created=seconds))


@pytest.fixture
def place(tmp_path):
    """A store with a match at noon of each day from 20 November on; blue@4 was frozen in the night to the 23rd."""
    with filled(tmp_path / "store", *LOG) as store:
        for i in range(len(LOG)):
            date(store, schema.matches, NOON + i * DAY, schema.matches.c.id == i + 1)
        date(store, schema.snapshots, NOON - DAY)
        date(store, schema.snapshots, NOON + 2.5 * DAY, schema.snapshots.c.name == "blue@4")
    return str(tmp_path / "store")


@pytest.fixture
def ran(place, capsys, monkeypatch):
    """Run `league ratings`: exit code, what it printed, what it complained of."""
    monkeypatch.setenv("COLUMNS", "160")

    def run(*args):
        with pytest.raises(SystemExit) as left:
            main(["ratings", "--store", place, *args])
        return left.value.code, *capsys.readouterr()

    return run


@pytest.fixture
def rows(ran):
    def run(*args):
        code, out, err = ran(*args, "--format", "json")
        assert (code, err) == (0, "")
        return json.loads(out)

    return run


def test_a_row_has_all_that_is_asked_of_a_snapshot(rows):
    found = {row["name"]: row for row in rows()}
    blue = found["blue@1"]
    counts = ("games", "wins", "draws", "losses", "voids", "win_rate")
    assert [blue[key] for key in counts] == [80, 50, 4, 26, 4, 52 / 80]
    assert [blue[key] for key in ("player", "role", "vs_initial", "iteration")] == ["blue", "main", 0.75, 1]
    assert blue["vs_initial_low"] < 0.75 < blue["vs_initial_high"]
    assert blue["last_played"] == "2026-11-22T12:00:00Z"
    assert blue["low"] < blue["elo"] < blue["high"]
    assert [found["pusher"][key] for key in ("player", "role", "win_rate", "vs_initial")] == [None, "fixed", 0.5, None]
    assert [found["red@4"][key] for key in ("rank", "elo", "games", "win_rate", "last_played")] == [
        None,
        None,
        0,
        None,
        None,
    ]


def test_ranks_count_those_that_are_known_best_first(rows):
    found = rows()
    ranked = [row for row in found if row["rank"] is not None]
    assert [row["rank"] for row in ranked] == list(range(1, 7))
    assert ranked == sorted(ranked, key=lambda row: -row["low"])
    assert [row["name"] for row in found if row["rank"] is None] == ["red@4"]


def test_few_games_do_not_put_a_snapshot_first_and_few_opponents_are_marked(ran, tmp_path, monkeypatch):
    """The case of a quick start: rank 1 was blue@128, ±303, from 128 games against one opponent."""
    settled = [
        match("blue@1", "red@1", 300, 100),
        match("blue@1", "red@0", 360, 40),
        match("blue@1", "blue@0", 360, 40),
    ]
    with filled(tmp_path / "few", *settled, match("blue@4", "blue@0", 30, 2)):
        pass
    _, out, _ = ran("--store", str(tmp_path / "few"), "--format", "json")
    found = {row["name"]: row for row in json.loads(out)}
    lucky, sure = found["blue@4"], found["blue@1"]
    assert lucky["known"]
    assert lucky["elo"] > sure["elo"]
    assert (sure["rank"], lucky["rank"]) == (1, 2)
    assert [(each["opponents"], each["provisional"]) for each in (sure, lucky)] == [(3, False), (1, True)]
    _, out, _ = ran("--store", str(tmp_path / "few"))
    lines = {line.split()[1]: line.split() for line in out.splitlines() if "@" in line}
    assert [lines[name][5] for name in ("blue@1", "blue@4")] == ["3", "1*"]
    said = " ".join(out.split())
    assert "Ranks go by the lower end of the interval (elo less ±)" in said
    assert "*: provisional, fewer than 3" in said


def test_python_gives_the_same_columns(rows, place):
    with league.open(place) as opened:
        frame = opened.ratings()
        # No game connects red with blue yet. red@1 has won more, but the lower end of its interval is below the anchor.
        assert opened.ratings(team="red", role="main", as_of="2026-11-21").name.tolist() == ["red@0", "red@1", "red@4"]
        with pytest.raises(ValueError, match="must be a date such as"):
            opened.ratings(as_of="yesterday")
        with pytest.raises(UnknownName, match="no role 'boss'"):
            opened.ratings(role="boss")
    assert frame.columns.tolist() == list(rows()[0])
    assert frame.name.tolist() == [row["name"] for row in rows()]


def test_a_team_is_asked_for_by_name_or_number_and_keeps_its_ranks(rows):
    everyone = {row["name"]: row["rank"] for row in rows()}
    blue = rows("--team", "blue")
    assert {row["name"] for row in blue} == {"blue@0", "blue@1", "blue@4", "pusher"}  # scripts fit any rover's team
    assert all(row["rank"] == everyone[row["name"]] for row in blue)
    assert rows("--team", "0") == blue
    assert {row["name"] for row in rows("--team", "1", "--role", "main")} == {"red@0", "red@1", "red@4"}
    assert [row["name"] for row in rows("--role", "fixed")] == ["pusher"]


def test_as_of_a_time_later_games_and_snapshots_are_not_there(rows):
    early = {row["name"]: row for row in rows("--as-of", "2026-11-20")}
    assert sum(row["games"] for row in early.values()) == 2 * 40
    assert "blue@4" not in early
    assert {row["name"]: row["games"] for row in rows("--as-of", "2026-11-22T11:59")}["blue@1"] == 40
    assert {row["name"]: row["games"] for row in rows("--as-of", "2026-11-22T12:00")}["blue@1"] == 80
    assert rows("--as-of", "2030-01-01") == rows()


def test_python_takes_dates_and_refuses_what_is_none_in_one_line(place):
    with league.open(place) as opened:
        early = opened.ratings(as_of="2026-11-20")
        assert early.games.sum() == 2 * 40
        assert early.equals(opened.ratings(as_of=dt.date(2026, 11, 20)))
        assert early.equals(opened.ratings(as_of=datetime(2026, 11, 20, 23, tzinfo=UTC)))
        for wrong in (5, "2026-13-01"):
            with pytest.raises(ConfigError, match=f"^as_of = {wrong!r}: must be a date such as 2026-11-22"):
                opened.ratings(as_of=wrong)


def test_before_its_first_snapshot_a_league_has_no_ratings_and_says_since_when_it_has(place):
    with league.open(place) as opened, pytest.raises(StorageError, match=r"no snapshot yet at 2020-01-01T23:59:59Z"):
        opened.ratings(as_of="2020-01-01")


def test_times_are_told_in_utc():
    assert when(NOON) == "2026-11-20T12:00:00Z"
    assert when(0) is None
    assert moment("2026-11-20") == pytest.approx(NOON + DAY / 2, abs=0.01)
    assert moment("2026-11-20T13:00+01:00") == moment("2026-11-20T12:00") == pytest.approx(NOON + 1, abs=0.01)


def test_parquet_holds_the_same_rows(place, rows):
    command = [sys.executable, "-m", "league", "ratings", "--store", place, "--format", "parquet"]
    frame = pd.read_parquet(io.BytesIO(subprocess.run(command, capture_output=True, check=True, timeout=60).stdout))
    assert frame.columns.tolist() == list(rows()[0])
    assert frame.set_index("name").elo.dropna().to_dict() == {
        r["name"]: r["elo"] for r in rows() if r["elo"] is not None
    }


def test_without_pyarrow_one_line_says_what_to_install(ran, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    code, out, err = ran("--format", "parquet")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "pip install 'robot-league[parquet]'" in err


def test_the_ticker_is_labelled_as_such(ran, rows):
    _, out, _ = ran("--ticker")
    assert "Online Elo ticker in sumo-2v2 under c" in out
    assert "depends on the order of the games and has no interval" in " ".join(out.split())
    assert "Ranks go by the lower end" not in out
    found = rows("--ticker")
    played = [row["ticker"] for row in found if row["ticker"] is not None]
    assert played == sorted(played, reverse=True)
    assert [row["name"] for row in found if row["ticker"] is None] == ["red@4"]
    late, early = (
        {row["name"]: row["ticker"] for row in each} for each in (found, rows("--ticker", "--as-of", "2026-11-20"))
    )
    assert (early["red@1"], late["red@1"]) == (None, pytest.approx(late["red@1"]))


def test_the_table_shows_counts_and_when_all_was_played_where_there_is_room(ran):
    _, out, _ = ran()
    (line,) = [line for line in out.splitlines() if " blue@1 " in line]
    assert line.split()[1] == "blue@1"
    assert "50-4-26" in line
    assert line.split()[-4:] == ["main", "blue", "2026-11-22", "12:00"]


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--team", "bleu"), "There is no team 'bleu' here; there is: 0, 1, blue, red. Did you mean 'blue'?"),
        (("--role", "boss"), "There is no role 'boss' here; there is: fixed, main."),
        (("--as-of", "soon"), '--as-of = "soon": must be a date such as 2026-11-22'),
        (("--format", "xlsx"), "parquet"),
        (("--arena", "pit"), "No rating match was played in arena 'pit'"),
    ],
)
def test_what_there_is_not_is_told_in_one_line(ran, args, says):
    code, out, err = ran(*args)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err


def test_the_table_needs_nothing_heavy(place):
    heavy = ("jax", "torch", "mujoco", "pandas", "scipy", "pyarrow", "rich")
    program = (
        f"import sys; from league.commands.analyse.ratings import ratings; ratings(['--store', {place!r}])\n"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_database_sums_a_log_as_the_tally_does(tmp_path):
    with filled(tmp_path / "store", *LOG, *LOG, match("blue@1", "red@1", 2, 0, arena=WARP)) as store:
        totals = store.totals("cup", "rating")
        assert [key.engine for key in totals] == ["warp", "c"]
        c = totals[next(key for key in totals if key.engine == "c")]
        assert len(c.a) == len(LOG)
        assert c.newest == 2 * len(LOG)
        assert store.totals("cup", ("gate", "exhibition")) == {}
        whole = sum_matches([m for m in store.matches("cup", "rating") if m.arena == c.arena])
        summed = sum_matches(c)
    for name in ("names", "first", "second", "home", "away", "pairs", "voids", "at_fault", "trials", "last", "arena"):
        assert np.array_equal(getattr(whole, name), getattr(summed, name)), name


def test_snapshots_on_islands_have_ranks_of_their_own(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    log = [match("blue@1", "blue@0", 60, 40), match("blue@4", "blue@0", 70, 30), match("red@1", "red@0", 60, 40)]
    filled(tmp_path / "apart", *log).close()
    with league.open(tmp_path / "apart") as opened:
        shown = opened.shown()
    rows = {row["name"]: row for row in rating_rows(shown.ladders[0], shown.snapshots, shown.players)}
    found = {name: (row["island"], row["rank"], row["unbounded"]) for name, row in rows.items() if row["games"]}
    assert found == {
        "blue@4": (1, 1, None), "blue@1": (1, 2, None), "blue@0": (1, 3, None),
        "red@1": (2, 1, None), "red@0": (2, 2, None),
    }  # fmt: skip
    assert rows["red@4"]["island"] is None
    text = ratings_table(shown.ladders[0], shown.snapshots, shown.players)
    assert "No game connects 2 islands of players (of 3, 2 players)" in " ".join(text.split())
    (line,) = [line for line in text.splitlines() if " red@1 " in line]
    assert line.split()[:3] == ["1", "2", "red@1"]


def test_what_the_games_of_a_ladder_do_not_bound_is_said(tmp_path):
    sided = [match(a, b, 20, 0) for a, b in (("blue@1", "blue@0"), ("blue@0", "blue@1"), ("blue@4", "blue@1"))]
    sided = [replace(m, wins=20, losses=0, side_wins=20, side_losses=0) for m in sided]
    filled(tmp_path / "sided", *sided).close()
    even = [match("blue@1", "blue@0", 60, 40), match("blue@4", "blue@0", 50, 50), match("pusher", "blue@4", 40, 0)]
    filled(tmp_path / "beaten", *even).close()
    texts = []
    for name in ("sided", "beaten"):
        with league.open(tmp_path / name) as opened:
            shown = opened.shown()
        texts.append(" ".join(ratings_table(shown.ladders[0], shown.snapshots, shown.players).split()))
        rows = {row["name"]: row for row in rating_rows(shown.ladders[0], shown.snapshots, shown.players)}
    assert "What the first side is worth has no finite value: the first side lost none of 60 games." in texts[0]
    assert "Playing the first side is worth" not in texts[0]
    assert rows["pusher"]["unbounded"] == "above"
    assert not rows["pusher"]["known"]  # the prior leaves it an interval too wide to be shown
    assert "by the games alone" not in texts[1]
