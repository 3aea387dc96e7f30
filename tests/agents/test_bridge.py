import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.bridge import team_batch
from agents.rollout import Trajectory
from arenas.arena import AgentSpec, TeamSpec

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

    flags = [jnp.asarray(np.indices((T, N)).sum(0) % 3 == i) for i in range(3)]
    return Trajectory(
        per_agent(1, 0), per_agent(2, 0), per_agent(3, 1), per_agent(4, None),
        encoded(5, 0, 2), encoded(6, 0, 2), encoded(7, 0, 2), *flags,
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
    np.testing.assert_array_equal(batch.rewards, expected(5, 0, 2)[..., 1] + 0.5 * expected(6, 0, 2)[..., 1])
    for i, flag in enumerate((batch.terminated, batch.truncated, batch.void)):
        np.testing.assert_array_equal(flag, (np.indices((T, N)).sum(0) % 3 == i)[:, mine])
    assert [len(x) for x in batch[:4]] == [2] * 4
