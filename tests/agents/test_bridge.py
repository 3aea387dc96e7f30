import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.bridge import common_critic_order, common_critic_size, evaluation_trajectory, team_batch
from agents.rollout.rollout import CriticObservations, Trajectory
from arenas.state import AgentSpec, TeamSpec

T, N = 3, 5
RED = TeamSpec("red", (AgentSpec("red/0", "ant", 2, 1), AgentSpec("red/1", "rover", 3, 2)))
AGENTS = {"blue/0": (4, 1), "red/0": (2, 1), "red/1": (3, 2)}


def encoded(field: int, agent: int, *last: int) -> jnp.ndarray:
    """Numbers (T, N, ...) that tell where they stood: field, agent, time, world, place, one digit each."""
    at = np.indices((T, N, *last)).reshape(2 + len(last), -1)
    places = at[2] if last else 0
    return jnp.asarray(
        (field * 1e4 + agent * 1e3 + at[0] * 100 + at[1] * 10 + places).reshape(T, N, *last), jnp.float32
    )


@pytest.fixture
def trajectory() -> Trajectory:
    def per_agent(field: int, size: int | None):
        return {
            name: encoded(field, a, *([] if size is None else [AGENTS[name][size]])) for a, name in enumerate(AGENTS)
        }

    def living(every: int):
        return {name: jnp.asarray(np.indices((T, N)).sum(0) % every != a) for a, name in enumerate(AGENTS)}

    flags = [jnp.asarray(np.indices((T, N)).sum(0) % 4 == i) for i in range(3)]
    nobody, uncut = jnp.zeros((T, N, 2), bool), jnp.zeros((T, N), bool)
    return Trajectory(
        per_agent(1, 0), per_agent(2, 0), per_agent(3, 1), per_agent(4, None), living(3), living(4),
        encoded(5, 0, 2), encoded(6, 0, 2), encoded(7, 0, 2), *flags, nobody, uncut, jnp.ones((T, N), jnp.int32),
    )  # fmt: skip


@pytest.mark.parametrize("worlds", [slice(None), slice(1, 3), np.array([4, 0, 2])])
def test_a_teams_batch_is_its_agents_in_its_worlds(worlds, trajectory):
    mine = list(range(N))[worlds] if isinstance(worlds, slice) else worlds.tolist()
    batch = jax.tree.map(lambda tensor: tensor.cpu(), team_batch(trajectory, RED, 1, worlds, shaping=0.5))

    def expected(field: int, agent: int, *last: int) -> np.ndarray:
        return np.asarray(encoded(field, agent, *last))[:, mine]

    for i, agent in enumerate((1, 2)):
        observed, acted = AGENTS[f"red/{i}"]
        np.testing.assert_array_equal(batch.observations[i], expected(1, agent, observed))
        np.testing.assert_array_equal(batch.next_observations[i], expected(2, agent, observed))
        np.testing.assert_array_equal(batch.actions[i], expected(3, agent, acted))
        np.testing.assert_array_equal(batch.log_probs[i], expected(4, agent))
        np.testing.assert_array_equal(batch.alive[i], (np.indices((T, N)).sum(0) % 3 != agent)[:, mine])
        np.testing.assert_array_equal(batch.next_alive[i], (np.indices((T, N)).sum(0) % 4 != agent)[:, mine])
    np.testing.assert_array_equal(batch.rewards, expected(5, 0, 2)[..., 1] + 0.5 * expected(6, 0, 2)[..., 1])
    for i, flag in enumerate((batch.terminated, batch.truncated, batch.void)):
        np.testing.assert_array_equal(flag, (np.indices((T, N)).sum(0) % 4 == i)[:, mine])
    assert [len(x) for x in batch[:6]] == [2] * 6


def test_who_breaks_physics_has_lost_and_the_others_know_nothing_of_it(trajectory):
    void, blamed = np.array(trajectory.void), np.zeros((T, N, 2), bool)
    blamed[..., 1] = void & (np.arange(N) < 3)
    assert 0 < blamed.sum() < void.sum()
    told = trajectory._replace(at_fault=jnp.asarray(blamed), reward=trajectory.reward.at[void].set(np.nan))

    batch = team_batch(told, RED, 1, slice(None), shaping=0.5, void_penalty=2.0)
    own = blamed[..., 1]
    assert (np.asarray(batch.rewards.cpu())[own] == -2.0).all()
    assert np.asarray(batch.terminated.cpu())[own].all()
    np.testing.assert_array_equal(batch.void.cpu(), void & ~own)
    plain = team_batch(trajectory, RED, 1, slice(None), shaping=0.5)
    np.testing.assert_array_equal(batch.rewards.cpu()[~void], plain.rewards.cpu()[~void])
    np.testing.assert_array_equal(batch.terminated.cpu()[~void], plain.terminated.cpu()[~void])

    blue = TeamSpec("blue", (AgentSpec("blue/0", "ant", 4, 1),))
    assert np.array_equal(team_batch(told, blue, 0, slice(None), shaping=0.5).void.cpu(), void)


def test_a_critic_of_the_whole_state_gets_it_behind_what_its_team_sees_with_what_its_team_earned(trajectory):
    whole, mine = tuple(encoded(field, 0, 4) for field in (8, 9)), np.array([4, 0])
    batch = team_batch(trajectory._replace(whole=whole), RED, 1, mine, shaping=0.5, privileged=True)
    (side,) = batch.critic_views
    sights = (side.seen, batch.observations, batch.alive), (side.next_seen, batch.next_observations, batch.next_alive)
    for state, (seen, own, alive) in zip(whole, sights, strict=True):
        shown = [np.where(a.cpu()[..., None], o.cpu(), 0.0) for o, a in zip(own, alive, strict=True)]
        np.testing.assert_array_equal(seen.cpu(), np.concatenate([*shown, state[:, mine]], -1))
    assert not all(alive.all() for alive in batch.alive)
    assert all(x is y for x, y in zip(side[2:], (batch.rewards, batch.terminated, batch.void), strict=True))
    assert not team_batch(trajectory, RED, 1, slice(None), shaping=0.5).critic_views


BLUE = TeamSpec("blue", (AgentSpec("blue/0", "ant", 4, 1),))


def test_a_common_critic_learns_from_every_team_by_its_own_rewards_and_is_told_whose_they_are(trajectory):
    blamed = np.zeros((T, N, 2), bool)
    blamed[..., 1] = np.array(trajectory.void)
    told = trajectory._replace(at_fault=jnp.asarray(blamed))
    mine = np.array([4, 0])
    batch = team_batch(told, RED, 1, mine, shaping=0.5, common=(BLUE, RED))
    assert common_critic_size((BLUE, RED)) == 2 + 4 + 2 + 3
    for side, index in zip(batch.critic_views, (1, 0), strict=True):
        alone = team_batch(told, (BLUE, RED)[index], index, mine, shaping=0.5)
        for ours, theirs in zip(side[2:], (alone.rewards, alone.terminated, alone.void), strict=True):
            np.testing.assert_array_equal(ours.cpu(), theirs.cpu())
        seen = [np.broadcast_to(np.eye(2)[index], (T, 2, 2))]  # unlike rosters: always blue's, then red's
        for field, found in ((1, side.seen), (2, side.next_seen)):
            agents = [encoded(field, a, AGENTS[name][0])[:, mine] for a, name in enumerate(AGENTS)]
            np.testing.assert_array_equal(found.cpu(), np.concatenate([*seen, *agents], -1))
    assert batch.critic_views[0].terminated.any() and not batch.critic_views[0].void.any()  # noqa: PT018  (who breaks it has lost)
    assert batch.critic_views[1].void.any()


@pytest.mark.parametrize("index", [0, 1])
def test_what_is_judged_is_seen_as_what_is_learnt_from(trajectory, index):
    """Also where some are out of the game, and of others, of the whole state and of what is common to all."""
    teams, whole = (BLUE, RED), tuple(encoded(field, 0, 4) for field in (8, 9))
    judged = evaluation_trajectory(
        CriticObservations(trajectory.observations, trajectory.alive, whole[:1]), teams, recurrent=True
    )
    for more in ({"others": [teams[1 - index]]}, {"privileged": True}, {"common": teams}):
        found, learnt = (
            team_batch(each, teams[index], index, slice(None), shaping=0.5, **more)
            for each in (judged, trajectory._replace(whole=whole))
        )
        for name in ("observations", "alive", "others", "others_alive"):
            for x, y in zip(getattr(found, name), getattr(learnt, name), strict=True):
                np.testing.assert_array_equal(x.cpu(), y.cpu())
        for x, y in zip(found.critic_views, learnt.critic_views, strict=True):
            np.testing.assert_array_equal(x.seen.cpu(), y.seen.cpu())
        assert found.first[0][0].all()
        assert not found.first[0][1:].any()
        assert not found.void.any()


def test_teams_of_one_roster_see_themselves_in_one_place():
    ants, rovers = ((AgentSpec("a", "ant", 4, 1),), (AgentSpec("r", "rover", 4, 1),))
    teams = [TeamSpec(str(i), agents) for i, agents in enumerate((rovers, ants, ants, rovers))]
    assert [common_critic_order(teams, t) for t in range(4)] == [[0, 1, 2, 3], [0, 1, 2, 3], [0, 2, 1, 3], [3, 1, 2, 0]]
    assert [common_critic_order(teams[:2], t) for t in range(2)] == [[0, 1], [0, 1]]
