"""Tag: who is "it", for how long, what that earns, and the ranking. By hand on the C engine."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.contract.check_run import WORLDS, CheckRun
from arenas.contract.exchange_check import exchangeable, problem
from arenas.games.tag.match import GameState, Tag
from arenas.games.tag.observation import observe, read
from arenas.games.tag.settings import TagRules, TagSettings
from arenas.state import mean_pairwise_score
from tests.arenas.hooks import judging
from tests.arenas.placing import put

TOUCH = 2 * 0.1 + 0.03  # m, between middles
APART = {"blue/0": (0.0, 0.0), "red/0": (1.0, 0.0), "green/0": (0.0, -0.6)}
STEP = 0.025  # s, a control step


@pytest.fixture(scope="module")
def tag() -> Tag:
    return TagSettings().build(engine="c", threads=1)


def state(it=0, held=(0, 0, 0), counts_from=1.0) -> GameState:
    return GameState(jnp.int32(it), jnp.array(held, jnp.int32), jnp.float32(counts_from))


def judged(arena, game, places=APART, time=2.0, before=None):
    now = put(arena, places, time)
    return judging(arena)(put(arena, before, time) if before else now, now, game)


# Who is it ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gap", "tagged"), [(TOUCH - 0.001, True), (TOUCH + 0.001, False)])
def test_a_touch_passes_it_on_and_begins_the_immunity(tag, gap, tagged):
    game, verdict = judged(tag, state(it=0), {**APART, "red/0": (gap, 0.0)})
    assert int(game.it) == (1 if tagged else 0)
    assert float(game.counts_from) == (3.0 if tagged else 1.0)
    assert verdict.events["tag"].tolist() == [False, tagged, False]
    assert verdict.events["tagged"].tolist() == [tagged, False, False]


def test_others_may_touch_each_other_and_only_the_nearest_to_it_is_next(tag):
    near = {"blue/0": (0.0, 0.0), "red/0": (0.21, 0.0), "green/0": (0.0, 0.2)}
    game, _ = judged(tag, state(it=0), near)
    assert int(game.it) == 2
    game, verdict = judged(tag, state(it=2), {**APART, "red/0": (0.1, 0.0)})
    assert int(game.it) == 2
    assert not verdict.events["tag"].any()


@pytest.mark.parametrize(("time", "tagged"), [(1.95, False), (2.0, True)])
def test_no_touch_counts_while_immunity_lasts(tag, time, tagged):
    game, _ = judged(tag, state(it=0, counts_from=2.0), {**APART, "red/0": (0.2, 0.0)}, time)
    assert int(game.it) == (1 if tagged else 0)


# Score and reward -----------------------------------------------------------------------------------------------------


def test_the_puck_that_is_it_is_paid_for_the_step_by_the_others(tag):
    game, verdict = judged(tag, state(it=2, held=(4, 0, 9)))
    assert game.held.tolist() == [4, 0, 10]
    np.testing.assert_allclose(verdict.score, [4 * STEP, 0.0, 10 * STEP], rtol=1e-6)
    np.testing.assert_allclose(verdict.rewards["it"], [-0.2 * STEP / 2, -0.2 * STEP / 2, 0.2 * STEP], rtol=1e-6)
    assert not verdict.terminated
    assert not verdict.rewards["rank"].any()


@pytest.mark.parametrize(
    ("held", "rank"),
    [((10, 100, 289), (-1, 0, 1)), ((0, 0, 399), (-0.5, -0.5, 1)), ((199, 2, 198), (0.5, -1, 0.5))],
)
def test_the_longest_time_wins_at_the_end_and_equal_times_tie(tag, held, rank):
    game, verdict = judged(tag, state(it=2, held=held), time=10.0)
    assert int(game.held.sum()) == 400  # control steps in ten seconds
    assert (bool(verdict.terminated), bool(verdict.truncated)) == (True, False)
    np.testing.assert_allclose(verdict.rewards["rank"], rank)
    np.testing.assert_allclose(mean_pairwise_score(verdict.score), (np.array(rank) + 1) / 2)


def test_a_hint_is_given_for_metres_nearer_to_it_and_for_those_gained_on_the_nearest(tag):
    before = {"blue/0": (0.0, 0.0), "red/0": (0.9, 0.0), "green/0": (0.0, -0.7)}
    _, verdict = judged(tag, state(it=0), before=before)  # red gets 0.1 m farther away, green 0.1 m nearer
    np.testing.assert_allclose(verdict.shapings["approach"], [-0.05, -0.05, 0.05], atol=1e-6)


def test_a_game_without_a_touch_is_won_by_the_first_it_alone(tag):
    world = jax.jit(tag.reset)(jax.random.key(3))
    step, still = jax.jit(tag.step), {f"{team.name}/0": jnp.zeros(2) for team in tag.teams}
    first = int(world.game.it)
    for _ in range(100):
        world = step(world, still)
    assert bool(world.done)
    wanted = np.zeros(3)
    wanted[first] = 10.0
    np.testing.assert_allclose(world.verdict.score, wanted, rtol=1e-6)


# Views and contract ---------------------------------------------------------------------------------------------------


def test_the_others_are_seen_nearest_first_and_not_by_their_team():
    xy, velocity = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, -0.5]]), jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]])
    seen = read(observe(0, xy, velocity, jnp.int32(1), jnp.array([0.0, 0.3, 0.1]), jnp.array(0.5), jnp.array(0.25)))
    np.testing.assert_allclose(seen.gaps, [[0.0, -0.5], [1.0, 0.0]])
    np.testing.assert_allclose([seen.it, seen.it_velocity], [[1.0, 0.0], [2.0, 0.0]])
    own = read(observe(1, xy, velocity, jnp.int32(1), jnp.array([0.0, 0.3, 0.1]), jnp.array(0.5), jnp.array(0.25)))
    assert (float(seen.is_it), float(own.is_it)) == (0.0, 1.0)
    assert not own.it.any()
    assert not own.it_velocity.any()


class Favoured(Tag):
    """The first team scores nothing."""

    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(score=verdict.score.at[0].set(0.0))


class ByTeam(Tag):
    """The others are seen in the order of teams, which a rotation of three keeps and an exchange of two does not."""

    def observe(self, physics, game, actions):
        xy = physics.qpos[self._xy]
        found = super().observe(physics, game, actions)
        return {agent: found[agent].at[12:14].set(xy[(i + 1) % 3] - xy[i]) for i, agent in enumerate(self.robots)}


SHORT = TagSettings(rules=TagRules(episode=1.0, immunity=0.2))


def test_its_three_teams_can_change_places():
    """The contract of arenas (`tests/arenas/contract/test_contract.py`) examines that they do."""
    assert exchangeable(SHORT.build(engine="c", worlds=WORLDS)) == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("arena", "says"), [(Favoured, "the score differs"), (ByTeam, "the observation of blue/0 differs")]
)
def test_three_teams_that_cannot_change_places_fail_the_check(arena, says):
    assert says in problem(CheckRun(arena(SHORT, engine="c"), jax.random.key(0)))


def test_more_pucks_need_a_wider_field():
    assert len(replace(TagSettings(), teams=8).build(engine="c").teams) == 8
    with pytest.raises(ValueError, match=r"too narrow for 8 pucks of radius 0\.1 m to start apart; it must be 1\.21 m"):
        TagSettings(teams=8, rules=TagRules(side=1.0))


@pytest.mark.parametrize(("one", "other", "least"), [("tagger", "idle", 0.9), ("tagger", "chaser", 0.6)])
def test_a_better_script_is_it_for_a_longer_time(one, other, least):
    arena = TagSettings().build(engine="c", worlds=64)
    scripts = arena.scripts()

    @jax.jit
    def play(keys):
        def decide(state, key):
            actions = {
                agent.name: scripts[one if i == 0 else other]["puck"](state.observations[agent.name], key)
                for i, agent in enumerate(arena.agents)
            }
            return arena.step(state, actions), None

        def episode(key):
            return jax.lax.scan(decide, arena.reset(key), jax.random.split(key, arena.timing.decisions))[0]

        return jax.vmap(episode)(keys)

    score = np.asarray(play(jax.random.split(jax.random.key(0), 64)).verdict.score)
    assert mean_pairwise_score(score)[:, 0].mean() > least
