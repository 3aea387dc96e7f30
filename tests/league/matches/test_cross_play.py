"""Cross-play of policies in files: pairs of a known game, the means on and off the diagonal, and how games ended."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.rollout.rollout import PlayedEpisodes
from arenas.state import Frames
from experiments import cross_play
from league.config.experiment import default
from league.config.schema import ConfigError
from storage.errors import StorageError
from tests.league.runs.bench.files import network

HEADS, TAILS = (9.0, -9.0), (-9.0, 9.0)  # means far apart beside a deviation of 0.8
ROSTERS = {"blue": "matcher:1:2", "red": "mismatcher:1:2"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of matching pennies; in each the newest choose alike, and otherwise than both initial policies."""
    found = tmp_path_factory.mktemp("out")
    for seed, newest, initial in (("1", HEADS, TAILS), ("2", TAILS, HEADS)):
        (found / seed).mkdir()
        for side, roster in ROSTERS.items():
            network(found / seed / f"{side}.safetensors", roster, means=newest)
            network(found / seed / f"{side}-0.safetensors", roster, means=initial)
    return found


def test_each_seed_meets_its_first_opponents_and_the_newest_of_every_seed(folder, tmp_path, capsys):
    out = tmp_path / "found.json"
    words = [str(folder), "--arena", "matching-pennies", "--episodes", "16", "--worlds", "8", "--out", str(out)]
    cross_play.main(words)
    found = json.loads(out.read_text())
    scores = {(row["a"], row["b"]): (row["score"]["score"], row["games"]) for row in found["pairs"]}
    of_one = {(f"{n}:blue-0", f"{n}:red-0"): 1.0 for n in (1, 2)}
    of_one |= {(f"{n}:blue", f"{n}:red-0"): 0.0 for n in (1, 2)} | {(f"{n}:red", f"{n}:blue-0"): 1.0 for n in (1, 2)}
    across = {(f"{a}:blue", f"{b}:red"): float(a == b) for a in (1, 2) for b in (1, 2)}
    assert scores == {pair: (score, 16) for pair, score in (of_one | across).items()}
    told = found["cross_play"]
    assert told["scores"] == [[1.0, 0.0], [0.0, 1.0]]
    assert (told["diagonal"], told["off_diagonal"], told["off_diagonal_less_diagonal"]) == (1.0, 0.0, -1.0)
    assert told["low"] < -1.0 < told["high"] < -0.8
    assert str(folder) not in out.read_text()
    assert "2:red against 2:blue-0: 100.0%" in capsys.readouterr().out


def test_initial_policies_alone_by_other_rules(folder, tmp_path):
    out = tmp_path / "found.json"
    words = [str(folder), "--arena", "matching-pennies", "--seeds", "2", "--episodes", "8", "--worlds", "8"]
    cross_play.main([*words, "--initial", "--out", str(out), "--", "--arena.rules.rounds=3"])
    found = json.loads(out.read_text())
    (row,) = found["pairs"]
    assert (row["a"], row["b"], row["games"]) == ("2:blue-0", "2:red-0", 8)
    rules = default("matching-pennies").arena
    hashes = [replace(rules, rules=replace(rules.rules, rounds=n)).build(engine="c").config_hash for n in (1, 3)]
    assert found["rules"] == hashes[1] != hashes[0]
    assert "cross_play" not in found


def test_seeds_without_initial_policies_play_with_their_newest_alone(folder, tmp_path):
    out = tmp_path / "found.json"
    for side in ROSTERS:
        (tmp_path / "1").mkdir(exist_ok=True)
        (tmp_path / "1" / f"{side}.safetensors").write_bytes((folder / "1" / f"{side}.safetensors").read_bytes())
    words = [str(tmp_path), "--arena", "matching-pennies", "--episodes", "8", "--worlds", "8"]
    assert cross_play.main([*words, "--out", str(out)]) == 0
    assert [(row["a"], row["b"]) for row in json.loads(out.read_text())["pairs"]] == [("1:blue", "1:red")]
    with pytest.raises(ConfigError, match="no initial policies"):
        cross_play.main([*words, "--initial"])


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--arena", "matching-pennies", "--worlds", "7"], "even"),
        (["--arena", "matching-pennies", "--worlds", "0"], "even"),
        (["--arena", "anymal-walk"], "1 teams"),
        (["--arena", "matching-pennies", "--", "--arena.colour=red"], "colour"),
        (["--arena", "sumo-1v1", "--seeds", "1", "2"], "leatherback"),
    ],
)
def test_what_cannot_be_played_is_told(folder, words, says, capsys):
    with pytest.raises((SystemExit, StorageError)) as ended:
        cross_play.main([str(folder), *words])
    assert says in capsys.readouterr().err + str(ended.value)


def test_ends_are_the_events_of_the_deciding_step_without_void_games():
    over, hit = np.zeros((3, 2, 4), bool), np.zeros((3, 2, 4, 2), bool)  # decisions, control steps, games, teams
    over[1, 1:, 0] = over[2, :, 0] = over[2, 1:, 1:] = True
    hit[1, 1, 0, 0] = True  # decides the first game
    hit[0, 0, 1, 1] = True  # was long before the second was over
    hit[2, 1, 3, 0] = True  # in a void game
    none = np.zeros(0)
    frames = Frames(none, none, {}, {}, {}, {"hit": hit, "goal": hit[..., ::-1]}, over)
    games = PlayedEpisodes(none, np.array([False, False, False, True]), none, none, frames, {}, none, none)
    assert cross_play.ends(games, ("blue", "red")) == {"blue hit, red goal": 1, "time": 2}
