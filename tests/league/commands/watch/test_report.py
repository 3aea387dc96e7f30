"""`league report`: what the other commands print, as one file."""

import os
import socket
import subprocess
import sys

import pytest

from dashboards.web import document as pages
from league.commands.cli import main
from league.queries.page import league_page
from league.queries.query import Open
from storage.records import CurvePoint, Job, League, Phase
from storage.store import Store
from tests.league.leagues import C, filled, finish, match, player, snapshot, unlike_sides
from tests.markup import Markup

MATCHES = (
    match("blue@4", "red@4", 48, 16), match("blue@4", "blue@0", 60, 4), match("red@4", "blue@0", 40, 24),
    match("red@0", "blue@1", 20, 44), match("pusher", "blue@4", 10, 54), match("red@0", "blue@0", 30, 34),
    match("red@1", "pusher", 30, 34),
)  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """A folder with a league that has learnt, rated and had trouble."""
    with filled(tmp_path / "league-data", *MATCHES) as store:
        values = {"score": 0.5, "reward": 0.25, "steps_per_second": 1000.0}
        points = [CurvePoint("cup", name, i, 100 * i, float(i), values) for name in ("blue", "red") for i in (1, 2, 3)]
        finish(store, curves=points)
        store.queue([], [Phase("cup", "1", 0, ("blue",), {"blue": 0, "red": 0}, {"iterations": 5})])
        store.queue([Job("cup", "match", "broken")])
        claimed = store.claim("cup", ["match"], "here:1:0", 60)
        store.fail(claimed[0], "no <good>\nat all", tries=1)
        store.set_paused("cup", "red", "it diverged")
    return tmp_path


def reported(folder, monkeypatch, *args) -> Markup:
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as left:
        main(["report", "-o", "report.html", *args])
    assert left.value.code == 0
    return Markup((folder / "report.html").read_text("utf-8"))


def printed(capsys, monkeypatch, *args) -> list[list[str]]:
    """A command's first table, as cells."""
    monkeypatch.setenv("COLUMNS", "400")
    with pytest.raises(SystemExit) as left:
        main(list(args))
    assert left.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    rule = next(i for i, line in enumerate(lines) if line.strip().startswith("──"))
    rows = [lines[rule - 1]]
    for line in lines[rule + 1 :]:
        if not line.strip():
            break
        rows.append(line)
    return [[cell.strip() for cell in row.split("  ") if cell.strip()] for row in rows]


def test_the_ladder_has_the_rows_of_league_ratings(folder, monkeypatch, capsys):
    page = reported(folder, monkeypatch)
    capsys.readouterr()
    rows = [line[:-1] for line in page.tables["Ladder, best first"]]  # without training steps, the last
    assert len(rows) == 1 + 7
    assert rows == printed(capsys, monkeypatch, "ratings")


def test_every_figure_has_its_data_and_words(folder, monkeypatch):
    page = reported(folder, monkeypatch)
    titles = [text for tag, text in page.headings if tag == "h2"]
    assert titles == [
        "Overview", "Who learns now", "Ladder", "Ratings over training", "Payoff", "Opponents now", "Learning curves",
        "Throughput", "Jobs and errors", "Newest matches", "Lineage",
    ]  # fmt: skip
    sections = {name.partition("-")[0] for name in page.figures}
    assert sections == {"overview", "ladder", "ratings", "payoff", "opponents", "curves", "throughput", "lineage"}
    assert page.labels.keys() == page.figures.keys() == page.captions.keys() - {"overview-3"}  # a film
    assert all(page.captions.values())
    traces = {name: figure["data"] for name, figure in page.figures.items()}
    assert all(traces.values())
    best = next(t for t in traces["ladder-1"] if t["name"] == "blue")
    assert best["y"][0] == "blue@4"
    heat = next(t for t in traces["payoff-0"])
    assert heat["z"][heat["y"].index("blue@4")][heat["x"].index("red@4")] == 0.75
    assert traces["throughput-1"][0]["y"] == [1000.0] * 3
    assert page.tables["Players"][1][:2] == ["blue", "0"]
    (opponents,) = (rows for name, rows in page.tables.items() if name.startswith("Whom blue meets"))
    assert opponents[1][:2] == ["red (as it is now)", "1.000"]


def test_a_pair_has_its_newest_matches(folder, monkeypatch):
    with Store.open(folder / "league-data") as store:
        film = store.blobs.put(b"film")
        finish(store, matches=[match("blue@4", "red@4", i, 20 - i) for i in range(11)])
        finish(store, matches=[match("blue@4", "red@4", 3, 1, recording=film)])
    (pairs,) = reported(folder, monkeypatch).data
    assert pairs["heads"] == ["match", "a", "b", "w-d-l", "played", "to watch it"]
    rows = pairs["found"]["blue@4"]["red@4"]
    assert [row[0] for row in rows] == [str(7 + i) for i in range(12, 2, -1)]  # of 13 the newest ten
    assert rows[0][1:4] == ["blue@4", "red@4", "3-0-1"]
    assert [row[5] for row in rows[:2]] == ["league watch 19", ""]


def test_what_went_wrong_is_told_whole(folder, monkeypatch):
    text = "\n".join(reported(folder, monkeypatch).notes)
    assert "broken, tried 1 times: no <good>\n    at all" in text
    assert "red: it diverged" in text
    assert "blue learns since iteration 0; it ends after 5 iterations" in text


def test_nothing_in_it_leads_elsewhere(folder, monkeypatch):
    page = reported(folder, monkeypatch)
    assert not [link for link in page.links if not link.startswith(("#", "data:"))]
    assert {link for link in page.links if link.startswith("#")} <= {f"#{name}" for name in page.ids}


def test_a_league_in_which_nothing_has_happened_has_a_page_too(tmp_path, monkeypatch):
    with Store.open(tmp_path / "league-data", create=True) as store:
        store.create_league(League("cup", ""))
        store.add_players([player("blue", 0), player("red", 1)])
    page = reported(tmp_path, monkeypatch)
    assert {name.partition("-")[0] for name in page.figures} == {"opponents"}  # of whoever will learn first
    assert "Nobody has learnt yet." in page.notes


def test_unlike_sides_have_a_ladder_each(tmp_path, monkeypatch):
    played = [match(f"blue@{i}", f"red@{j}", 30 + 3 * i - 2 * j, 34) for i in (0, 4) for j in (0, 4)]
    unlike_sides(tmp_path / "league-data", played)
    page = reported(tmp_path, monkeypatch)
    names = [{row[1] for row in page.tables[f"Ladder of 1 × {kind}, best first"][1:]} for kind in ("tank", "drone")]
    assert names == [{"blue@0", "blue@4"}, {"red@0", "red@4"}]
    assert {"ladder-1", "ladder-3", "ratings-0", "ratings-1"} <= set(page.figures)


def test_an_arena_of_one_team_shows_success(tmp_path, monkeypatch):
    blue = player("blue", 0)
    with Store.open(tmp_path / "league-data", create=True) as store:
        store.create_league(League("cup", ""))
        store.add_players([blue])
        store.add_snapshots([snapshot(blue, i, store.blobs.put(b"%d" % i)) for i in (0, 4)])
        finish(store, matches=[match(f"blue@{i}", None, 10 + 5 * i, 22 - 5 * i) for i in (0, 4)])
    page = reported(tmp_path, monkeypatch)
    assert [row[1:3] for row in page.tables["Ladder, best first"][1:]] == [["blue@4", "0.938"], ["blue@0", "0.312"]]
    assert page.figures["ladder-1"]["data"][0]["x"] == [30 / 32, 10 / 32]
    assert "Nobody meets anybody in training: there is one team, or nobody learns now." in page.notes


def test_a_thousand_snapshots_have_a_page_that_a_browser_can_hold(tmp_path, monkeypatch):
    blue, red = player("blue", 0), player("red", 1)
    with filled(tmp_path / "league-data") as store:
        frozen = [snapshot(p, i, store.blobs.put(b"same")) for p in (blue, red) for i in range(5, 505)]
        store.add_snapshots(frozen)
        games = [match(f"blue@{i}", f"red@{i + d}", 34 - d, 30) for i in range(5, 495) for d in (0, 1, 9)]
        finish(store, matches=[*games, *(match(f"{p.name}@5", f"{p.name}@0", 400, 300) for p in (blue, red))])
    page = reported(tmp_path, monkeypatch)
    head, *best = page.tables["Ladder, best first: the first 500 of 1,007; `league ratings` prints all"]
    with Open(Store.open(str(tmp_path / "league-data"))) as opened:
        ratings = opened.ratings()
    at = [head.index(name) for name in ("rank", "snapshot", "elo", "games")]
    assert [[row[i] for i in at] for row in best] == [
        [f"{row['rank']:.0f}", row["name"], f"{row['elo']:.0f}", str(row["games"])]
        if row["known"]
        else ["–", row["name"], "–", str(row["games"])]
        for row in ratings.head(500).to_dict("records")
    ]
    assert best[0][0] == "1"
    assert len(page.tables["Snapshots: the newest 500 of 1,007; `league snapshots` prints all"]) == 1 + 500
    heat = page.figures["payoff-0"]["data"][0]
    assert (len(heat["z"]), len(heat["z"][0])) == (100, 100)
    assert "100 × 100 of 991 × 991 snapshots" in page.captions["payoff-0"]
    bare = len((tmp_path / "report.html").read_bytes()) - len(pages.script("plotly.js").encode())
    assert bare < 2_000_000


def refused(capsys, *args) -> str:
    with pytest.raises(SystemExit) as left:
        main(list(args))
    assert left.value.code == 2
    said = capsys.readouterr()
    assert not said.out
    assert said.err.count("\n") == 1
    return said.err


def test_a_file_that_is_there_stays(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    (folder / "report.html").write_text("mine")
    assert "report.html exists already" in refused(capsys, "report", "-o", "report.html")
    assert (folder / "report.html").read_text() == "mine"


def test_it_says_what_it_needs(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert refused(capsys, "report") == "league: league report needs -o FILE: see league report --help\n"
    assert "There is no league 'cap' here" in refused(capsys, "report", "--league", "cap", "-o", "report.html")
    pages.script.cache_clear()
    monkeypatch.setitem(sys.modules, "plotly.offline", None)  # as if it were not installed
    assert "pip install 'robot-league[dash]'" in refused(capsys, "report", "-o", "report.html")
    assert not (folder / "report.html").exists()


def test_the_page_loads_neither_what_trains_nor_pandas(folder):
    heavy = ("jax", "torch", "mujoco", "pandas", "scipy", "rerun", "agents", "arenas.arena", "arenas.games")
    program = (
        "import sys\nfrom league.queries.page import league_page\nfrom league.queries.query import Open\n"
        "from storage.store import Store\n"
        f"league_page.page(Open(Store.open({str(folder / 'league-data')!r})))\n"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_opening_it_for_a_page_changes_nothing(folder):
    with Store.open(folder / "league-data") as store:
        before = league_page.version(Open(store))
        league_page.page(Open(store))
        assert league_page.version(Open(store)) == before
        finish(store, matches=[match("blue@1", "red@1", 5, 3, arena=C)])
        played = league_page.version(Open(store))
        assert played != before
        for doing in ("compiling", "training"):
            store.heartbeat("here:1:train0", "cup", "train", os.getpid(), socket.gethostname(), {"doing": doing})
            told = league_page.version(Open(store))
            assert told != played
            played = told
