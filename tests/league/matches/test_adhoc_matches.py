"""Matches that a person asks for: gates that decide, go on and are told again; exhibitions that count for nobody."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arenas
from league.commands.play import gate
from league.config import presets
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.matches.adhoc_matches import pairing
from league.matches.own_policy import Policy
from league.queries.query import Open
from league.runtime.bootstrap import create
from league.state.league_state import LeagueState
from matchmaking.ratings.sprt import SequentialTest
from storage.recordings.recording import from_bytes
from storage.records import RATED_PURPOSES, Job
from storage.store import Store
from tests.league.conftest import PUCKS, said
from tests.league.leagues import filled, finish, match


def league(folder: Path, settings) -> Path:
    """A store with a league of scripts alone."""
    config = Config(arena=settings, rating=replace(presets.preset("duel").rating, trained=False))
    with Store.open(folder, create=True) as store:
        create(store, config, settings.build(engine="auto", threads=1))
    return folder


@pytest.fixture
def hands(tmp_path):
    return league(tmp_path / "hands", arenas.settings("rock-paper-scissors"))


def log(folder: Path):
    with Store.open(folder) as store:
        return [replace(m, id=0, created=0.0, seconds=0.0) for m in store.matches("main")]


def test_a_gate_accepts_who_is_better_and_rejects_who_is_not(hands, capsys):
    asked = ("--store", str(hands), "--elo1", "200", "--batch", "32")
    code, out, _ = said(capsys, "gate", "paper", "rock", *asked)
    assert code == gate.ACCEPTED
    assert "Accepted: paper is better than rock, by 32 episodes in 16 seed pairs." in out
    assert "seed pairs 0 LL, 0 LD, 0 DD or WL, 0 DW, 16 WW: LLR" in out
    code, out, _ = said(capsys, "gate", "paper", "rock", *asked, "--format", "json")
    told = json.loads(out)
    assert (code, told["decision"], told["a"], told["b"]) == (gate.ACCEPTED, "accept", "paper", "rock")
    assert (told["episodes"], told["pentanomial"], told["llr"] > told["upper"]) == (32, [0, 0, 0, 0, 16], True)
    code, out, _ = said(capsys, "gate", "rock", "paper", *asked)
    assert code == gate.REJECTED
    assert "Rejected: rock is not better than paper" in out
    assert [(m.a, m.b, m.purpose, m.wins, m.losses) for m in log(hands)] == [
        ("paper", "rock", "gate", 32, 0), ("rock", "paper", "gate", 0, 32),
    ]  # fmt: skip


def test_a_gate_in_normalized_elo_is_decided_by_games_of_its_own(hands, capsys):
    asked = ("--store", str(hands), "--elo1", "40", "--batch", "512", "--model", "normalized")
    code, out, _ = said(capsys, "gate", "paper", "random", *asked)  # a third each is won, drawn and lost
    assert code == gate.REJECTED
    assert "Elo 0 against 40 (normalized)" in out
    played = [m for m in log(hands) if m.purpose == "gate"]
    wins, draws, losses = (sum(getattr(m, name) for m in played) for name in ("wins", "draws", "losses"))
    assert all(0.25 < n / (wins + draws + losses) < 0.42 for n in (wins, draws, losses))
    test = SequentialTest(0.0, 40.0, model="normalized")
    assert test.result(gate.paired(played)).decision == "reject"
    with Open(Store.open(hands)) as opened:
        found = pairing(opened, "paper", "random")
        assert [m.seed for m in played] == [gate.seed(found, test, i) for i in range(len(played))]
        assert gate.seed(found, SequentialTest(0.0, 40.0), 0) != played[0].seed


def test_the_games_of_a_gate_count_for_ratings(hands, capsys):
    said(capsys, "gate", "paper", "rock", "--store", str(hands), "--elo1", "200")
    with Open(Store.open(hands)) as opened:
        assert opened.ladder(opened.ladders()[0]).score("paper", "rock").games == 128
        state = LeagueState.of(opened.store, "main")
    assert state.ladder.score("paper", "rock").games == 128
    assert state.played == 0.0  # the time for the league's own rating does not run meanwhile


def test_a_gate_goes_on_where_it_was_and_is_told_again_without_a_game(hands, capsys, tmp_path):
    asked = ("gate", "random", "rock", "--elo1", "40", "--batch", "32", "--store")
    code, out, _ = said(capsys, *asked, str(hands), "--most", "64")
    assert code == gate.UNDECIDED
    assert "Undecided: 64 episodes do not tell whether random is better than rock" in out
    there = log(hands)
    code, out, _ = said(capsys, *asked, str(hands), "--most", "4000")
    assert code in (gate.ACCEPTED, gate.REJECTED)
    whole = log(hands)
    assert whole[:2] == there
    again, told, _ = said(capsys, *asked, str(hands), "--most", "4000")
    assert (again, told.splitlines()[-1]) == (code, out.splitlines()[-1])
    assert log(hands) == whole
    other = league(tmp_path / "other", arenas.settings("rock-paper-scissors"))
    assert said(capsys, *asked, str(other), "--most", "4000")[0] == code
    assert log(other) == whole  # as if it had never been interrupted


def test_another_test_of_the_same_pair_has_games_of_its_own(hands):
    with Open(Store.open(hands)) as opened:
        found = pairing(opened, "paper", "rock")
        one, other = SequentialTest(0, 20), SequentialTest(0, 30)
        seeds = {gate.seed(found, test, number) for test in (one, other) for number in range(3)}
        assert len(seeds) == 6
        rows = {gate.seed(found, one, n): match("paper", "rock", 2, 0) for n in (0, 1, 3)}
        assert len(gate.batches(rows, found, one)) == 2  # the third is not there yet, so the fourth is not its
        assert gate.batches(rows, found, other) == []


def test_the_same_batch_is_filed_once(tmp_path):
    with filled(tmp_path) as store:
        played, job = match("blue@4", "red@4", 6, 2, purpose="gate"), Job("cup", "match", "match:this one")
        assert store.file(job, [played])
        assert not store.file(job, [played])
        assert [m.wins for m in store.matches("cup", RATED_PURPOSES)] == [6]
        assert [j.state for j in store.jobs("cup") if j.key == job.key] == ["done"]
        assert [m.id for m in store.matches("cup")] == [1]
        finish(store, matches=[match("blue@4", "red@4", 1, 0)])
        assert [m.id for m in store.matches("cup")] == [1, 2]


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("gate", "paper", "paper"), "paper and paper are the same policy"),
        (("gate", "paper", "stone"), "There is no snapshot 'stone' here"),
        (("gate", "paper"), "needs B"),
        (("gate", "paper", "rock", "--elo0", "30"), "must be above elo0, which is 30"),
        (("gate", "paper", "rock", "--batch", "7"), "must be even"),
        (("gate", "paper", "rock", "--most", "0"), "--most = 0: must be at least 2"),
        (("play", "paper"), "has several teams: name two snapshots"),
        (("play", "paper", "rock", "--episodes", "0"), "--episodes = 0: must be between 1 and"),
        (("play", "paper", "rock", "--record", "some"), "must be all, or a number up to 100"),
        (("play", "paper", "rock", "--record", "all", "--episodes", "101"), "101 recordings are more than 100"),
        (("play", "paper", "stone"), "There is no snapshot 'stone' here"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_played(args, says, hands, capsys):
    code, out, err = said(capsys, *args, "--store", str(hands))
    assert (code, out) == (2, "")
    assert says in err
    assert len(err.splitlines()) == 1
    assert log(hands) == []


def test_unlike_sides_have_no_gate(tmp_path, capsys):
    pennies = league(tmp_path / "pennies", arenas.settings("matching-pennies"))
    code, _, err = said(capsys, "gate", "heads:blue", "heads:red", "--store", str(pennies))
    assert code == 2
    assert "an even score between unlike sides says nothing" in err
    code, out, _ = said(capsys, "play", "heads:blue", "heads:red", "--episodes", "3", "--store", str(pennies))
    assert code == 0
    assert "3 won, 0 drawn, 0 lost" in out
    code, out, _ = said(
        capsys, "play", "heads:blue", "heads:red", "--episodes", "3", "--format", "json", "--store", str(pennies)
    )
    assert code == 0
    told = json.loads(out)
    assert (told["episodes"], told["voids"], told["recorded_matches"]) == (3, 0, [])  # games without bodies
    assert [(r["name"], r["wins"], r["draws"], r["losses"], r["score"]) for r in told["results"]] == [
        ("heads:blue", 3, 0, 0, 1.0), ("heads:red", 0, 0, 3, 0.0),
    ]  # fmt: skip
    code, _, err = said(capsys, "play", "heads:blue", "tails:blue", "--store", str(pennies))
    assert code == 2
    assert "cannot sit on two sides" in err


def test_an_exhibition_is_recorded_and_counts_for_no_rating(tmp_path, capsys):
    pucks = league(tmp_path / "pucks", arenas.settings(PUCKS[1]))
    asked = ("play", "sprinter", "idle", "--store", str(pucks))
    code, out, _ = said(capsys, *asked, "--episodes", "5", "--record", "3")
    assert code == 0
    assert "Exhibition of sprinter against idle: 5 won, 0 drawn, 0 lost." in out
    took, *events = out.splitlines()[1:4]
    assert 0.1 < float(took.removeprefix("  An episode takes ").removesuffix(" s.")) < 10
    assert events == ["  sprinter, in its episodes: arrival 100 %", "  idle, in its episodes: arrival 0 %"]
    assert [line.strip() for line in out.splitlines()[4:]] == [f"league watch {n} --store {pucks}" for n in (1, 2, 3)]
    with Open(Store.open(pucks)) as opened:
        matches = opened.store.matches("main")
        assert [(m.purpose, m.wins, m.side_wins) for m in matches] == [
            ("exhibition", 3, 2), ("exhibition", 1, 0), ("exhibition", 1, 1),
        ]  # fmt: skip
        shown = [from_bytes(opened.store.blobs.get(str(m.recording))).header for m in matches]
        assert [header.sides for header in shown] == [
            ("sprinter", "idle"), ("idle", "sprinter"), ("sprinter", "idle"),
        ]  # fmt: skip
        assert all(header.outcome.startswith("sprinter wins as") for header in shown)
        assert opened.ladders() == []
        assert not LeagueState.of(opened.store, "main").ladder.payoff.games.any()
    _, out, _ = said(capsys, *asked, "--episodes", "1", "--format", "json")
    told = json.loads(out)
    assert told["recorded_matches"] == [4]
    assert [each["events"] for each in told["results"]] == [{"arrival": 1.0}, {"arrival": 0.0}]
    seeds = {m.seed for m in log(pucks)}
    assert len(seeds) == 2  # another exhibition is another
    _, out, _ = said(capsys, *asked, "--episodes", "4", "--record", "0", "--format", "json")
    won = json.loads(out)["results"][0]
    assert (won["score"], won["score_low"]) == (1.0, pytest.approx(2 / (2 + 1.959964**2)))  # of two seeds, all won
    _, table, _ = said(capsys, "matches", "--store", str(pucks))
    assert "exhibition" in table


# Three teams ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pucks(tmp_path_factory):
    return league(tmp_path_factory.mktemp("pucks") / "pucks", arenas.settings("tag"))


@pytest.mark.slow
def test_an_exhibition_of_three_ranks_them_and_records_each_seating_in_a_match_of_its_own(pucks, capsys):
    asked = ("tagger", "idle", "chaser", "--episodes", "6", "--record", "2", "--store", str(pucks))
    code, out, _ = said(capsys, "play", *asked)
    assert code == 0
    first, *lines = out.splitlines()
    assert first == "Exhibition of tagger, idle, chaser: 6 episodes."
    assert lines[0].startswith("  tagger scores ")
    assert [line.split()[0] for line in lines if "against the others" in line][-1] == "idle"
    with Store.open(pucks) as store:
        matches = store.log("main", "exhibition")
        recordings = [from_bytes(store.blobs.get(m.recording)) for m in matches if m.recording]
        assert store.totals("main", RATED_PURPOSES) == {}
    assert sum(m.episodes for m in matches) == 6
    rotations = {("tagger", "idle", "chaser"), ("idle", "chaser", "tagger"), ("chaser", "tagger", "idle")}
    assert {m.snapshots for m in matches} == rotations
    assert [each.header.sides for each in recordings] == [m.snapshots for m in matches if m.recording]
    for found, recording in zip(matches, recordings, strict=False):
        (ranks,) = found.rankings
        score = recording.header.score
        assert [1 + sum(other > own for other in score) for own in score] == list(ranks)


@pytest.mark.slow
def test_an_exhibition_of_three_has_as_many_episodes_as_asked_by_default_too(pucks, capsys):
    for more, episodes in (((), 2), (("--episodes", "1", "--record", "0"), 1), (("--episodes", "7"), 7)):
        code, out, err = said(capsys, "play", "tagger", "idle", "runner", *more, "--store", str(pucks))
        assert (code, err) == (0, "")
        assert f": {episodes} episode" in out.splitlines()[0]
        games = [int(line.split(" of ")[1].split()[0]) for line in out.splitlines() if "against the others" in line]
        assert games == [2 * episodes] * 3  # two others in each episode


def test_a_policy_of_this_process_plays_two_others_and_says_where_they_are_missing(pucks):
    with Store.open(pucks) as store:
        opened = Open(store, "main")
        still = Policy.from_callable(lambda seen: np.zeros(2))
        score = still.play(opened, "tagger", episodes=7)
        assert (score.games, score.score < 0.5) == (18, True)  # in nine episodes, a multiple of three
        with pytest.raises(ConfigError, match="league main has 3 teams: name an opponent"):
            still.play(opened)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("play", "tagger"), "has several teams: name 3 snapshots"),
        (("play", "tagger", "idle"), "has 3 teams: name 3 snapshots, not 2"),
        (("play", "tagger", "idle", "chaser", "runner"), "has 3 teams: name 3 snapshots, not 4"),
        (("gate", "tagger", "idle"), "has 3 teams, and a gate is for two: `league ratings` ranks its players"),
        (("exploit", "tagger", "--for", "1m"), "has 3 teams, and a bound of exploitability is for two"),
    ],
)
def test_what_does_not_fit_three_teams_is_told_in_one_line(args, says, pucks, capsys):
    code, out, err = said(capsys, *args, "--store", str(pucks))
    assert (code, out) == (2, "")
    assert says in err
    assert err.count("\n") == 1
