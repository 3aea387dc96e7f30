"""Soccer's curricula: stages that fit each other, so that every policy goes on from the stage before."""

from dataclasses import replace

import pytest

import arenas
from league.config import experiment as configuration
from league.config import presets
from league.snapshots.transfer import warm_start
from league.snapshots.transfer.warm_start import Source
from storage.records import Player
from storage.store import Store
from tests.league.conftest import call

PRESETS = {"soccer-1v1": presets.PRESETS["soccer-1v1"], "soccer-2v2": presets.PRESETS["soccer-2v2"]}
STAGES = (
    "walk", "ball", "score-easy", "score", "score-leatherback-easy", "score-leatherback", "score-leatherback-far",
    "match",
)  # fmt: skip


def players(config):
    """One player for each team of a stage's arena."""
    teams = config.arena.outline().teams
    rosters = {
        t: "+".join(f"{s.kind}:{s.observation_size}:{s.action_size}" for s in seats) for t, seats in teams.items()
    }
    return [Player(config.league, team, i, "main", roster) for i, (team, roster) in enumerate(rosters.items())]


@pytest.mark.parametrize("name", PRESETS)
def test_stages_lead_from_the_first_step_to_the_matches(name):
    config = PRESETS[name]()
    assert configuration.loads(configuration.dumps(config)) == config
    found = [configuration.stage(config, number) for number in range(len(STAGES))]
    assert tuple(each.league for each in found) == tuple(f"{name}.{stage}" for stage in STAGES)
    assert [each.arena.name for each in found] == [
        "soccer-walk", "soccer-ball", *["soccer-score"] * 2, *["soccer-score-leatherback"] * 3, name
    ]  # fmt: skip
    assert [each.arena.rules.ease for each in found[2:-1]] == [1.0, 0.0, 1.0, 0.0, 0.0]
    assert [each.training.shaping_until for each in found] == [None, None, *[0.9] * 5, None]
    units = [(each.arena.rules.drive_scale, each.arena.rules.steer_scale) for each in found[4:]]
    assert units == [(40.0, 0.5)] * 4  # a policy means the same by its actions wherever it goes on
    assert [each.learner.gae_lambda for each in found] == [*[0.95] * 6, 1.0, 0.99]  # far once the rover scores
    plain, match = arenas.settings(name), found[-1]
    assert match.arena == replace(plain, rules=match.arena.rules, reward=match.arena.reward)
    assert (match.arena.reward != plain.reward) == (name == "soccer-1v1")  # two on two it did not help


def test_one_on_one_the_dense_reward_pays_for_metres_alone_and_fades():
    match = configuration.stage(PRESETS["soccer-1v1"](), len(STAGES) - 1)
    reward = match.arena.reward
    assert (reward.push, reward.approach, reward.ball) == (2.0, 0.5, 0.0)
    assert 0 < match.training.shaping_steps < match.budget.steps
    assert match.training.shaping_until is None  # by steps, since training scores do not rise in self-play
    assert (match.training.opponents.kind, match.training.opponents.past) == ("uniform", 0.5)


@pytest.mark.parametrize("name", PRESETS)
def test_every_policy_goes_on_from_the_newest_stage_of_its_kind(name):
    walk, ball, easy, score, easily, rovers, far, match = (
        players(configuration.stage(PRESETS[name](), number)) for number in range(len(STAGES))
    )
    assert warm_start.warm_starts(ball, [walk])["blue"].actors == (Source(f"{name}.walk", "blue", 0),)
    assert warm_start.warm_starts(easy, [ball, walk])["blue"].actors == (Source(f"{name}.ball", "blue", 0),)
    assert warm_start.warm_starts(score, [easy, ball, walk])["blue"].actors == (
        Source(f"{name}.score-easy", "blue", 0),
    )
    assert warm_start.warm_starts(easily, [score, easy, ball, walk])["blue"].actors == (None,)
    before = [rovers, easily, score, easy, ball, walk]
    assert warm_start.warm_starts(rovers, before[1:])["blue"].actors == (
        Source(f"{name}.score-leatherback-easy", "blue", 0),
    )
    assert warm_start.warm_starts(far, before)["blue"].actors == (Source(f"{name}.score-leatherback", "blue", 0),)
    found, size = warm_start.warm_starts(match, [far, *before]), len(match[0].roster.split("+"))
    assert found["blue"].actors == (Source(f"{name}.score", "blue", 0),) * size
    assert found["red"].actors == (Source(f"{name}.score-leatherback-far", "blue", 0),) * size


@pytest.mark.gpu  # minutes of two cores; test_curriculum_runs.py walks another curriculum
@pytest.mark.timeout(1800)
def test_soccer_is_walked_from_the_first_step_to_the_matches(tmp_path):
    done = call(
        "run", "--preset", "soccer-1v1", "--steps", "1000", "--training.worlds", "16",
        "--training.rollout_length", "16",
        "--rating.worlds", "8", "--rating.pairings", "1", "--rating.episodes_per_pair", "8",
        "--rating.final-episodes-per-pair", "8",
        "--workers.nice", "0", "--budget.rating_time", "10s", cwd=tmp_path, timeout=1700,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for number, name in enumerate(STAGES, 1):
        assert f"Stage {number} of 8, {name}" in done.stdout
    assert "blue: actors go on from soccer-1v1.score's blue/0" in done.stdout
    with Store.open(tmp_path / "league-data") as store:
        assert {p.roster for p in store.players("soccer-1v1.match")} == {"anymal:66:12", "leatherback:24:2"}
        assert not store.jobs("soccer-1v1.match", "failed")
