"""`league payoff`, `meta`, `forgetting` and `explain` on stores and files whose figures can be worked out by hand."""

import csv
import json
import subprocess
import sys
from dataclasses import replace

import pytest

from league.commands import cli
from storage.records import League, Meeting
from storage.store import Store
from tests.league.conftest import ENVIRONMENT
from tests.league.leagues import filled, finish, match, player, snapshot, unlike_sides

RPS = "rock,paper,scissors\n0,-1,1\n1,0,-1\n-1,1,0\n"


def said(capsys, *args: object) -> str:
    with pytest.raises(SystemExit) as left:
        cli.main(list(map(str, args)))
    out = capsys.readouterr()
    assert left.value.code == 0, out.err
    return out.out


def refused(capsys, *args: object) -> str:
    with pytest.raises(SystemExit) as left:
        cli.main(list(map(str, args)))
    out = capsys.readouterr()
    assert left.value.code == 2
    assert out.err.count("\n") == 1
    return out.err


@pytest.fixture
def rps(tmp_path):
    file = tmp_path / "rps.csv"
    file.write_text(RPS)
    return file


@pytest.fixture
def cup(tmp_path):
    """blue@0 < blue@1 < blue@4 < pusher in what was played; red@4 has not."""
    store = filled(
        tmp_path / "store",
        match("blue@1", "blue@0", 30, 10), match("blue@4", "blue@1", 30, 10), match("pusher", "blue@4", 40, 0),
    )  # fmt: skip
    counts = {"wins": 90, "draws": 0, "losses": 10}
    finish(store, meetings=[Meeting("cup", "blue", 4, "red@0", **counts), Meeting("cup", "blue", 4, "red", 0, 40, 0)])
    store.close()
    return tmp_path / "store"


@pytest.mark.parametrize("solver", [(), ("--solver", "nash"), ("--solver", "alpharank", "--selection", "global")])
def test_a_matrix_of_a_file_is_solved(capsys, rps, solver):
    found = json.loads(said(capsys, "meta", rps, *solver, "--format", "json"))
    assert found.keys() == {"mass", "value"}
    assert found["mass"] == pytest.approx({"rock": 1 / 3, "paper": 1 / 3, "scissors": 1 / 3})
    assert found["value"] == pytest.approx(0)


def test_alphas_limit_is_reached_without_a_crash(capsys, rps):
    text = said(capsys, "meta", rps, "--solver", "alpharank", "--alpha", "1e308", "--format", "json")
    assert "NaN" not in text
    assert sum(json.loads(text)["mass"].values()) == pytest.approx(1)


def test_the_table_tells_what_goes_round_in_circles(capsys, rps):
    text = said(capsys, "meta", rps)
    assert "0.3333" in text
    assert "Cyclic share 1.000" in text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no payoffs"),
        ("a,b\n", "no payoffs"),
        ("a,b\n1,2\n", "2 names but 1 rows"),
        ("a,a\n1,2\n3,4\n", "a name of its own"),
        ("a,b\n1,2\n3\n", ":3: 1 payoffs, but 2 names"),
        ("a,b\n1,2\n3,x\n", ":3: the payoff of b against b is 'x'; it must be a number"),
        ("a,b\n1,nan\n3,4\n", "is 'nan'; it must be a number"),
        (",a,b\na,1,\nb,3,4\n", ":2: the payoff of a against b is missing"),
        (",a,b\na,1,2\nc,3,4\n", ":3: the row of b begins with 'c'"),
    ],
)
def test_a_file_that_is_no_payoff_matrix_is_refused_in_one_line(capsys, tmp_path, text, says):
    file = tmp_path / "m.csv"
    file.write_text(text)
    assert says in refused(capsys, "meta", file)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--alpha", "3"), "--alpha 3.0 does nothing with --solver nash"),
        (("--solver", "elo"), '"nash", "alpharank"'),
        (("--solver", "alpharank", "--population", "1"), "at least 2"),
        (("--league", "main"), "--league main is about a league's table"),
        (("--rows", "blue@*"), "--rows blue@* is about a league's table"),
    ],
)
def test_options_that_cannot_be_meant_are_refused(capsys, rps, args, says):
    assert says in refused(capsys, "meta", rps, *args).replace("between 2", "at least 2")
    assert "cannot read nowhere.csv" in refused(capsys, "meta", "nowhere.csv")


def test_a_leagues_payoff_table_and_its_mixture(capsys, cup):
    found = json.loads(said(capsys, "payoff", "--store", cup, "--format", "json"))
    assert found["rows"] == found["columns"] == ["pusher", "blue@0", "blue@1", "blue@4"]
    assert found["scores"][3] == [0.0, None, 0.75, 0.5]
    assert found["unknown_pairs"] == 3
    assert (found["cyclic"], found["transitive"], found["rings"], found["pairs"]) == (None, None, 0, 6)
    rows = list(csv.reader(said(capsys, "payoff", "--store", cup, "--format", "csv").splitlines()))
    assert rows[0] == ["", *found["rows"]]
    assert rows[4] == ["blue@4", "0.0", "", "0.75", "0.5"]
    text = " ".join(said(capsys, "payoff", "--store", cup).split())
    assert "3 of 6 pairs have not met (–)" in text
    assert "Transitive share –, cyclic –: the 3 pairs that have met close no ring" in text
    mixed = json.loads(said(capsys, "meta", "--store", cup, "--format", "json"))
    assert mixed["mass"] == pytest.approx({"pusher": 1, "blue@0": 0, "blue@1": 0, "blue@4": 0}, abs=1e-6)
    assert (mixed["unknown_pairs"], mixed["pairs"], mixed["unmet"]["pusher"]) == (3, 6, 2)


def test_cross_play_and_one_population_against_another(capsys, cup):
    newest = json.loads(said(capsys, "payoff", "--store", cup, "--newest", "--format", "json"))
    assert newest["rows"] == ["pusher", "blue@4"]
    args = ("--rows", "pusher", "--columns", "blue@*", "--format", "json")
    part = json.loads(said(capsys, "payoff", "--store", cup, *args))
    assert (part["rows"], part["value"], part["cyclic"]) == (["pusher"], pytest.approx(1, abs=0.01), None)
    says = refused(capsys, "payoff", "--store", cup, "--rows", "green*")
    assert "No rated snapshot matches 'green*'; rated are: pusher, blue@0" in says
    says = refused(capsys, "meta", "--store", cup, "--solver", "alpharank", "--rows", "pusher")
    assert "of one population" in says


def test_rows_and_columns_of_unlike_sides_are_those_of_one_side(capsys, tmp_path):
    unlike_sides(tmp_path / "two", [match("blue@4", "red@0", 30, 10), match("blue@0", "red@4", 5, 35)])
    says = refused(capsys, "payoff", "--store", tmp_path / "two", "--rows", "red*")
    assert "matches 'red*' in the rows, which are of 1 × tank; rated are: blue@0, blue@4." in says
    table = json.loads(said(capsys, "payoff", "--store", tmp_path / "two", "--columns", "red*", "--format", "json"))
    assert (table["rows"], table["columns"]) == (["blue@0", "blue@4"], ["red@0", "red@4"])


def test_a_league_without_matches_has_no_table(capsys, tmp_path):
    filled(tmp_path / "new").close()
    assert "No rating match has been played yet" in refused(capsys, "payoff", "--store", tmp_path / "new")


def test_a_side_without_a_rated_newest_snapshot_has_no_newest_table(capsys, tmp_path):
    filled(tmp_path / "old", match("blue@1", "blue@0", 30, 10)).close()
    says = refused(capsys, "payoff", "--newest", "--store", tmp_path / "old")
    assert "No newest snapshot of a side is rated yet; rated are: blue@0, blue@1." in says


@pytest.mark.parametrize("command", ["payoff", "meta"])
def test_an_arena_of_one_team_has_no_table(capsys, tmp_path, command):
    filled(tmp_path / "flag", match("blue@4", None, 15, 1)).close()
    assert "The arena has one team, so nobody meets" in refused(capsys, command, "--store", tmp_path / "flag")


def test_an_attacker_that_has_met_its_victim_alone_is_no_part_of_the_mixture(capsys, tmp_path):
    attacker = match("attacker", "blue@4", 40, 0)
    with filled(tmp_path / "store", match("blue@1", "blue@0", 30, 10), match("blue@4", "blue@1", 30, 10)) as store:
        fixed = snapshot(None, 0, store.blobs.put(b"attacker"), name="attacker")
        store.add_snapshots([replace(fixed, script=None, origin="imported")])
        finish(store, matches=[attacker])
    text = said(capsys, "meta", "--store", tmp_path / "store")
    assert "one opponent alone: attacker" in text
    assert not text.startswith("attacker")
    found = json.loads(said(capsys, "meta", "--store", tmp_path / "store", "--format", "json"))
    assert found["mass"]["blue@4"] > 0.9
    assert "attacker" not in found["mass"]
    chosen = ("--rows", "*", "--columns", "*", "--format", "json")
    assert json.loads(said(capsys, "meta", "--store", tmp_path / "store", *chosen))["mass"]["attacker"] > 0.9


def test_attackers_stay_where_their_side_has_played_with_nobody_else(capsys, tmp_path):
    with filled(tmp_path / "store") as store:
        ant, bug = (
            replace(snapshot(None, 0, store.blobs.put(n.encode()), name=n), script=None) for n in ("ant", "bug")
        )
        store.add_players([player("gold", 1, "tank")])
        store.add_snapshots([replace(ant, roster="tank"), replace(bug, roster="tank")])
        finish(store, matches=[match("blue@4", "ant", 10, 30), match("blue@4", "bug", 10, 40)])
    found = json.loads(said(capsys, "meta", "--store", tmp_path / "store", "--format", "json"))
    assert (found["mass"], found["left_out"]) == ({"blue@4": 1.0}, [])


def test_who_loses_to_its_own_past_raises_the_alarm(capsys, tmp_path):
    from tests.league.leagues import C, player, snapshot

    store = filled(tmp_path / "old", match("blue@1", "blue@0", 10, 10), match("blue@4", "blue@0", 10, 10))
    blob = store.blobs.put(b"more")
    store.add_snapshots([snapshot(player("blue", 0), 8, blob)])
    finish(store, matches=[match("blue@8", "blue@0", 10, 90, arena=C)])
    store.close()
    (row,) = json.loads(said(capsys, "forgetting", "--store", tmp_path / "old", "--format", "json"))
    assert (row["snapshot"], row["against"], row["back"], row["score"]) == ("blue@8", "blue@0", 3, 0.1)
    assert row["alarm"] == "!"


def test_forgetting_is_of_the_newest_that_has_met_its_own_past(capsys, tmp_path):
    """A newest snapshot that has only met others says nothing of what was unlearnt; the one before it does."""
    from tests.league.leagues import BLUE, snapshot

    store = filled(tmp_path / "old", match("blue@1", "blue@0", 10, 10))
    blob = store.blobs.put(b"more")
    store.add_snapshots([snapshot(BLUE, 8, blob), snapshot(BLUE, 16, blob)])
    finish(store, matches=[match("blue@8", "blue@0", 10, 90), match("blue@16", "red@4", 20, 20)])
    (row,) = json.loads(said(capsys, "forgetting", "--store", tmp_path / "old", "--format", "json"))
    assert (row["snapshot"], row["against"], row["score"]) == ("blue@8", "blue@0", 0.1)
    finish(store, matches=[match("blue@16", "blue@1", 30, 10)])
    store.close()
    (row,) = json.loads(said(capsys, "forgetting", "--store", tmp_path / "old", "--format", "json"))
    assert (row["snapshot"], row["against"], row["back"], row["score"]) == ("blue@16", "blue@1", 3, 0.75)


def test_forgetting_says_where_no_snapshot_can_meet_its_own_past(capsys, tmp_path):
    from tests.league.leagues import BLUE, RED

    for name, players, says in (
        ("one", [BLUE], "The arena has one team, so nobody meets anybody"),
        ("unlike", [BLUE, replace(RED, roster="drone")], "no snapshot meets an older one of its own player"),
        ("alike", [BLUE, RED], "No player has more than three rated snapshots"),
    ):
        with Store.open(tmp_path / name, create=True) as store:
            store.create_league(League("cup", ""))
            store.add_players(players)
            put = store.blobs.put
            store.add_snapshots([snapshot(p, i, put(f"{p.name}{i}".encode())) for p in players for i in range(3)])
            rival = "red@2" if len(players) > 1 else None
            finish(store, matches=[match("blue@2", rival, 30, 10)])
        assert says in " ".join(said(capsys, "forgetting", "--store", tmp_path / name).split())


def test_explain_tells_distribution_win_rates_and_rule(capsys, cup):
    found = json.loads(said(capsys, "explain", "blue", "--store", cup, "--format", "json"))
    (team,) = found["teams"]
    rows = {row["opponent"]: row for row in team["opponents"]}
    assert (found["kind"], found["share"], rows["red"]["probability"]) == ("latest", 0, 1)
    assert rows["red"] | {"read": None} == rows["red"]
    assert (rows["red"]["win_rate"], rows["red"]["games"]) == (pytest.approx(0.5), 40)
    assert rows["red@0"]["win_rate"] == pytest.approx(0.89, abs=0.05)
    assert (rows["red@4"]["games"], rows["red@4"]["inherits"]) == (0, None)
    text = said(capsys, "explain", "blue", "--store", cup)
    assert "the share of the past is 0" in text
    assert "there is: blue, red" in refused(capsys, "explain", "green", "--store", cup)


@pytest.mark.parametrize("args", [("meta", "rps.csv"), ("explain", "blue"), ("payoff",), ("forgetting",)])
def test_questions_load_nothing_heavy(cup, rps, args):
    code = (
        "import sys; from league.commands import cli\n"
        "try: cli.main(sys.argv[1:])\n"
        "except SystemExit as left: assert left.code == 0, left\n"
        "heavy = {'jax', 'torch', 'mujoco', 'pandas', 'scipy'} & set(sys.modules); assert not heavy, heavy"
    )
    where = () if args[0] == "meta" else ("--store", str(cup))
    done = subprocess.run(
        [sys.executable, "-c", code, *args, *where], cwd=rps.parent, env=ENVIRONMENT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture
def ladder(tmp_path):
    """blue and red grow by iterations; a random policy has lost to an early snapshot and met nobody else."""
    from tests.league.leagues import BLUE, RED, snapshot

    store = filled(tmp_path / "ladder")
    blob, iterations = store.blobs.put(b"more"), range(8, 88, 8)
    store.add_snapshots([snapshot(player, i, blob) for player in (BLUE, RED) for i in iterations])
    store.add_snapshots([snapshot(None, 0, store.blobs.put(b"r"), "random")])
    at = [0, *iterations]
    log = [match(f"{one}@{i}", f"{other}@{j}", 24, 8) for i, j in zip(at[1:], at, strict=False) for one, other in
           (("blue", "red"), ("red", "blue"))]  # fmt: skip
    finish(store, matches=[*log, match("blue@80", "red@80", 20, 12), match("blue@0", "random", 60, 4)])
    store.close()
    return tmp_path / "ladder"


def test_whom_nobody_has_met_is_not_played_by_best_mixtures(capsys, ladder):
    found = json.loads(said(capsys, "meta", "--store", ladder, "--format", "json"))
    assert found["mass"]["random"] == pytest.approx(0, abs=1e-6)
    assert found["high"]["random"] < 0.05
    assert found["mass"]["blue@80"] == pytest.approx(1, abs=1e-6)
    assert 0 <= found["low"]["blue@80"] < found["mean"]["blue@80"] < found["high"]["blue@80"] <= 1
    assert sum(found["mean"].values()) == pytest.approx(1)
    assert (found["pairs"], found["unknown_pairs"], found["unmet"]["random"]) == (23 * 22 // 2, 23 * 11 - 22, 21)
    assert json.loads(said(capsys, "meta", "--store", ladder, "--format", "json")) == found
    none = json.loads(said(capsys, "meta", "--store", ladder, "--format", "json", "--resamples", "0"))
    assert (none["mass"], none["low"]["random"], none["resamples"]) == (found["mass"], None, 0)
    text = " ".join(said(capsys, "meta", "--store", ladder, "--solver", "alpharank", "--resamples", "30").split())
    assert "231 of 253 pairs have not met (–): where a number is needed it is the score that the ratings expect" in text
    assert "of 30 tables that the games leave possible" in text
    rows = list(csv.DictReader(said(capsys, "meta", "--store", ladder, "--format", "csv").splitlines()))
    assert [list(row) for row in rows[:1]] == [["name", "mass", "mean", "low", "high", "unmet"]]


def test_a_narrow_terminal_shows_the_newest_the_best_and_the_first(capsys, ladder, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = said(capsys, "payoff", "--store", ladder)
    assert max(map(len, text.splitlines())) <= 80
    head = text.splitlines()[0].split()[2:]
    assert {"blue@80", "red@80", "blue@0", "red@0", "random"} <= set(head)
    assert head == [name for name in json.loads(said(capsys, "payoff", "--store", ladder, "--format", "json"))["rows"]
                    if name in head]  # fmt: skip
    assert f"23 × {len(head)} of 23 × 23 snapshots: the newest of each player, the best" in " ".join(text.split())
    monkeypatch.setenv("COLUMNS", "20")
    assert said(capsys, "payoff", "--store", ladder).splitlines()[0].split()[2:] == ["blue@80"]
    table = list(csv.reader(said(capsys, "payoff", "--store", ladder, "--format", "csv").splitlines()))
    assert (len(table), len(table[0])) == (24, 24)


def test_pairs_that_no_games_connect_are_told_apart(capsys, tmp_path):
    filled(tmp_path / "two", match("blue@1", "blue@0", 30, 10), match("red@1", "red@0", 30, 10)).close()
    found = json.loads(said(capsys, "meta", "--store", tmp_path / "two", "--format", "json"))
    assert (found["pairs"], found["unknown_pairs"], found["unconnected_pairs"]) == (6, 4, 4)
    assert found["high"]["blue@1"] - found["low"]["blue@1"] > 0.9
    text = " ".join(said(capsys, "meta", "--store", tmp_path / "two").split())
    assert "Of 4 of them no chain of games connects the two" in text


def test_shares_are_given_with_the_rings_that_they_rest_on(capsys, tmp_path):
    circle = [match("blue@1", "blue@0", 36, 4), match("blue@0", "red@0", 36, 4), match("red@0", "blue@1", 36, 4)]
    filled(tmp_path / "rps", *circle).close()
    found = json.loads(said(capsys, "payoff", "--store", tmp_path / "rps", "--format", "json"))
    assert (found["rings"], found["cyclic"]) == (1, pytest.approx(1))
    assert found["cyclic_by_chance"] < 0.02
    text = " ".join(said(capsys, "payoff", "--store", tmp_path / "rps").split())
    assert "cyclic 1.000" in text
    assert "The 3 pairs that have met close one ring." in text
    filled(tmp_path / "few", *(match(m.a, m.b, 2, 2) for m in circle[1:]), match("blue@1", "blue@0", 3, 1)).close()
    assert "is chance: play more games" in " ".join(said(capsys, "payoff", "--store", tmp_path / "few").split())


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_matrix_may_be_in_another_dialect(capsys, tmp_path, separator):
    rows = [["", "M\u00e1laga", "b"], ["Ma\u0301laga", "0,5", "1"], ["b", "0", "0,5"]]
    (tmp_path / "m.csv").write_bytes("\r\n".join(map(separator.join, rows)).encode("utf-8-sig"))
    found = json.loads(said(capsys, "meta", tmp_path / "m.csv", "--format", "json"))
    assert found == {"mass": {"M\u00e1laga": pytest.approx(1), "b": pytest.approx(0)}, "value": pytest.approx(0.5)}


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"a,b\n1,2\n3," + b"9" * 140_000, ":3: a field has more than 131,072 characters"),
        (b"a,b\n1,2\n3,\xe1\n", "not text in UTF-8: invalid continuation byte, 0xe1, in line 3"),
        (b"a,b\n1,2\n3,inf\n", "is 'inf'; it must be a number"),
    ],
)
def test_a_file_that_is_no_matrix_is_one_line(capsys, tmp_path, data, says):
    (tmp_path / "m.csv").write_bytes(data)
    assert says in refused(capsys, "meta", tmp_path / "m.csv")
