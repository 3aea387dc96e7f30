"""Experience at the clock of a strategy: one row for each command instead of one for each decision of the arena.

A command that lasts k decisions is one decision of a semi-Markov process (Sutton, Precup and Singh, 1999): its reward
is r_1 + γ r_2 + … + γ^(k−1) r_k, and what follows it is discounted by γ^k.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from agents.rollout.rollout import Trajectory


@partial(jax.jit, static_argnums=(1, 2))
def at_command_clock(trajectory: Trajectory, every: int, gamma: float) -> Trajectory:
    """Return a trajectory of T / every rows, each of a command that was chosen at a multiple of `every`.

    Where an episode ends, its last command ends with it, and its row tells the end. The next episode's first, shorter
    command is left out: its row would begin before the episode. An episode that was cut within a command bootstraps as
    if the command had lasted, which counts its future by up to γ^(k−1) too low. T is a multiple of `every`.
    """
    windows = jax.tree.map(lambda x: x.reshape(-1, every, *x.shape[1:]), trajectory)
    ends = windows.terminated | windows.truncated | windows.void
    before = jnp.cumsum(ends, axis=1) - ends  # (T / every, every, N) ends within the command before each decision
    own = before == 0
    last = jnp.where(ends.any(axis=1), jnp.argmax(ends, axis=1), every - 1)  # (T / every, N)

    def begin(values: Array) -> Array:
        return values[:, 0]

    def end(values: Array) -> Array:
        index = last.reshape(last.shape[0], 1, last.shape[1], *[1] * (values.ndim - 3))
        return jnp.take_along_axis(values, index, axis=1)[:, 0]

    def total(values: Array) -> Array:
        discounts = gamma ** jnp.arange(every, dtype=values.dtype)
        return (jnp.where(own[..., None], values, 0.0) * discounts[:, None, None]).sum(axis=1)

    return trajectory._replace(
        observations=jax.tree.map(begin, windows.observations), actions=jax.tree.map(begin, windows.actions),
        log_probs=jax.tree.map(begin, windows.log_probs), alive=jax.tree.map(begin, windows.alive),
        next_observations=jax.tree.map(end, windows.next_observations),
        next_alive=jax.tree.map(end, windows.next_alive),
        reward=total(windows.reward), shaping=total(windows.shaping), score=end(windows.score),
        terminated=end(windows.terminated), truncated=end(windows.truncated), void=end(windows.void),
        at_fault=end(windows.at_fault), cut=end(windows.cut), age=begin(windows.age),
        whole=(begin(windows.whole[0]), end(windows.whole[1])) if windows.whole else (),
        memories=None, causes=None if windows.causes is None else end(windows.causes),
        settled=None if windows.settled is None else end(windows.settled),
    )  # fmt: skip
