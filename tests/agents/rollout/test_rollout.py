"""Rollouts and matches of a real arena on the C engine."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import PolicyStack, policy_params, stack_policies
from agents.policy.networks import Actor
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import PlayedEpisodes, Trajectory, Worlds, make_play, scripts_for
from agents.settings import Architecture, HappoConfig
from arenas.arena import Arena

EACH = 6  # worlds in a group
FALLEN = slice(None, None, 2)  # worlds in which, as it is told to them, both robots fell before the first decision
ARCHITECTURE = Architecture((8,), "elu")


@pytest.fixture(scope="module")
def actors(scramble) -> dict[str, Actor]:
    fresh = HappoLearner([20], [2], HappoConfig(ARCHITECTURE), seed=3).actors[0]
    wide = scramble(2, Architecture((24, 5), layer_norm=True))
    return {"a": scramble(0, ARCHITECTURE), "b": scramble(1, ARCHITECTURE), "wide": wide, "fresh": fresh}


@pytest.fixture(scope="module")
def policy(short_sumo: Arena, actors) -> Callable[[str], dict | int]:
    scripts = list(scripts_for(short_sumo, "leatherback"))
    return lambda who: scripts.index(who) if who in scripts else policy_params(actors[who].state_dict())


SEATS = {"blue/0": ["a", "idle", "random", "b", "random"], "red/0": ["pusher", "a", "wide", "centre-holder", "random"]}


@pytest.fixture(scope="module")
def stacks(policy) -> dict[str, PolicyStack]:
    also = [policy("wide")]  # blue has no such policy: with a place for it both are shaped alike
    return {agent: stack_policies([policy(who) for who in seats], also) for agent, seats in SEATS.items()}


@pytest.fixture(scope="module")
def rollout(short_sumo: Arena, short_rollout, stacks) -> tuple[Worlds, Trajectory]:
    worlds = make_reset(short_sumo)(jax.random.split(jax.random.key(0), 5 * EACH))
    fallen = worlds.events["fall"].at[FALLEN].set(True)
    return jax.device_get(
        short_rollout(stacks, worlds._replace(events=worlds.events | {"fall": fallen}), jax.random.key(1))
    )


@pytest.fixture(scope="module")
def trajectory(rollout) -> Trajectory:
    return rollout[1]


@pytest.fixture(scope="module")
def played_on(rollout, short_rollout, stacks) -> tuple[Worlds, Trajectory]:
    """The worlds after the trajectory, and the trajectory that follows."""
    worlds = rollout[0]
    return worlds, jax.device_get(short_rollout(stacks, jax.tree.map(jnp.array, worlds), jax.random.key(2))[1])


def acting(trajectory: Trajectory, who: str):
    """Observations, actions and log densities wherever `who` acted, (T, EACH, ...) each."""
    for agent, seats in SEATS.items():
        if who in seats:
            k = seats.index(who)
            fields = (trajectory.observations, trajectory.actions, trajectory.log_probs)
            yield tuple(field[agent][:, k * EACH : (k + 1) * EACH] for field in fields)


def test_terms_sum_to_their_rewards(trajectory):
    assert {name.partition(".")[0] for name in trajectory.terms} == {"reward"}  # one dense term is the whole
    rewards = sum(values.astype(float) for values in trajectory.terms.values())
    np.testing.assert_allclose(rewards, trajectory.reward, rtol=1e-5, atol=1e-6)
    assert rewards.any()


def test_an_event_has_happened_until_its_episode_ends(trajectory, played_on):
    over = (trajectory.terminated | trajectory.truncated | trajectory.void)[..., None]
    first = np.cumsum(over, axis=0) - over == 0  # (T, N, 1): the episode under way at the start
    fallen = np.zeros_like(over)
    fallen[:, FALLEN] = True
    np.testing.assert_array_equal(trajectory.events["fall"], np.repeat(first & fallen, 2, axis=2))  # rovers do not fall
    np.testing.assert_array_equal(
        trajectory.events["out"].any(2), (trajectory.terminated & (trajectory.score < 1).any(2))
    )
    worlds, later = played_on
    for name, happened in trajectory.events.items():
        np.testing.assert_array_equal(worlds.events[name], happened[-1] & ~over[-1])
        assert later.events[name][0][worlds.events[name]].all()


def test_next_observations_are_the_following_ones_until_an_episode_ends(trajectory):
    over = (trajectory.terminated | trajectory.truncated | trajectory.void)[:-1]
    assert over.any(axis=0).all()
    assert not over.all(axis=0).any()
    for agent in SEATS:
        following, present = trajectory.next_observations[agent][:-1], trajectory.observations[agent][1:]
        np.testing.assert_array_equal(following[~over], present[~over])
        assert (np.abs(following[over] - present[over]).max(axis=-1) > 0.1).all()
        assert (present[over][:, 9] == 0.0).all()  # a new episode's share of time
        assert (present[over][:, :2] == 0.0).all()  # and no last action


def test_observations_hold_the_action_that_was_taken(trajectory):
    for agent in SEATS:
        np.testing.assert_array_equal(trajectory.next_observations[agent][..., :2], trajectory.actions[agent])


def test_decided_games_are_zero_sum_and_pay_what_the_score_says(trajectory):
    decided = trajectory.terminated & (trajectory.score[..., 0] != trajectory.score[..., 1])
    assert decided.sum() > 10
    np.testing.assert_array_equal(trajectory.reward[decided], 2 * trajectory.score[decided] - 1)
    np.testing.assert_array_equal(trajectory.reward[decided].sum(-1), 0.0)
    assert set(trajectory.score[decided][:, 0]) == {0.0, 1.0}
    assert (trajectory.reward[~trajectory.terminated] == 0.0).all()


def test_log_densities_are_what_torch_computes_from_the_same_weights(trajectory, actors):
    for who, groups in {"a": 2, "b": 1, "wide": 1}.items():
        actor = actors[who]
        found = list(acting(trajectory, who))
        assert len(found) == groups
        for observations, actions, log_probs in found:
            with torch.no_grad():
                theirs = actor(torch.tensor(observations)).log_prob(torch.tensor(actions)).sum(-1)
            np.testing.assert_allclose(log_probs, theirs, rtol=1e-4, atol=1e-3)


def test_scripts_act_by_themselves_beside_learned_policies(trajectory, short_sumo):
    for who in ("idle", "pusher", "centre-holder", "random"):
        observations, actions, log_probs = next(acting(trajectory, who))
        assert (log_probs == 0.0).all()
        if who != "random":
            script = jax.vmap(jax.vmap(scripts_for(short_sumo, "leatherback")[who], (0, None)), (0, None))
            expected = script(jnp.asarray(observations), jax.random.key(0))
            np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert np.abs(actions).max() <= 1.0  # random: uniform over the whole range, and never twice the same
    assert 0.5 < actions.std() * 3**0.5 < 1.5
    assert len(np.unique(actions)) > 0.99 * actions.size


def test_every_agent_throws_its_own_dice(trajectory):
    blue, red = (actions[:, -EACH:] for actions in trajectory.actions.values())  # random against random
    assert (blue != red).mean() > 0.99


SEEDS = 24
RECORDED = (SEEDS + 1, 2)


@pytest.fixture(scope="module")
def keys() -> jax.Array:
    """Two groups of worlds with the same keys."""
    return jnp.tile(jax.random.split(jax.random.key(5), SEEDS), 2)


@pytest.fixture(scope="module")
def play(short_sumo: Arena) -> Callable[..., PlayedEpisodes]:
    compiled = make_play(short_sumo, RECORDED)
    return lambda stacks, keys: jax.device_get(compiled(stacks, keys))


@pytest.fixture(scope="module")
def games(play, policy, keys) -> PlayedEpisodes:
    """The same two policies meet from the same keys in both groups."""
    return play(
        {"blue/0": stack_policies([policy("fresh")] * 2), "red/0": stack_policies([policy("pusher")] * 2)}, keys
    )


def test_equal_keys_and_policies_give_equal_games(games):
    for result in (games.score, games.void, games.decisions):
        np.testing.assert_array_equal(result[:SEEDS], result[SEEDS:])
    assert len(set(games.decisions)) > 1
    assert len(set(games.score[:, 0])) > 1


def test_swapping_sides_changes_who_plays_and_not_the_start(play, policy, keys, games):
    swapped = play(
        {
            "blue/0": stack_policies([policy("fresh"), policy("pusher")]),
            "red/0": stack_policies([policy("pusher"), policy("fresh")]),
        },
        keys,
    )
    np.testing.assert_array_equal(swapped.score[:SEEDS], games.score[:SEEDS])
    assert not np.array_equal(swapped.score[SEEDS:], games.score[SEEDS:])
    assert not np.array_equal(swapped.actions["red/0"][:, 0], games.actions["red/0"][:, 0])


def test_every_world_plays_one_episode_and_stops(games, short_sumo):
    assert games.running.shape[0] == short_sumo.timing.decisions
    assert (games.decisions >= 1).all()
    for r, world in enumerate(RECORDED):
        length = games.decisions[world]
        assert games.running[:, r].tolist() == [True] * length + [False] * (len(games.running) - length)
        assert (games.reward[: length - 1, r] == 0.0).all()
        assert (games.reward[length - 1, r] != 0.0).all()
        assert (games.reward[length:, r] == 0.0).all()
        np.testing.assert_array_equal(games.reward[length - 1, r], 2 * games.score[world] - 1)
    assert (games.score.sum(axis=1) == 1.0).all()
    assert not games.void.any()
    assert games.at_fault.shape == games.score.shape
    assert not games.at_fault.any()


def test_an_event_of_an_episode_happened_in_one_of_its_control_steps(games):
    assert set(games.events) == {"fall", "out"}
    for name, happened in games.events.items():
        within = games.running[:, None, :, None] & games.frames.events[name]
        np.testing.assert_array_equal(happened[list(RECORDED)], within.any(axis=(0, 1)))
    lost = games.score == 0.0
    np.testing.assert_array_equal(lost & ~games.events["fall"], games.events["out"] & ~games.events["fall"])


def test_a_world_rests_once_its_episode_is_over(games):
    """On the C engine, which leaves it out of its steps."""
    over = 0
    for r, world in enumerate(RECORDED):
        after = games.frames.qpos[games.decisions[world] :, :, r]
        np.testing.assert_array_equal(
            after, np.broadcast_to(games.frames.qpos[games.decisions[world] - 1, -1, r], after.shape)
        )
        over += len(after)
    assert over


def test_frames_hold_the_terms_that_the_rewards_are_made_of(games):
    terms = sum(term.sum(axis=1) for term in games.frames.rewards.values())  # over the control steps of a decision
    np.testing.assert_allclose(terms, games.reward, atol=1e-6)
    lost = games.frames.events["out"].any(axis=(0, 1))  # (R, teams)
    for r, world in enumerate(RECORDED):
        np.testing.assert_array_equal(lost[r], games.score[world] == 0.0)


def test_frames_are_those_of_the_recorded_worlds(games, keys, short_sumo):
    qpos = games.frames.qpos  # (T, hold, R, nq)
    timing = short_sumo.timing
    assert qpos.shape == (timing.decisions, timing.hold, len(RECORDED), short_sumo.scene.model.nq)
    starts = jax.vmap(lambda key: short_sumo.place(jax.random.split(key)[0])[0])(keys[:SEEDS])
    xy = np.concatenate([i.qpos + np.arange(2) for i in short_sumo.scene.agents.values()])
    for r, world in enumerate(RECORDED):
        # Metres in the first 0.02 s, had it been each of the worlds.
        moved = np.abs(np.asarray(starts) - qpos[0, 0, r])[:, xy].max(axis=1)
        assert moved.argmin() == world % SEEDS
        assert moved.min() < 0.02 < 0.1 < np.sort(moved)[1]
    clock = games.frames.time[:, :, 0].reshape(-1)
    np.testing.assert_allclose(clock, timing.control_interval * (1 + np.arange(len(clock))), atol=1e-4)
    radius = games.frames.markers["ring"][:, :, 0, 2].reshape(-1)
    assert (np.diff(radius[: games.decisions[RECORDED[0]] * timing.hold]) <= 0).all()
    assert radius[0] > radius[-1] > 0


def test_recorded_actions_are_the_recorded_worlds_own(games, policy, keys, short_sumo, play):
    alone = make_play(short_sumo, (0,))(
        {"blue/0": stack_policies([policy("fresh")]), "red/0": stack_policies([policy("pusher")])},
        keys[jnp.array([RECORDED[1]])],
    )
    length = games.decisions[RECORDED[1]]
    for agent in SEATS:
        np.testing.assert_allclose(games.actions[agent][:length, 1], alone.actions[agent][:length, 0], atol=1e-3)
    rng = games.actions["blue/0"][:length, 1]
    assert rng.std(axis=0).min() > 0.2  # fresh noise at every decision
