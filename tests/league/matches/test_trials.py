"""Trials: what a run leaves as files, that the same command goes on, and the means of learning curves."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from experiments import cross_play, trials
from league.config.experiment import default, dumps
from league.config.stages import Stage
from league.snapshots import policy_file
from storage.records import CurvePoint
from tests.league.plans import league_state, match, snapshots, with_matches


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a trial of matching pennies in two stages, from seed 2."""
    place = tmp_path_factory.mktemp("trial")
    config = default("matching-pennies")
    config = replace(
        config, league="other", training=replace(config.training, worlds=8, rollout_length=4),
        rating=replace(config.rating, scripts=()), workers=replace(config.workers, match=0, threads=1),
        stages=(Stage("early", {"budget": {"steps": 64}}), Stage("late", {"training": {"rollout_length": 8}})),
    )  # fmt: skip
    (place / "pennies.toml").write_text(dumps(config))
    words = [str(place / "pennies.toml"), "--seeds", "2", "--within", "300", "--store", str(place / "store")]
    assert trials.main([*words, "--out", str(place / "out"), "--", "--steps", "128"]) == 0
    return place / "out"


@pytest.mark.slow
def test_every_stage_leaves_its_first_and_newest_policies_and_its_curves(found):
    result = json.loads((found / "pennies-2.json").read_text())
    assert list(result["stages"]) == ["early", "late"]
    assert result["stages"]["early"]["ended"] <= result["stages"]["late"]["ended"]
    assert "--league pennies" in result["run"]
    assert str(found.parent / "store") not in result["run"]
    for stage, steps in (("early", 64), ("late", 128)):
        for side in ("blue", "red"):
            player, folder = result["leagues"][f"pennies.{stage}"][side], found / f"pennies.{stage}" / "2"
            first, newest = (policy_file.read(folder / f"{side}{which}.safetensors") for which in ("-0", ""))
            assert (first.about["steps"], newest.about["steps"]) == (0, steps)
            assert (player["steps"], player["curve"][-1]["steps"]) == (steps, steps)
            assert {"score", "reward", "kl"} <= player["curve"][-1].keys()


@pytest.mark.slow
def test_the_policies_play_by_cross_play(found, capsys):
    words = [str(found / "pennies.late"), "--arena", "matching-pennies", "--episodes", "8", "--worlds", "8"]
    assert cross_play.main(words) == 0
    assert "2:blue against 2:red-0" in capsys.readouterr().out


def test_ratings_are_of_snapshots_that_met_the_first_opponents():
    frozen = snapshots(0, 8, 16)
    state = with_matches(league_state(snapshots=frozen), [match("blue@8", "blue@0"), match("red@16", "blue@8")])
    (row,) = trials.rated(state, "blue")
    assert {k: row[k] for k in ("snapshot", "steps", "score", "n")} == {
        "snapshot": "blue@8", "steps": 8 * 8192, "score": 0.5, "n": 128,
    }  # fmt: skip
    assert row["low"] < 0.5 < row["high"]
    assert list(trials.rated(state, "red")) == []


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["sumo-by-teams"], "sumo-by-teams is neither a preset nor a file"),
        (["duel", "duel"], "each once"),
        (["duel", "--seeds", "1", "1"], "each once"),
        (["duel", "--within", "0"], "--within is 0.0"),
        (["duel", "--jobs", "0"], "--jobs is 0"),
    ],
)
def test_what_cannot_be_tried_is_told(words, says, capsys):
    with pytest.raises(SystemExit) as ended:
        trials.main([*words, "--store", "s"])
    assert ended.value.code == 2
    assert says in capsys.readouterr().err


def test_a_curve_has_the_means_of_its_parts():
    points = [CurvePoint("l", "p", k, 10 * k, 0.5 * k, {"score": float(k)} if k > 1 else {}) for k in range(1, 121)]
    parts = list(trials.curve(points))
    assert len(parts) == trials.PARTS
    assert parts[0] == {"iteration": 2, "steps": 20, "seconds": 1.0, "score": 2.0}  # the first has no score
    assert parts[-1] == {"iteration": 120, "steps": 1200, "seconds": 60.0, "score": 119.5}
    assert list(trials.curve([])) == []
