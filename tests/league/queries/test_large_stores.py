"""Large stores and logs: what is read in bulk, and what is chosen where there is no room for all."""

import numpy as np
import pytest

from league.commands.analyse.csv_columns import Columns, column_places, quick
from league.commands.analyse.csv_log import COLUMNS, LARGEST, SEED_PAIR, choose, parse, sums
from league.commands.analyse.payoffs import meta, payoff
from league.config.schema import ConfigError
from league.queries.query import Open
from league.queries.ratings import metagame, shown_players
from storage.store import Store
from tests.league.leagues import filled, match

HEAD = "arena,side_a,side_b,wins_a,draws,wins_b,seed_pair,more"


def rows(number: int, seed: int = 0) -> list[str]:
    """Rows of two arenas between 30 players, with seed pairs and stray spaces."""
    rng = np.random.default_rng(seed)
    found = []
    for a, step, games, pair, arena in zip(
        rng.integers(30, size=number), rng.integers(1, 30, size=number), rng.integers(0, 5, (number, 3)),
        rng.integers(-40, 40, size=number), rng.integers(2, size=number), strict=True,
    ):  # fmt: skip
        seeds = "" if pair < 0 else f"s{pair}"
        found.append(f"pit{arena}, p{a},p{(a + step) % 30} ,{games[0]},{games[1]}, {games[2]},{seeds},x")
    return found


def slowly(text: str, monkeypatch) -> Columns:
    with monkeypatch.context() as patch:
        patch.setattr("league.commands.analyse.csv_log.quick", lambda *args: None)
        return parse(text, "log.csv")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_log_read_in_bulk_is_the_one_read_row_by_row(monkeypatch, end):
    monkeypatch.setattr("league.commands.analyse.csv_columns.CHUNK", 70)
    text = end.join([HEAD, *rows(300), "", "   "])
    places = column_places(HEAD.split(","), "log.csv", COLUMNS, [SEED_PAIR])
    assert quick(text, ",", places, 8, LARGEST, SEED_PAIR) is not None
    both = [parse(text, "log.csv"), slowly(text, monkeypatch)]
    for arena in ("pit0", "pit1"):
        one, other = (sums(choose(found, arena, "log.csv")) for found in both)
        for name in ("names", "first", "second", "home", "away", "pairs"):
            assert np.array_equal(getattr(one.payoff, name), getattr(other.payoff, name)), name
        for a, b in zip(one.clusters, other.clusters, strict=True):
            assert np.array_equal(a, b)
    games = [sum(map(int, row.split(",")[3:6])) for row in rows(300) if row.startswith("pit1")]
    assert one.payoff.played.sum() == 2 * sum(games)
    assert len(one.clusters.edge)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("pit0,a,a,1,0,0,,", "log.csv:202: 'a' plays against itself"),
        ("pit0,a,b,1.5,0,0,,", "log.csv:202: wins_a is '1.5'"),
        ("pit0,a,b,1,0,99999999999,,", "log.csv:202: wins_b is 99999999999"),
        ("pit0,a,b,1,0,0", "log.csv:202: 6 fields"),
        ("pit0,,b,1,0,0,,", "log.csv:202: side_a is empty"),
        ('pit0,"a,b,1,0,0,,', "log.csv:202: unexpected end of data"),
    ],
)
def test_a_wrong_row_far_down_is_named(wrong, says):
    with pytest.raises(ConfigError) as error:
        parse("\n".join([HEAD, *rows(200), wrong]), "log.csv")
    assert says in str(error.value)


@pytest.fixture
def cup(tmp_path):
    """blue@0 < blue@1 < blue@4 < pusher in what was played; red@4 has not."""
    store = filled(
        tmp_path / "store",
        match("blue@1", "blue@0", 30, 10), match("blue@4", "blue@1", 30, 10), match("pusher", "blue@4", 40, 0),
    )  # fmt: skip
    store.close()
    return tmp_path / "store"


def test_a_table_of_too_many_has_the_foremost_and_says_so(cup, monkeypatch, capsys):
    monkeypatch.setattr(metagame, "foremost", lambda names, *others: shown_players.foremost(names, *others, most=3))
    with Open(Store.open(str(cup)), "cup") as opened:
        ladder, (snapshots, players) = opened.shown().ladders[0], opened.shown()[3:5]
        found = metagame.table(ladder, snapshots, players)
        whole = metagame.sides_of(ladder, snapshots, players, None, None)
    assert set(found.rows) == {"pusher", "blue@4", "blue@0"}  # of no player, newest, initial
    assert found.asked == (4, 4)
    assert len(whole[0]) == 4
    assert meta(["--store", str(cup)]) == 0
    assert "3 × 3 of 4 × 4 snapshots" in capsys.readouterr().out
    assert payoff(["--store", str(cup), "--format", "csv"]) == 0
    lines = [line.split(",") for line in capsys.readouterr().out.splitlines()]
    assert [line[0] for line in lines] == ["", *whole[0]]
    cells = {(row[0], name): cell for row in lines[1:] for name, cell in zip(lines[0], row, strict=True) if name}
    assert cells["blue@1", "blue@0"] == "0.75"
    assert cells["blue@0", "blue@1"] == "0.25"
    assert cells["pusher", "pusher"] == "0.5"
    assert cells["pusher", "blue@0"] == ""


def test_only_what_is_asked_for_is_read(cup):
    with Store.open(str(cup)) as store:
        whole, brief = store.snapshots("cup"), store.snapshots("cup", brief=True)
        assert [s.name for s in brief] == [s.name for s in whole]
        assert {s.settings for s in brief} == {""}
        found = store.matches("cup", among=["blue@0", "blue@1", "pusher"])
        assert [(m.a, m.b) for m in found] == [("blue@1", "blue@0")]
