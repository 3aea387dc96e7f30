"""Policies over skills in JAX: the strategy's command, how long it lasts, and the action that its skills answer with.

The memory of such a policy (N, 1 + choice) is the number of decisions for which the present command still lasts, and
what the strategy chose. `agents.policy.skill_arrays` describes the arrays.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from agents.policy.skill_arrays import choice_size, is_over_skills, skill_count, skill_of

Params = dict[str, Array]
Answer = Callable[[Params, Array], Array]
"""Parameters of a network and its observations (n, obs) -> its mean actions (n, act)."""


def command_memory_size(params: Params) -> int:
    """Return the width of the memory of a policy over skills; 0 of any other."""
    return 1 + params["mean.bias"].shape[-1] if is_over_skills(params) else 0


def held_choice(
    params: Params, new: Array, memory: Array, first: Array, tick: Array | None = None
) -> tuple[Array, Array]:
    """Return the strategy's choice (n, choice) in force, and the memory (n, 1 + choice) after this decision.

    A choice lasts for `skill.every` decisions, or until the episode ends: `first` (n,) bool marks where one begins.
    With a `tick` () int, the number of this decision in a rollout, a new choice is made in all worlds at each multiple
    of `skill.every`, so that they choose together, whenever their episodes began.
    """
    left, held = memory[:, 0], memory[:, 1 : 1 + new.shape[-1]]
    every = jnp.maximum(params["skill.every"], 1)
    due = first | (left < 1)
    if tick is not None:
        due = due | (tick % every == 0)
    choice = jnp.where(due[:, None], new, held)
    left = jnp.where(due, every.astype(new.dtype), left) - 1
    return choice, jnp.concatenate([left[:, None], choice], axis=-1)


def skilled_actions(params: Params, observations: Array, choice: Array, answer: Answer) -> Array:
    """Return the robot's actions (n, act) for observations (n, obs) and the strategy's choice (n, choice)."""
    count = skill_count(params)
    if not count:
        return choice
    size = choice.shape[-1] - choice_size(0, count)
    command = params["skill.reach"] * jnp.clip(choice[:, :size], -1.0, 1.0)
    nothing = jnp.zeros((len(choice), 1), choice.dtype)  # the last place of both: an input that has none
    seen, commanded = (jnp.concatenate([each, nothing], axis=-1) for each in (observations, command))
    answers = []
    for number in range(count):
        own = skill_of(params, number)
        answers.append(answer(own, seen[:, own["source"]] + own["fill"] + commanded[:, own["target"]]))
    if count == 1:
        return answers[0]
    scores = choice[:, size:]
    chosen = jax.nn.one_hot(jnp.argmax(scores, axis=-1), count, dtype=scores.dtype)
    weights = jnp.where(params["skill.blend"] > 0, jax.nn.softmax(scores, axis=-1), chosen)
    return sum(weights[:, i, None] * each for i, each in enumerate(answers))  # pyright: ignore[reportReturnType]
