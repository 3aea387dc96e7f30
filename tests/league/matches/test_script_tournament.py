"""Tables of scripts: games whose result is known, played and told."""

import re

import numpy as np
import pytest

import arenas
from arenas.errors import ArenaError
from scripts import arena_pages, script_tournament
from storage.records import ArenaKey, RankedMatch
from tests.arenas import race, solo


def played(settings, episodes=32):
    return script_tournament.play(settings.build(engine="c", threads=1), settings, episodes)


def rows(text: str) -> dict[str, list[str]]:
    """A Markdown table's cells by the name of their row; that of the heading is empty."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return {name: cells for name, *cells in lines if not name.startswith("---")}


@pytest.fixture(scope="module")
def rock_paper_scissors():
    return played(arenas.settings("rock-paper-scissors"))


def test_rock_beats_scissors_and_every_cell_mirrors_another(rock_paper_scissors):
    table = rows(script_tournament.markdown(rock_paper_scissors))
    assert table[""] == ["rock", "paper", "scissors", "random"]
    won, lost = "100.0 % (80.6-100.0)", "0.0 % (0.0-19.4)"  # Wilson's interval of 16 seed pairs
    assert table["rock"][:3] == ["–", lost, won]
    assert table["paper"][:3] == [won, "–", lost]
    assert table["scissors"][:3] == [lost, won, "–"]
    against, other_way = (float(cell.split()[0]) for cell in (table["rock"][3], table["random"][0]))
    assert against + other_way == pytest.approx(100, abs=0.11)
    assert re.search(r"\d+ drawn$", table["rock"][3])


def test_what_was_played_is_told(rock_paper_scissors):
    key = rock_paper_scissors.key
    text = script_tournament.markdown(rock_paper_scissors)
    assert f"32 episodes of each pair on engine `none` (rules {key.config_hash[:8]}), seed pairs" in text
    assert rock_paper_scissors.ladder.payoff.pairs.sum() == 6 * 16
    assert (rock_paper_scissors.ladder.payoff.episodes.sum(1) == 3 * 32).all()


def test_a_pair_alone_is_played_as_in_the_whole_table(rock_paper_scissors):
    settings = arenas.settings("rock-paper-scissors")
    alone = script_tournament.play(settings.build(engine="c", threads=1), settings, 32, asked=["random:rock"])
    table, whole = (rows(script_tournament.markdown(each)) for each in (alone, rock_paper_scissors))
    assert table["rock"] == ["–", "", "", whole["rock"][3]]
    assert table["paper"] == ["", "–", "", ""]


def test_a_pair_that_is_none_is_refused():
    with pytest.raises(ArenaError, match=r"--pairs rock:well: here there are rock:paper$"):
        script_tournament.chosen([{"rock": "r", "paper": "p"}] * 2, ["rock:paper", "rock:well"])
    blue, red = {"heads": "heads:blue"}, {"tails": "tails:red"}
    assert script_tournament.chosen([blue, red], ["heads:tails"]) == {("heads:blue", "tails:red")}
    with pytest.raises(ArenaError, match="--pairs tails:heads"):
        script_tournament.chosen([blue, red], ["tails:heads"])
    assert script_tournament.chosen([blue], ["heads"]) == {("heads:blue", None)}


def test_a_page_has_all_pairs(capsys):
    with pytest.raises(SystemExit):
        script_tournament.main(["sumo-1v1", "--pairs", "idle:random", "--page"])
    assert "leave out --pairs or --page" in capsys.readouterr().err


def test_unlike_teams_stay_on_their_sides():
    found = played(arenas.settings("matching-pennies"), 8)
    table = rows(script_tournament.markdown(found))
    assert table["heads"][:2] == ["100.0 % (67.6-100.0)", "0.0 % (0.0-32.4)"]  # Wilson's interval of 8 games
    assert table["tails"][:2] == ["0.0 % (0.0-32.4)", "100.0 % (67.6-100.0)"]
    assert "blue (rows) against red (columns)" in script_tournament.markdown(found)


def test_one_team_is_told_by_its_success():
    settings = next(iter(solo.ARENAS))
    found = played(settings, 16)
    table = rows(script_tournament.markdown(found))
    assert table[""] == ["success"]
    assert set(table) - {""} == set(found.sides[0])


def test_pucks_race():
    table = rows(script_tournament.markdown(played(next(iter(race.ARENAS)), 16)))
    assert table["sprinter"][table[""].index("idle")].startswith("100.0 %")


def test_one_of_three_teams_plays_a_script_against_two_with_another():
    settings = arenas.settings("tag")
    arena = settings.build(engine="c", threads=1)
    found = script_tournament.play(arena, settings, 24, asked=["tagger:idle", "idle:tagger"])
    text = script_tournament.markdown(found)
    assert "one team with the row's script against 2 with the column's in `tag`" in text
    assert "24 episodes of each pair on engine `c`" in text
    table = rows(text)
    places = {name: table[""].index(name) for name in ("idle", "tagger", "chaser")}
    ahead, behind = (float(table[a][places[b]].split()[0]) for a, b in (("tagger", "idle"), ("idle", "tagger")))
    assert ahead > 75 > 25 > behind
    assert table["tagger"][places["tagger"]] == "–"
    assert table["tagger"][places["chaser"]] == ""
    assert found.one_against_all["tagger", "idle"].games == 24


def test_the_score_of_one_team_is_the_mean_over_the_others_and_its_interval_of_seeds():
    def match(names: str, rankings: dict, seeds: dict | None = None) -> RankedMatch:
        return RankedMatch(
            "x", ArenaKey("tag", "0", "c"), tuple(names), rankings, 1, (0, 0, 0), 1, seed_clusters=seeds or {}
        )

    first, tied = (1, 2, 3), (2, 1, 2)
    # Seeds: a ahead of both others in all rotations, or between one and a tie with the other: 1 and ¼.
    seeds = {(first, first, first): 4, (tied, tied, tied): 4}
    rotations = [match("abb", {first: 4, tied: 4}, seeds), match("bab", {(2, 1, 3): 4, (1, 2, 2): 4})]
    score = script_tournament.alone("a", rotations)
    assert (score.score, score.games, score.voids) == (pytest.approx(0.625), 16, 2)
    z2, mean, squares = 1.959964**2, 0.625, 8 * 0.375**2
    n = 8 * (8 + z2) / (squares / (mean * (1 - mean)) + z2)
    half = np.sqrt(z2 * (n * mean * (1 - mean) + z2 / 4)) / (n + z2)
    assert score.high - score.low == pytest.approx(2 * half, abs=1e-6)
    won = script_tournament.alone("a", [match("abb", {first: 4}, {(first, first, first): 4})])
    assert (won.score, won.low) == (1.0, pytest.approx(4 / (4 + z2)))  # Wilson's interval of 4 games
    assert np.isnan(script_tournament.alone("a", [match("abb", {})]).score)


def test_three_unlike_teams_have_no_table():
    with pytest.raises(ArenaError, match="one team, two, or equal ones, and here are 3"):
        script_tournament.pairs([{"idle": "idle"}, {"idle": "idle"}, {"idle": "idle:red"}])
    with pytest.raises(ArenaError, match="for each of the teams"):
        script_tournament.pairs([{"idle": "idle:blue"}, {}])


def test_the_table_goes_between_its_two_lines():
    begin = script_tournament.begin("sumo-1v1")
    page = f"# Sumo\n\n{begin}\n{arena_pages.END}\n\n{script_tournament.begin('sumo-2v2')}\nkept\n{arena_pages.END}\n"
    once = arena_pages.replaced(page, begin, "a\n\nb")
    assert once == page.replace(begin, f"{begin}\na\n\nb")
    assert arena_pages.replaced(once, begin, "c") == page.replace(begin, f"{begin}\nc")
    with pytest.raises(ValueError, match="one part between the lines <!-- played by the scripts of race"):
        arena_pages.replaced(page, script_tournament.begin("race"), "a")


@pytest.mark.parametrize("episodes", ["0", "7"])
def test_episodes_are_even(episodes, capsys):
    with pytest.raises(SystemExit):
        script_tournament.main(["sumo-1v1", "--episodes", episodes])
    assert f"--episodes {episodes}: must be even and 2 or more" in capsys.readouterr().err
