"""Over how many iterations the rewards are averaged that end a stage."""

from dataclasses import replace

import pytest

from league.config.sections import Budget
from league.scheduling import curriculum
from league.scheduling.episode_lengths import averaged_iterations, longest_episode
from storage.records import Checkpoint, CurvePoint
from tests.league.leagues import filled, finish
from tests.league.plans import training


def lasting(episode: float, **budget):
    """Training whose longest episodes take so many seconds, with 10 decisions a second and 32 in an iteration."""
    config = replace(training(rollout_length=32), league="cup", budget=Budget(**budget))
    return replace(config, arena=replace(config.arena, rules=replace(config.arena.rules, episode=episode)))


@pytest.mark.parametrize(("episode", "iterations"), [(10.0, 10), (32.0, 10), (32.1, 11), (100.0, 32)])
def test_rewards_are_averaged_over_one_longest_episode_at_least(episode, iterations):
    config = lasting(episode, reward=1.0)
    assert longest_episode(config) == round(10 * episode)
    assert averaged_iterations(config) == iterations
    assert f"is 1 over {iterations} iterations" in curriculum.until(config)
    assert averaged_iterations(lasting(episode, success=0.9)) == Budget(success=0.9).window
    assert averaged_iterations(lasting(episode, steps=1)) == 0


def test_a_stage_does_not_end_by_the_reward_of_its_shortest_episodes(tmp_path):
    """Each decision costs 0.01: ten iterations see only those that fall early, which costs less than to go on."""
    values = {"reward": -0.01, "episodes": 9.0, "score": 0.0}
    points = [
        CurvePoint("cup", "blue", i, 100 * i, float(i), values | {"length": 1000.0 if i < 32 else 100.0})
        for i in range(5, 41)
    ]
    with filled(tmp_path / "store") as store:
        base = store.checkpoint("cup", "blue").digest
        newest = Checkpoint("cup", "blue", base, 4000, 40, 40.0)
        finish(store, curves=points, checkpoints=[newest], bases={"blue": base})
        short, long = (curriculum.stage_state(store, lasting(each, reward=-2.0)).rewards for each in (10.0, 100.0))
    assert short == {"blue": pytest.approx(-1.9)}
    assert long == {"blue": pytest.approx(-7.469, abs=1e-3)}
