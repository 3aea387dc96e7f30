"""`league rate`: ratings of results that were played elsewhere."""

import csv
import io
import json
import math
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest

from league.commands.cli import main
from matchmaking.ratings.fit import ELO

HEAD = "arena,side_a,side_b,wins_a,draws,wins_b"
WIKIPEDIA = ["x,A,B,2,0,3", "x,A,D,1,0,4", "x,B,C,5,0,3", "x,C,D,1,0,3"]


@pytest.fixture
def rate(rate_file):
    """Run the command on these rows: exit code, output, complaint."""

    def run(rows, *args, head=HEAD):
        return rate_file(rows, "log.csv", *args, head=head)

    return run


def elo(told):
    return {row["name"]: row["elo"] for row in told["ratings"]}


def test_the_page_has_the_figures_of_its_own_log(rated):
    page = (Path(__file__).parents[4] / "docs/ratings.md").read_text().partition("## `league rate`")[2]
    head, *rows = page.split("```")[1].strip().splitlines()
    told = rated(rows, head=head)
    first = told["ratings"][0]
    assert first["name"] == "anna"
    for key, figure in re.findall(r'"(\w+)": (-?\d+\.\d+)', page.split("```json")[1].split("```")[0]):
        exact = first[key] if key in first else told[key]
        assert f"{exact:.{len(figure.partition('.')[2])}f}" == figure, key


def test_the_example_of_an_encyclopaedia_in_full(rated):
    told = rated(WIKIPEDIA, "--prior", "0", "--no-side")
    fit = ["ratings", "side_elo", "side_elo_stderr", "draw", "log_likelihood"]
    assert list(told) == [*fit, "islands", "unbounded", "warnings"]
    assert told["unbounded"] == {"side": None, "draw": None, "ratings": {}}
    assert (told["islands"], told["warnings"]) == (1, [])
    columns = ["name", "elo", "elo_stderr", "low", "high", "games", "island", "unbounded"]
    assert [list(row) for row in told["ratings"]] == [columns] * 4
    assert [row["name"] for row in told["ratings"]] == ["D", "B", "C", "A"]
    assert [row["games"] for row in told["ratings"]] == [9, 13, 12, 10]
    p = {name: math.exp(value / ELO) for name, value in elo(told).items()}
    assert p["B"] / p["A"] == pytest.approx(1.043 / 0.640, rel=2e-3)
    assert p["D"] / p["C"] == pytest.approx(2.270 / 0.660, rel=2e-3)
    assert sum(elo(told).values()) == pytest.approx(0, abs=1e-9)
    assert (told["side_elo"], told["side_elo_stderr"], told["draw"]) == (None, None, None)


def test_the_anchor_is_zero_and_errors_are_of_the_difference_to_it(rated):
    told = rated(["x,a,b,30,0,10"], "--anchor", "b", "--prior", "0")
    a, b = told["ratings"]
    assert (b["elo"], b["elo_stderr"], b["low"], b["high"]) == (0, 0, 0, 0)
    assert a["elo"] == pytest.approx(400 * math.log10(3))
    assert a["elo_stderr"] == pytest.approx(ELO / math.sqrt(7.5))
    assert a["high"] - a["elo"] == pytest.approx(1.959964 * a["elo_stderr"], rel=1e-6)
    assert told["side_elo"] is None  # sides never changed


def test_davidsons_draws_and_the_side(rate, rated):
    told = rated(["x,a,b,40,20,10", "x,b,a,10,20,40"], "--prior", "0")
    assert "Side A is worth +0 Elo" in rate(["x,a,b,40,20,10", "x,b,a,10,20,40"], "--prior", "0")[1]
    assert elo(told)["a"] - elo(told)["b"] == pytest.approx(400 * math.log10(4))
    assert told["draw"] == pytest.approx(1)
    assert told["side_elo"] == pytest.approx(0, abs=1e-9)
    uneven = rated(["x,a,b,80,0,10", "x,b,a,30,0,60"], "--prior", "0")
    assert uneven["side_elo"] == pytest.approx(400 * math.log10(2))
    assert uneven["side_elo_stderr"] == pytest.approx(ELO / 2 * math.sqrt(1 / 80 + 1 / 10 + 1 / 60 + 1 / 30))
    assert rated(["x,a,b,80,0,10", "x,b,a,30,0,60"], "--no-side")["side_elo"] is None


def test_the_prior_is_virtual_draws_with_the_average(rated):
    # Two who won all and lost all: a's score with 4 draws at ½ is (10 + 2)/14 on its own log odds d/2 to the average.
    gap = elo(rated(["x,a,b,10,0,0"]))
    d = (gap["a"] - gap["b"]) / ELO
    pulled = 10 / (1 + math.exp(d))  # what the games still ask for
    assert pulled == pytest.approx(4 * (1 / (1 + math.exp(-d / 2)) - 0.5), rel=1e-6)
    more = elo(rated(["x,a,b,10,0,0"], "--prior", "40"))
    assert 0 < more["a"] - more["b"] < gap["a"] - gap["b"]


def test_rock_paper_scissors_is_level(rated):
    rows = ["x,rock,shears,9,1,0", "x,shears,paper,9,1,0", "x,paper,rock,9,1,0"]
    for prior in ("4", "0"):
        assert list(elo(rated([*rows, *swapped(rows)], "--prior", prior)).values()) == pytest.approx([0] * 3, abs=1e-9)


def swapped(rows):
    return [",".join((x, b, a, losses, draws, wins)) for x, a, b, wins, draws, losses in (r.split(",") for r in rows)]


def test_neither_order_nor_splitting_matters(rated):
    rng = random.Random(0)
    rows = [("x", *rng.sample("abcdef", 2), *(rng.randint(0, 9) for _ in range(3))) for _ in range(60)]
    games = [
        ("x", a, b, *(int(k == i) for i in range(3)))
        for _, a, b, *counts in rows for k, n in enumerate(counts) for _ in range(n)
    ]  # fmt: skip
    rng.shuffle(games)
    one, other = (rated([",".join(map(str, row)) for row in log]) for log in (rows, games))
    for row in one["ratings"]:
        (same,) = [each for each in other["ratings"] if each["name"] == row["name"]]
        assert [same[key] for key in list(row)[1:]] == pytest.approx(list(row.values())[1:], abs=1e-9)
    assert other["side_elo"] == pytest.approx(one["side_elo"], abs=1e-9)


def seed_pairs(fates):
    """Games of seed pairs between a and b, a first on either side: "ww" for two that a won."""
    result = {"w": (1, 0, 0), "l": (0, 0, 1)}
    for number, (first, second) in enumerate(fates):
        yield ",".join(map(str, ("x", "a", "b", *result[first], number)))
        yield ",".join(map(str, ("x", "b", "a", *result[second][::-1], number)))


def test_games_of_a_seed_pair_count_as_one_in_the_intervals(rated):
    def error(fates, head=f"{HEAD},seed_pair"):
        told = rated(list(seed_pairs(fates)), "--prior", "0", "--anchor", "b", head=head)
        return told["ratings"][0]["elo_stderr"] or told["ratings"][1]["elo_stderr"]

    mixed = ["ww"] * 100 + ["wl"] * 100 + ["lw"] * 100 + ["ll"] * 100
    ignored = f"{HEAD},number"
    assert error(mixed) == pytest.approx(error(mixed, ignored), rel=0.02)  # as independent games
    one_fate = ["ww"] * 200 + ["ll"] * 200
    assert error(one_fate) == pytest.approx(math.sqrt(2) * error(one_fate, ignored), rel=0.01)


def test_a_seed_pair_may_be_of_any_size_and_belongs_to_two_players(rated):
    def error(rows):
        told = rated(rows, "--prior", "0", "--anchor", "b", head=f"{HEAD},seed_pair")
        return next(row["elo_stderr"] for row in told["ratings"] if row["name"] == "a")

    # Blocks of eight games that all end alike say as much as one game each.
    blocks = [f"x,a,b,{8 * (i % 2)},0,{8 * (1 - i % 2)},{i}" for i in range(200)]
    assert error(blocks) == pytest.approx(
        math.sqrt(8) * error([row.rpartition(",")[0] + "," for row in blocks]), rel=0.01
    )
    # The same word between others is another pair; one game alone is none.
    lone = [f"x,a,{name},{i % 2},0,{(i + 1) % 2},{i}" for i in range(100) for name in "bc"]
    assert error(lone) == pytest.approx(error([row.rpartition(",")[0] + "," for row in lone]))


def test_several_arenas_are_rated_one_at_a_time(rate, rated):
    rows = ["pit,a,b,3,0,1", "ring,a,b,1,0,3"]
    assert elo(rated(rows, "--arena", "pit"))["a"] > 0 > elo(rated(rows, "--arena", "ring"))["a"]
    code, out, err = rate(rows)
    assert (code, out) == (2, "")
    assert "results of 2 arenas, whose ratings are not comparable: choose one with --arena: pit, ring" in err


def test_tables_and_csv_say_the_same(rate, rated):
    told = rated(WIKIPEDIA)["ratings"]
    _, out, _ = rate(WIKIPEDIA, "--format", "csv")
    assert [{key: v if key == "name" else float(v) if v else None for key, v in row.items()} for row in csv.DictReader(
        io.StringIO(out))] == told  # fmt: skip
    _, table, _ = rate(WIKIPEDIA)
    lines = [line.split() for line in table.splitlines() if line.startswith(tuple(f" {name} " for name in "ABCD"))]
    assert [(line[0], int(line[-1])) for line in lines] == [(row["name"], row["games"]) for row in told]
    assert "Every player has 4 virtual draws" in table
    _, table, _ = rate(["x,a,b,1,1,1", "x,b,a,1,2,1"], "--anchor", "a")
    assert "a is 0" in table
    assert "Side A is worth +0 Elo" in table
    assert "of the games are drawn" in table


@pytest.mark.parametrize(
    ("rows", "args", "says"),
    [
        (["x,a,b,3,0,0"], ["--prior", "0"], "'a' is undefeated: it has won every game"),
        (["x,a,b,1,0,1", "x,c,d,1,0,1"], ["--prior", "0"], "'c' is disconnected from 'a'"),
        (["x,a,b,1,0,1"], ["--anchor", "bb"], "there is no player 'bb' in log.csv: did you mean 'b'?"),
        (["x,a,b,1,0,1"], ["--prior", "-1"], "--prior = -1"),
        (["x,a,b,1,0,1"], ["--prior", "nan"], "--prior = nan: must be finite"),
        (["x,a,b,1,0,1"], ["--arena", "y"], "there is no arena 'y' in log.csv; there is: x"),
        (["x,a,b,1,0,1", "x,a,b,1,-1,1"], [], "log.csv:3: draws is '-1': a count is a whole number, 0 or more"),
        (["x,a,b,1,0,0.5"], [], "log.csv:2: wins_b is '0.5'"),
        (["x,a,b,NaN,0,1"], [], "log.csv:2: wins_a is 'NaN'"),
        (["x,a,b,1,0,9999999999999"], [], "log.csv:2: wins_b is 9999999999999: a row has at most"),
        (["x,a,b,1,0,1", "", "x,b,b,1,0,1"], [], "log.csv:4: 'b' plays against itself"),
        (["x,,b,1,0,1"], [], "log.csv:2: side_a is empty"),
        (["x,a,b,1,0"], [], "log.csv:2: 5 fields where the first line names 6 columns"),
        (['x,"a,b,1,0,1'], [], "log.csv:2: unexpected end of data"),
        (["x,a,b,0,0,0"], [], "log.csv has no game in it"),
        ([], [], "log.csv has no game in it"),
    ],
)
def test_bad_input_is_one_line(rate, rows, args, says):
    code, out, err = rate(rows, *args)
    assert (code, out) == (2, "")
    assert says in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("head", "says"),
    [
        ("arena,side_a,side_b,wins,draws,wins_b", "log.csv:1: there is no column wins_a (is it 'wins'?)"),
        (f"{HEAD},draws", "log.csv:1: there are 2 columns draws"),
        ("", "log.csv is empty"),
        ("event,player,rank", "log.csv:1: the columns are those of rankings: give the file after --rankings"),
    ],
)
def test_columns_are_looked_at_first(rate, head, says):
    code, out, err = rate(["x,a,b,1,0,1"], head=head)
    assert (code, out) == (2, "")
    assert says in err


def test_standard_input_is_read_without_anything_heavy(tmp_path):
    text = "\n".join(["\ufeff" + HEAD, *WIKIPEDIA])
    heavy = "('jax', 'torch', 'mujoco', 'pandas', 'scipy')"
    code = (
        "import sys; from league.commands.analyse.rate import rate; rate(['-', '--format', 'csv']);"
        f" assert not set({heavy}) & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], input=text, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert [line.split(",")[0] for line in done.stdout.splitlines()] == ["name", "D", "B", "A", "C"]
    missing = subprocess.run(
        [sys.executable, "-m", "league", "rate", str(tmp_path / "none.csv")], capture_output=True, text=True, timeout=60
    )
    assert (missing.returncode, "none.csv: No such file" in missing.stderr) == (2, True)


WINNER_FIRST = ["x,a,b,3,0,0", "x,b,a,2,0,0", "x,b,c,3,0,0", "x,c,b,1,0,0", "x,c,a,1,0,0"]


def test_a_log_whose_first_column_is_the_winner_is_not_rated_as_if_it_told_of_sides(rate, rated):
    told = rated(WINNER_FIRST)
    assert [(row["elo"], row["low"], row["unbounded"]) for row in told["ratings"]] == [(None, None, "both")] * 3
    assert (told["side_elo"], told["side_elo_stderr"]) == (None, None)
    assert told["unbounded"]["side"] == "above"
    assert "side A lost none of 10 games" in told["warnings"][0]
    code, table, _ = rate(WINNER_FIRST)
    text = " ".join(table.split())
    assert "Only the prior (--prior 4) bounds it, so it is not shown. If the log names the winner first" in text
    assert "use --no-side" in text
    assert (code, "Side A is worth" in text) == (0, False)
    plain = rated(WINNER_FIRST, "--no-side")
    assert (plain["warnings"], plain["unbounded"]["side"]) == ([], None)
    assert elo(plain)["b"] > elo(plain)["c"]
    _, out, err = rate(WINNER_FIRST, "--format", "csv")
    assert "side A lost none of 10 games" in err
    assert [row["elo"] for row in csv.DictReader(io.StringIO(out))] == [""] * 3
    code, _, err = rate(WINNER_FIRST, "--prior", "0")
    assert (code, "use --no-side if the log names the winner first" in err) == (2, True)


def test_a_chance_of_draws_without_end_is_not_printed(rate, rated):
    log = ["x,a,b,3,2,0", "x,b,a,2,3,0", "x,b,c,3,1,0", "x,c,b,1,1,0"]
    told = rated(log)
    assert (told["draw"], told["unbounded"]["draw"], told["unbounded"]["side"]) == (None, "above", "above")
    assert None not in elo(told).values()
    _, table, _ = rate(log)
    text = " ".join(table.split())
    assert "The chance of a draw has no finite value" in text
    assert "Without a side advantage it has one" in text
    assert "of the games are drawn (Davidson" not in text
    _, table, _ = rate(["x,a,b,0,3,0", "x,b,a,0,2,0"])
    assert "every game was drawn" in " ".join(table.split())


def test_who_is_undefeated_is_named_with_what_bounds_the_rating(rate, rated):
    even = [row for a, b in ("ab", "bc", "ca") for row in (f"x,{a},{b},2,0,2", f"x,{b},{a},2,0,2")]
    told = rated([*even, "x,top,a,3,0,0"])
    assert told["unbounded"] == {"side": None, "draw": None, "ratings": {"top": "above"}}
    assert elo(told)["top"] > 0
    assert "top." in told["warnings"][0]
    assert "Only the prior (--prior 4) keeps these ratings finite" in told["warnings"][1]


def test_players_on_islands_are_rated_each_by_itself(rate, rated):
    log = ["x,p1,p2,75,0,25", "x,p2,p1,25,0,75", "x,p3,p4,90,0,10", "x,p4,p3,10,0,90", "x,p4,p5,12,0,6"]
    told = rated(log, "--prior", "0.001")
    assert [(row["name"], row["island"]) for row in told["ratings"]] == [
        ("p3", 1), ("p4", 1), ("p5", 1), ("p1", 2), ("p2", 2)
    ]  # fmt: skip
    assert told["islands"] == 2
    found = {row["name"]: row for row in told["ratings"]}
    assert found["p1"]["elo"] - found["p2"]["elo"] == pytest.approx(400 * math.log10(3), abs=0.1)
    assert found["p1"]["elo"] + found["p2"]["elo"] == pytest.approx(0, abs=1e-6)
    alone = {row["name"]: row for row in rated(log[:2], "--prior", "0.001")["ratings"]}
    assert found["p1"]["elo_stderr"] == pytest.approx(alone["p1"]["elo_stderr"], rel=0.01)
    _, table, _ = rate(log)
    text = " ".join(table.split())
    assert "No game connects 2 islands of players (of 3, 2 players)" in text
    assert "The mean of each island is 0" in text
    assert elo(rated(log, "--anchor", "p2"))["p2"] == 0


@pytest.fixture
def told_of(tmp_path, monkeypatch, capsys):
    """Run the command on a file of these bytes: exit code, its JSON if it went well, what it complained of."""
    monkeypatch.chdir(tmp_path)

    def run(data, *args):
        (tmp_path / "log.csv").write_bytes(data)
        with pytest.raises(SystemExit) as left:
            main(["rate", "log.csv", *args, "--format", "json"])
        out, err = capsys.readouterr()
        return left.value.code, json.loads(out) if out else None, err

    return run


def test_names_that_differ_by_unicode_form_alone_are_one(told_of):
    rows = f"{HEAD}\nx,M\u00e1laga,b,3,0,1\nx,b,Ma\u0301laga,1,0,3\n".encode()
    code, told, _ = told_of(rows, "--anchor", "Ma\u0301laga")
    assert (code, sorted(elo(told))) == (0, ["M\u00e1laga", "b"])


@pytest.mark.parametrize("separator", [";", "\t"])
def test_semicolons_and_tabs_separate_too(told_of, separator):
    text = "\n".join([f"note,{HEAD}", "one,x,a,b,3,0,1", "two,x,b,a,1,0,3"])
    code, told, _ = told_of(text.replace(",", separator).replace("one", "one, or 1").encode("utf-8-sig"))
    assert (code, elo(told)) == (0, elo(told_of(text.encode())[1]))


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (f"{HEAD}\nx,a,b,1,0,1\nx,M\u00e1laga,b,1,0,1\n".encode("latin-1"), "continuation byte, 0xe1, in line 3"),
        (f"{HEAD}\nx,a,b,1,0,1\n".encode("utf-16"), "log.csv is text in UTF-16, not in UTF-8"),
        (f"{HEAD}\nx,{'a' * 140_000},b,1,0,1\n".encode(), "log.csv:2: a field has more than 131,072 characters"),
        (f"{HEAD}\nx,{'a' * 300},b,1,0,1\n".encode(), "log.csv:2: side_a has 300 characters"),
        (f"{HEAD}\nx,a,b,inf,0,1\n".encode(), "log.csv:2: wins_a is 'inf'"),
        (f"{HEAD}\nx,a,b,{'9' * 6000},0,1\n".encode(), "log.csv:2: wins_a is 9999"),
        (f"{HEAD}\nx,a,b,1,many,1\n".encode(), "log.csv:2: draws is 'many'"),
    ],
)  # fmt: skip
def test_text_that_is_no_log_is_one_line(told_of, data, says):
    code, told, err = told_of(data)
    assert (code, told, err.count("\n")) == (2, None, 1)
    assert says in err
    assert len(err) < 400


def test_standard_input_in_another_encoding_is_one_line(monkeypatch, capsys):
    data = f"{HEAD}\nx,M\u00e1laga,b,1,0,1\n".encode("latin-1")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data), encoding="utf-8"))
    with pytest.raises(SystemExit) as left:
        main(["rate", "-"])
    out, err = capsys.readouterr()
    assert (left.value.code, out, err.count("\n")) == (2, "", 1)
    assert "standard input is not text in UTF-8" in err


def test_the_error_of_the_side_counts_starts_that_favour_a_side_in_both_games(rated):
    """120 starts favour side A and 80 side B: as many independent observations, not twice as many."""
    rows = []
    for start in range(200):
        a, b = (1, 0) if start < 120 else (0, 1)
        rows += [f"pit,anna,bert,{a},0,{b},{start}", f"pit,bert,anna,{a},0,{b},{start}"]
    told = rated(rows, "--prior", "0", head="arena,side_a,side_b,wins_a,draws,wins_b,seed_pair")
    assert told["side_elo"] == pytest.approx(ELO * math.log(120 / 80), rel=1e-4)
    assert told["side_elo_stderr"] == pytest.approx(ELO * math.sqrt(1 / 120 + 1 / 80), rel=0.03)
    assert told["ratings"][0]["elo_stderr"] < 5  # every pair was even
