"""Terms for rewards and observations: a reward for standing upright, and the share of the time that is left."""

import jax.numpy as jnp


def upright(arena, before, physics, game):
    """Return for each team, per second, the mean share of the vertical in its robots' upward axes: (teams,)."""
    found = []
    for team in arena.teams:
        ups = []
        for agent in team.agents:
            _, x, y, _ = physics.qpos[arena.scene.agents[agent.name].qpos + 3 :][:4]  # of the attitude's quaternion
            ups.append(1.0 - 2.0 * (x * x + y * y))  # world z of the body's z axis
        found.append(jnp.stack(ups).mean())
    return jnp.stack(found) * arena.timing.control_interval


def time_left(arena, agent, physics, game, actions):
    """Return the share of the episode's time that is left: ()."""
    return 1.0 - physics.time / arena.timing.episode
