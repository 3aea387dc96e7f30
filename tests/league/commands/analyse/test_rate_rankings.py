"""`league rate --rankings`: ratings of events of any number of players."""

import json
import math

import pytest

from league.commands.cli import main
from matchmaking.ratings.fit import ELO

FRUITS = [
    "1,apple,1", "1,banana,2", "2,apple,4", "2,banana,1", "2,orange,2", "2,pear,3", "3,apple,4", "3,banana,1",
    "3,orange,1", "3,pear,1", "4,apple,1", "4,banana,2", "4,orange,3", "5,apple,2", "5,banana,1", "5,orange,1",
    "6,apple,1", "6,orange,3", "6,pear,2",
]  # fmt: skip


@pytest.fixture
def rate(rate_file):
    """Run the command on these rows: exit code, output, complaint."""

    def run(rows, *args, head="event,player,rank"):
        return rate_file(rows, "--rankings", "log.csv", *args, head=head)

    return run


def test_published_coefficients_come_out(rated):
    """Those of the manual of the R package PlackettLuce for these six rankings."""
    told = rated(FRUITS, "--prior", "0", "--anchor", "apple")
    fitted = ["ratings", "side_elo", "side_elo_stderr", "draw", "log_likelihood"]
    assert list(told) == [*fitted, "islands", "unbounded", "warnings", "ties"]
    found = {row["name"]: (row["elo"] / ELO, row["games"]) for row in told["ratings"]}
    published = {"banana": 0.2942875, "apple": 0.0, "pear": -0.1190960, "orange": -0.7335113}
    assert list(found) == list(published)
    assert {name: value for name, (value, _) in found.items()} == pytest.approx(published, abs=1e-6)
    assert {name: games for name, (_, games) in found.items()} == {"banana": 5, "apple": 6, "pear": 3, "orange": 5}
    assert {k: math.log(delta) for k, delta in told["ties"].items()} == pytest.approx(
        {"2": -1.8619467, "3": -0.7369735}, abs=1e-6
    )
    assert told["draw"] == pytest.approx(told["ties"]["2"])
    assert (told["side_elo"], told["side_elo_stderr"], told["islands"], told["warnings"]) == (None, None, 1, [])


def test_events_of_two_are_rated_as_a_log_of_games_without_sides(rated, tmp_path, capsys):
    games = [("a", "b", 5, 2, 3), ("b", "c", 4, 1, 4), ("c", "a", 2, 3, 3)]
    places = {0: (1, 2), 1: (1, 1), 2: (2, 1)}
    rows, number = [], 0
    for one, other, *counts in games:
        for outcome, count in enumerate(counts):
            for _ in range(count):
                rows += [f"{number},{one},{places[outcome][0]}", f"{number},{other},{places[outcome][1]}"]
                number += 1
    told = rated(rows)
    (tmp_path / "games.csv").write_text(
        "\n".join(["arena,side_a,side_b,wins_a,draws,wins_b", *(f"x,{','.join(map(str, game))}" for game in games)])
    )
    with pytest.raises(SystemExit):
        main(["rate", "games.csv", "--no-side", "--format", "json"])
    other = json.loads(capsys.readouterr().out)
    for row, twin in zip(told["ratings"], other["ratings"], strict=True):
        assert row == pytest.approx(twin, abs=1e-6)
    assert told["draw"] == pytest.approx(other["draw"])


def test_ranks_need_not_be_dense_and_rows_may_come_in_any_order(rated):
    dense = ["1,a,1", "1,b,2", "1,c,3", "2,b,1", "2,a,2", "3,c,1", "3,a,2", "3,b,2"]
    sparse = ["3, c ,-7", "1,c,30", "2,a,9.5", "1,a,10.25", "3,b,1e3", "2,b,1", "3,a,1000", "1,b,20"]
    assert rated(dense) == rated(sparse)
    quoted = [*dense[:-1], '3,"b",2']  # read row by row
    assert rated(dense) == rated(quoted)
    assert rated(dense) == rated([row.replace(",", ";") for row in dense], head="event;player;rank")
    other = rated([f"x,{row}" for row in dense], head="note,event,player,rank")
    assert rated(dense) == other


def test_a_table_for_people(rate):
    code, out, err = rate(FRUITS)
    assert (code, err) == (0, "")
    assert "Elo with 95 % intervals\n" in out
    assert "side" not in out
    assert "Between equals 7.2 % of the rankings of two are ties" in out
    code, out, err = rate(FRUITS, "--format", "csv")
    assert out.startswith("name,elo,elo_stderr,low,high,games,island,unbounded\nbanana,")


def test_what_the_rankings_do_not_bound_is_said(rated, rate):
    told = rated(["1,a,1", "1,b,2", "1,c,3", "2,b,1", "2,a,2", "2,c,3", "x,y,1", "x,z,2", "w,z,1", "w,y,2"])
    assert told["islands"] == 2
    assert {row["name"]: row["unbounded"] for row in told["ratings"]} == {
        "a": None, "b": None, "c": "below", "y": None, "z": None,
    }  # fmt: skip
    assert len(told["warnings"]) == 3
    told = rated(["1,a,1", "1,b,1", "1,c,1"])
    assert (told["draw"], told["unbounded"]["draw"], "ties" in told) == (None, "above", False)
    assert "every game was drawn" in told["warnings"][0]
    code, _, err = rate(["1,a,1", "1,b,2", "1,c,3"], "--prior", "0")
    assert code == 2
    assert err.strip() == (
        "league: log.csv: 'a' is undefeated: it has won every game; that has no finite rating without a prior: give"
        " --prior above 0"
    )


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        (["1,a,1", "1,b,second"], "log.csv:3: rank is 'second': it must be a number, 1 for the best"),
        (["1,a,1", "1,b,nan"], "log.csv:3: rank is 'nan': it must be a number, 1 for the best"),
        (["1,a,1", "1,b,"], "log.csv:3: rank is '': it must be a number, 1 for the best; who has no rank has no row"),
        (["1,a,1", "1,b,2", "2,c,1"], "log.csv: event '2' has one player: a ranking needs two or more"),
        (["1,a,1", "1,b,2", "1,a,3"], "log.csv:4: 'a' is in event '1' twice"),
        (["1,a,1", "1,,2"], "log.csv:3: player is empty: it must be a name"),
        (["1,a,1", ",b,2"], "log.csv:3: event is empty: it must be a name"),
        (["1,a,1", "1,b"], "log.csv:3: 2 fields where the first line names 3 columns"),
        ([], "log.csv has no event in it: a row is event,player,rank"),
        ([f"1,p{i},{i}" for i in range(501)], "event '1' has 501 players: at most 500 can be rated together"),
        ([f"1,p{i},1" for i in range(21)], "in event '1' 21 players share a rank: at most 20 can"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line(rate, rows, problem):
    code, out, err = rate(rows)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert problem in err


@pytest.mark.parametrize(
    ("head", "problem"),
    [
        ("event,player", "log.csv:1: there is no column rank: the first line names the columns event,player,rank"),
        ("event,player,rang", "there is no column rank (is it 'rang'?)"),
        ("arena,side_a,side_b,wins_a,draws,wins_b", "the columns are those of a match log: give the file without"),
        ("event,event,player,rank", "log.csv:1: there are 2 columns event"),
        ("", "log.csv is empty: its first line names the columns event,player,rank"),
    ],
)
def test_a_wrong_first_line_is_named(rate, head, problem):
    code, _, err = rate([], head=head)
    assert code == 2
    assert problem in err


@pytest.mark.parametrize(
    ("args", "problem"),
    [
        (["--no-side"], "--no-side is for league rate FILE.csv without --rankings"),
        (["--arena", "x"], "--arena is for league rate FILE.csv without --rankings"),
        (["log.csv"], "two are given"),
        (["--store", "s"], "two are given"),
        (["--anchor", "nobody"], "there is no player 'nobody' in log.csv"),
    ],
)
def test_options_that_do_not_fit_are_refused(rate, args, problem):
    code, out, err = rate(FRUITS, *args)
    assert (code, out) == (2, "")
    assert problem in err
