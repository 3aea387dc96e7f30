"""Arenas as Gymnasium's environments of one team: rows, ends of episodes, opponents, arrays."""

import copy
import pickle
from dataclasses import replace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.env_match import check_environments_match
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import arenas
from arenas.contract.environments.opponent import opponent_for
from arenas.contract.environments.team_programs import TeamRows
from arenas.errors import ArenaError
from tests.arenas.environments.programs import compilations

RACE, SOLO = "tests/arenas/race.py:race", "tests/arenas/solo.py:solo"


@pytest.fixture(scope="module")
def race():
    """Blue pucks, each of which races a red one that stands still."""
    return arenas.vector(RACE, "blue", "idle", num_envs=4, threads=1)


def to_the_flag(observations):
    return np.clip(10.0 * observations[:, 2:4], -1.0, 1.0)


def test_worlds_restart_in_the_step_that_ends_them_and_tell_the_last_observation(race):
    assert race.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observations, infos = race.reset(seed=2)
    assert race.observation_space.contains(observations)
    assert infos["alive"].shape == (4, 1)
    ended = np.zeros(4, bool)
    for _ in range(race.arena.timing.decisions):
        before = observations
        observations, rewards, terminated, truncated, infos = race.step(to_the_flag(observations))
        np.testing.assert_allclose(rewards, infos["outcome"] + infos["shaping"], rtol=1e-6)
        done = terminated | truncated
        np.testing.assert_array_equal(done, infos["_final_obs"])
        np.testing.assert_array_equal(done, infos["_score"])
        np.testing.assert_array_equal(observations[~done], infos["final_obs"][~done])
        if done.any():  # blue has arrived, and wins; a new episode begins at rest, 2 m away
            assert (np.linalg.norm(infos["final_obs"][done, 2:4], axis=1) < 0.3).all()
            assert (np.linalg.norm(before[done, 2:4], axis=1) > 0.3).all()
            np.testing.assert_allclose(np.linalg.norm(observations[done, 2:4], axis=1), 2.0, rtol=1e-5)
            assert not observations[done, :2].any()
            assert (infos["score"][done] == 1.0).all()
            assert (infos["outcome"][done] == 1.0).all()
        ended |= done
    assert ended.all()


@pytest.fixture(scope="module")
def alone():
    return arenas.single(SOLO, "runner")


def test_a_time_limit_truncates_and_is_no_end_of_the_game(alone):
    alone.reset(seed=0)
    for left in range(alone.arena.timing.decisions, 0, -1):
        _, _, terminated, truncated, info = alone.step(np.zeros(2))
        assert not terminated
        assert truncated == (left == 1)
        assert ("score" in info) == truncated
    assert info["score"] == 0.0  # of one team: a failure
    with pytest.raises(ArenaError, match=r"no episode of .* is under way: call reset"):
        alone.step(np.zeros(2))


def test_what_a_void_world_was_is_not_learnt_from_unless_by_those_at_fault():
    def broken(observations, key):
        """Red's action is no number where the flag lies to the east of it."""
        return {"red/0": jnp.where(observations["red/0"][2] > 0, jnp.nan, jnp.zeros(2))}

    env = arenas.vector(RACE, "blue", broken, num_envs=4, void_penalty=3.0, threads=1)
    before, _ = env.reset(seed=2)
    actions = np.zeros((4, 2))
    actions[0] = np.nan
    red_broke = before[:, 2] - before[:, 4] > 0  # blue's way to the flag less that to red
    assert red_broke.tolist() == [False, False, False, True]
    after, rewards, terminated, truncated, infos = env.step(actions)
    assert infos["void"].tolist() == [True, False, False, True]
    assert terminated.tolist() == [True, False, False, False]
    assert truncated.tolist() == [False, False, False, True]
    assert rewards[[0, 3]].tolist() == infos["outcome"][[0, 3]].tolist() == [-3.0, 0.0]
    np.testing.assert_array_equal(infos["final_obs"][red_broke], before[red_broke])
    assert not infos["_score"].any()
    assert np.isfinite(after).all()


def test_agents_of_a_team_are_parts_of_a_row_or_rows_of_their_own():
    settings = arenas.settings("pursuit")
    settings = replace(settings, prey=2, rules=replace(settings.rules, side=2.5, obstacles=0))
    shared = arenas.vector(settings, "prey", "chaser", num_envs=4, agents="shared", threads=1)
    joint = arenas.vector(settings, "prey", "chaser", num_envs=2, threads=1)
    seen = shared.single_observation_space.shape[0]
    assert joint.single_observation_space.shape == (2 * seen,)
    assert (shared.action_space.shape, joint.action_space.shape) == ((4, 2), (2, 4))
    actions = jnp.arange(8.0)  # of prey/0 and prey/1 in world 0, then in world 1
    for env in (shared, joint):
        rows = TeamRows(env.arena, 1, env is shared).actions(actions.reshape(env.action_space.shape))
        assert rows["prey/0"].tolist() == [[0.0, 1.0], [4.0, 5.0]]
        assert rows["prey/1"].tolist() == [[2.0, 3.0], [6.0, 7.0]]

    shared.reset(seed=1)
    gone = np.zeros(4, bool)
    for _ in range(60):
        rows, *told, infos = shared.step(np.linspace(-1, 1, 8).reshape(4, 2))
        for values in told:  # reward and ends are the team's
            np.testing.assert_array_equal(values[0::2], values[1::2])
        left = ~infos["alive"]
        assert not rows[left].any()
        assert rows[~left].any(axis=1).all()
        gone |= left
    assert gone.any()  # caught prey, while the other was free


@pytest.mark.slow  # snapshots change in tests/league/snapshots/test_frozen_opponent.py
def test_opponents_change_at_a_reset_and_known_ones_without_compiling_again(race):
    def played(opponent):
        observations, _ = race.reset(seed=3, options={"opponent": opponent})
        return np.stack([race.step(to_the_flag(observations))[0] for _ in range(3)])

    still = played("idle")
    step = race._shared.team_step(race._rows, race._opponent)
    assert not np.array_equal(played("sprinter"), still)
    np.testing.assert_array_equal(played("idle"), still)
    assert race._shared.team_step(race._rows, race._opponent) is step
    assert compilations(step) == 1


def test_options_of_stable_baselines_change_the_opponent_of_all_rows_once():
    env = arenas.stable_baselines(RACE, "blue", "idle", num_envs=4, threads=1)

    def played():
        env.seed(3)
        env.reset()
        return np.stack([env.step(np.zeros((4, 2), np.float32))[0] for _ in range(3)])

    still = played()
    env.set_options({"opponent": "sprinter"})
    changed = played()
    assert not np.array_equal(changed, still)
    np.testing.assert_array_equal(played(), changed)  # the opponent stays
    env.set_options([{"opponent": "idle"}, {}, {}, {}])
    with pytest.raises(ArenaError, match="set_options: all rows move in one program, so give one dict for all"):
        env.reset()


@pytest.mark.parametrize("arrays", ["jax", "torch"])
def test_arrays_of_other_libraries_hold_the_same_numbers(arrays, race):
    kind = {"jax": jax.Array, "torch": torch.Tensor}[arrays]
    env = arenas.vector(RACE, "blue", "idle", num_envs=4, arrays=arrays, threads=1)
    (seen, _), (known, _) = env.reset(seed=4), race.reset(seed=4)
    for _ in range(3):
        actions = seen[:, 2:4] * 1.0
        *step, infos = env.step(actions)
        *reference, found = race.step(known[:, 2:4])
        assert all(isinstance(x, kind) for x in (*step, *infos.values()))
        for a, b in zip((*step, *infos.values()), (*reference, *found.values()), strict=True):
            np.testing.assert_array_equal(np.asarray(a), b)
        kept, seen, known = np.asarray(step[0]).copy(), step[0], reference[0]
    env.step(actions)
    np.testing.assert_array_equal(np.asarray(seen), kept)  # the next step left the arrays of this one alone


@pytest.mark.gpu
def test_tensors_stay_on_the_device_of_the_physics_and_hold_what_numpy_holds():
    """On a CPU it takes 20 s and shows the same."""
    device = jax.devices()[0].platform.replace("gpu", "cuda")
    tensors = arenas.vector("sumo-1v1", "blue", "idle", num_envs=64, arrays="torch")
    arrays = arenas.vector("sumo-1v1", "blue", "idle", num_envs=64)
    (seen, _), (known, _) = tensors.reset(seed=0), arrays.reset(seed=0)
    for _ in range(30):
        assert seen.device.type == device
        actions = torch.tanh(seen[:, :2] - 0.5 * seen[:, 2:4])
        given = actions.cpu().numpy().copy()
        seen, reward, terminated, _, infos = tensors.step(actions)
        actions.fill_(torch.nan)  # the step has taken its own
        known, expected, ended, _, told = arrays.step(given)
        np.testing.assert_allclose(reward.cpu().numpy(), expected, atol=1e-3)
        np.testing.assert_array_equal(terminated.cpu().numpy(), ended)
        np.testing.assert_allclose(infos["final_obs"].cpu().numpy(), told["final_obs"], atol=1e-2)
    assert np.isfinite(known).all()


def test_one_world_passes_the_checks_of_gymnasium(alone, recwarn):
    check_env(alone)
    assert [str(w.message) for w in recwarn if "render" not in str(w.message)] == []
    check_environments_match(alone, arenas.single(SOLO, "runner"), num_steps=alone.arena.timing.decisions + 5)


def test_wrappers_of_gymnasium_fit(race):
    env = DictInfoToList(RecordEpisodeStatistics(race))
    observations, _ = env.reset(seed=0)
    ends = []
    for _ in range(race.arena.timing.decisions):
        observations, _, _, _, infos = env.step(to_the_flag(observations))
        ends += [info["episode"] for info in infos if "episode" in info]
    assert ends
    assert all(1 < end["l"] <= race.arena.timing.decisions for end in ends)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: arenas.vector(RACE, "green", "idle"), "has no team 'green'; it has blue, red"),
        (lambda: arenas.vector(RACE, "blue"), "who plays red.*a script .idle, random, sprinter. or league.opponent"),
        (lambda: arenas.vector(RACE, "blue", "x.onnx"), "has no script 'x.onnx'; .* opponent=league.opponent"),
        (lambda: arenas.vector(RACE, "blue", 7), "opponent 7 cannot play"),
        (lambda: arenas.vector(SOLO, "runner", "idle"), "has one team: it takes no opponent"),
        (lambda: arenas.vector(RACE, "blue", "idle", num_envs=0), "num_envs=0: give a whole number of 1 or more"),
        (lambda: arenas.vector(RACE, "blue", "idle", arrays="cupy"), "arrays='cupy': choose numpy, jax or torch"),
        (lambda: arenas.vector(RACE, "blue", "idle", agents="all"), "agents='all': choose joint"),
        (
            lambda: arenas.vector("pursuit", "predators", "runner", agents="shared", num_envs=4, threads=1),
            "each world of predators has 3 rows, so give a multiple of 3",
        ),
        (
            lambda: arenas.vector("sumo-within-team", "blue", "idle", agents="shared", num_envs=4, threads=1),
            "agents of one kind and size, and blue/0 is anymal:56:12, blue/1 is leatherback:14:2",
        ),
        (lambda: arenas.vector(RACE, "blue", "idle").step(np.zeros((1, 2))), "call reset"),
    ],
)
def test_bad_input_is_told_in_one_line(call, line):
    with pytest.raises(ArenaError, match=line) as told:
        call()
    assert "\n" not in str(told.value)


def test_bad_actions_and_opponents_are_told_in_one_line(race):
    race.reset(seed=0)
    for actions, line in (
        (np.zeros((4, 3)), r"actions have the shape \(4, 3\), and the action space has \(4, 2\)"),
        (torch.zeros((4, 2), requires_grad=True), "cannot be taken: .*grad"),
        ("left", "cannot be taken"),
    ):
        with pytest.raises(ArenaError, match=line):
            race.step(actions)
    with pytest.raises(ArenaError, match="reset_mask: worlds restart by themselves"):
        race.reset(options={"reset_mask": np.ones(4, bool)})
    with pytest.raises(ArenaError, match="options: unknown 'oponent'; reset takes 'opponent' alone"):
        race.reset(options={"oponent": "sprinter"})
    wrong = opponent_for(race.arena, race.arena.teams[1], lambda seen, key: {"red/0": jnp.zeros(3)})
    with pytest.raises(ArenaError, match=r"an action \(2,\) of each of red/0; for red/0 it gave \(3,\)"):
        wrong.act((), {"red/0": jnp.zeros((4, 6))}, jax.random.split(jax.random.key(0), 4), (), jnp.ones(4, bool))


def test_an_action_of_one_world_that_is_no_array_is_told_in_one_line(alone):
    alone.reset(seed=0)
    for action, line in (("left", "the action 'left' is no array of numbers"), ([0.0] * 9, r"the shape \(9,\)")):
        with pytest.raises(ArenaError, match=line):
            alone.step(action)


@pytest.mark.parametrize("copied", [pickle.dumps, copy.deepcopy])
@pytest.mark.parametrize("arrays", ["numpy", "torch"])
def test_what_is_compiled_is_neither_pickled_nor_copied_and_a_line_says_so(copied, arrays):
    for env in (
        arenas.vector(RACE, "blue", "idle", num_envs=2, arrays=arrays), arenas.single(RACE, "blue", "idle"),
        arenas.pettingzoo(RACE), arenas.stable_baselines(RACE, "blue", "idle", num_envs=2),
    ):  # fmt: skip
        with pytest.raises(ArenaError, match=r"^an environment of .* cannot be pickled or copied, since .*makes it$"):
            copied(env)


def test_it_is_an_environment_of_gymnasium(race):
    assert isinstance(race, gymnasium.vector.VectorEnv)
    assert race.action_space.shape == (4, 2)
    race.close()


def test_an_opponent_plays_every_other_team_or_each_has_its_own():
    same = arenas.vector("tag", "blue", "tagger", num_envs=8, threads=1)
    mixed = arenas.vector("tag", "blue", {"red": "idle", "green": "tagger"}, num_envs=8, threads=1)
    moved = {}
    for name, env in (("same", same), ("mixed", mixed)):
        env.reset(seed=1)
        for _ in range(5):
            env.step(np.zeros((8, 2)))
        speed = np.asarray(env._carry.state.physics.qvel).reshape(8, -1, 6)[:, :3, :2]
        moved[name] = np.linalg.norm(speed, axis=-1)  # (worlds, pucks)
    assert (moved["same"][:, 0] < 1e-3).all()
    assert (moved["same"][:, 1:] > 0.1).all()
    assert (moved["mixed"][:, :2] < 1e-3).all()
    assert (moved["mixed"][:, 2] > 0.1).all()
    with pytest.raises(ArenaError, match=r"^who plays green\? Give opponent=: a script \(idle, random, chaser"):
        arenas.vector("tag", "blue", {"red": "idle"}, num_envs=2)
    with pytest.raises(ArenaError, match=r"^opponent: pink is none of the other teams, red, green$"):
        arenas.vector("tag", "blue", {"red": "idle", "green": "idle", "pink": "idle"}, num_envs=2)
