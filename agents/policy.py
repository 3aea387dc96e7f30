"""Policies as JAX sees them: a flat dict of arrays under torch's parameter names, and pure functions of it.

A `Crew` says who acts for one agent in K groups of worlds: a learned policy, of whatever network shape, or one of the
scripts of the agent's kind. All of a crew act in one call.

What recurrent policies remember is one array for each agent, (N, units): in every world what the policy there does. It
is as wide as the widest of the crew needs, with zeros after what others use, so that whoever sits where, a world's
memory stays in its place. Where nobody can remember anything there is none.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.settings import SQUASH_EDGE, VARIANCE_FLOOR
from arenas.robots.robot import Script

Params = dict[str, Array]

_ACTIVATIONS = (jnp.tanh, jax.nn.relu, jax.nn.elu)  # in the order of settings.ACTIVATIONS


class Crew(NamedTuple):
    """Who acts for one agent in each of K groups of worlds. Make one with `crew`.

    Policies of one network shape are stacked in one part, with zeros in the groups of others. That keeps every group's
    arrays in place whoever sits there, so a compiled rollout serves all crews of the same shapes.
    """

    parts: tuple[Params, ...]  # one for each network shape, its arrays (K, ...)
    part: Array  # (K,) int32: the part that a group's policy is in
    script: Array | None  # (K,) int32: 0 is a learned policy, n the agent's script n - 1; None: no scripts at all


def learned(arrays: Mapping[str, np.ndarray | Array]) -> Params:
    """A policy from an actor's state dict."""
    return {k: jnp.asarray(v) for k, v in arrays.items()}


def crew(policies: Sequence[Params | int], also: Sequence[Params | int] = ()) -> Crew:
    """Seat K policies, one for each group of worlds: a learned one, or the number of a script, counted from 0.

    Each network shape makes one part, and is evaluated for all worlds. Nothing but the set of shapes, and whether there
    are scripts, makes a rollout compile anew: for what `also` names a place is kept though nobody sits there now.
    """
    shapes = sorted({_shape(p) for p in (*policies, *also) if not isinstance(p, int)})
    part = [0 if isinstance(p, int) else shapes.index(_shape(p)) for p in policies]
    columns = []
    for number, shape in enumerate(shapes):
        nobody = {name: np.zeros(size, dtype) for name, size, dtype in shape}
        columns.append(
            tuple(nobody if isinstance(p, int) or at != number else p for p, at in zip(policies, part, strict=True))
        )
    scripts = None
    if any(isinstance(p, int) for p in (*policies, *also)):
        scripts = jnp.asarray([p + 1 if isinstance(p, int) else 0 for p in policies], jnp.int32)
    return Crew(tuple(_stack(column) for column in columns), jnp.asarray(part, jnp.int32), scripts)


def units(members: Crew) -> int:
    """How wide the memory of a crew is; 0 where nobody in it is recurrent."""
    return max((_units(params) for params in members.parts), default=0)


def remember(members: Crew, observations: Array, memory: Array, first: Array) -> Array:
    """What a crew remembers (N, units) once it has seen observations (N, obs), of what it remembered before.

    Nothing from before is remembered where an episode begins, `first` (N,) bool. The worlds are as in `act`.
    """
    groups = members.part.shape[0]
    seen = observations.reshape(groups, -1, observations.shape[-1])
    before = jnp.where(first[:, None], 0.0, memory).reshape(groups, -1, memory.shape[-1])
    after = before
    for number, params in enumerate(members.parts):
        if size := _units(params):
            own = jax.vmap(_gru)(params, jax.vmap(_trunk)(params, seen), before[..., :size])
            own = jnp.pad(own, ((0, 0), (0, 0), (0, before.shape[-1] - size)))
            after = jnp.where((members.part == number)[:, None, None], own, after)
    return after.reshape(memory.shape)


def act(
    members: Crew, observations: Array, keys: Array, scripts: Sequence[Script] = (), memory: Array | None = None
) -> tuple[Array, Array]:
    """Actions (N, act) and log densities (N,) for observations (N, obs) and one key for each world (N,).

    The N worlds are K equal groups, one after the other. A script's density is 0. Learned policies are evaluated for
    all worlds; a script only for the groups in which it sits. Recurrent ones act on what they remember by now, these
    observations included: `memory` is what `remember` made of them.
    """
    groups = members.part.shape[0]
    seen, dice = observations.reshape(groups, -1, observations.shape[-1]), keys.reshape(groups, -1)
    if members.parts:
        kept = None if memory is None else memory.reshape(groups, -1, memory.shape[-1])
        action, log_prob = _learned_actions(members, seen, dice, kept)
    else:
        like = jax.eval_shape(scripts[0], observations[0], keys[0])
        action, log_prob = jnp.zeros((*dice.shape, *like.shape), like.dtype), jnp.zeros(dice.shape)
    if members.script is not None:
        branches = [lambda seen, dice, *own: own, *(_by(script) for script in scripts)]
        action, log_prob = jax.lax.map(
            lambda group: jax.lax.switch(group[0], branches, *group[1:]),
            (members.script, seen, dice, action, log_prob),
        )
    return action.reshape(-1, action.shape[-1]), log_prob.reshape(-1)


def distribution(params: Params, observations: Array, memory: Array | None = None) -> tuple[Array, Array]:
    """Mean (n, act) and standard deviation of the Gaussian of actions for observations (n, obs), before any squashing.

    The deviation is (act,), or (n, act) where the policy makes it depend on what is seen. A recurrent policy needs what
    it remembers by now (n, units).
    """
    if size := _units(params):
        if memory is None:
            raise ValueError("a recurrent policy acts on what it remembers: give it its memory")
        x = _layer_norm(params, "gru.norm", memory[..., :size])
    else:
        x = _trunk(params, observations)
    mean = _linear(x, params["mean.weight"], params["mean.bias"])
    if "deviation.weight" in params:
        logit = _linear(x, params["deviation.weight"], params["deviation.bias"])
    else:
        logit = params["std_logit"]
    return mean, jax.nn.sigmoid(logit) * params["std_scale"]


def _trunk(params: Params, observations: Array) -> Array:
    """Features (n, last hidden layer) of observations (n, obs)."""
    x = (observations - params["trunk.observation_mean"]) / jnp.sqrt(
        jnp.maximum(params["trunk.observation_var"], VARIANCE_FLOOR)
    )
    x = jnp.clip(x, -params["trunk.observation_clip"], params["trunk.observation_clip"])
    x = _layer_norm(params, "trunk.norm.0", x)
    layers = sum(name.startswith("trunk.hidden.") and name.endswith(".weight") for name in params)
    for i in range(layers):
        x = _linear(x, params[f"trunk.hidden.{i}.weight"], params[f"trunk.hidden.{i}.bias"])
        x = jax.lax.switch(params["activation"], _ACTIVATIONS, x)
        x = _layer_norm(params, f"trunk.norm.{i + 1}", x)
    return x


def _units(params: Params) -> int:
    """How many numbers a policy remembers; 0 where it is not recurrent."""
    return params["gru.weight_hh"].shape[-1] if "gru.weight_hh" in params else 0


def _gru(params: Params, x: Array, memory: Array) -> Array:
    """What is remembered (n, units) after features (n, hidden), by the formulas of `agents.networks.GRU`."""
    size = memory.shape[-1]
    news = _linear(x, params["gru.weight_ih"], params["gru.bias_ih"])
    own = _linear(memory, params["gru.weight_hh"], params["gru.bias_hh"])
    gates = jax.nn.sigmoid(news[:, : 2 * size] + own[:, : 2 * size])
    r, z = gates[:, :size], gates[:, size:]
    n = jnp.tanh(news[:, 2 * size :] + r * own[:, 2 * size :])
    return n + z * (memory - n)


def sample(params: Params, observations: Array, keys: Array, memory: Array | None = None) -> tuple[Array, Array]:
    """Actions (n, act) and their log densities (n,) for observations (n, obs) and one key per world (n,).

    A recurrent policy needs what it remembers by now (n, units).
    """
    mean, std = distribution(params, observations, memory)
    noise = jax.vmap(lambda key: jax.random.normal(key, mean.shape[-1:]))(keys)
    if "squash" in params:
        return _squashed(mean, std, mean + std * noise, params["squash"])
    log_density = -0.5 * noise**2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)
    return mean + std * noise, log_density.sum(axis=-1)


def _squashed(mean: Array, std: Array, drawn: Array, limit: Array) -> tuple[Array, Array]:
    """Actions limit·tanh(drawn / limit) and their log densities (n,), from the rounded action, as torch will have it.

    Far out an action has few digits left to say which number was drawn, so that the two densities would differ. Without
    the barrier XLA may compute tanh twice, and round it once this way and once that.
    """
    share = jnp.clip(jnp.tanh(drawn / limit), -SQUASH_EDGE, SQUASH_EDGE)
    actions = jax.lax.optimization_barrier(limit * share)
    share = jnp.clip(actions * (1.0 / limit), -SQUASH_EDGE, SQUASH_EDGE)  # a product rounds alike everywhere
    outer, inner = jnp.log1p(share), jnp.log1p(-share)
    z = (0.5 * limit * (outer - inner) - mean) / std
    log_density = -0.5 * z**2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi) - outer - inner
    return actions, log_density.sum(axis=-1)


def _learned_actions(members: Crew, seen: Array, dice: Array, memory: Array | None) -> tuple[Array, Array]:
    """Actions (K, n, act) and densities (K, n), each group's from the part that its policy is in."""
    answers = [jax.vmap(sample)(params, seen, dice, memory) for params in members.parts]
    action, log_prob = answers[0]
    for number, (other, density) in enumerate(answers[1:], start=1):
        here = (members.part == number)[:, None]
        action = jnp.where(here[..., None], other, action)
        log_prob = jnp.where(here, density, log_prob)
    return action, log_prob


def _by(script: Script) -> Callable[..., tuple[Array, Array]]:
    """A group's actions (n, act) and densities (n,) by a script, in place of a learned policy's."""
    return lambda seen, dice, action, log_prob: (jax.vmap(script)(seen, dice), jnp.zeros_like(log_prob))


def _shape(policy: Params) -> tuple[tuple[str, tuple[int, ...], str], ...]:
    """What two policies must share to be stacked: names, sizes and types of their arrays."""
    return tuple((name, tuple(policy[name].shape), str(policy[name].dtype)) for name in sorted(policy))


@jax.jit
def _stack(policies: tuple[Params, ...]) -> Params:
    """One after the other along a new first axis; in one call, for each array on its own would cost ten times that."""
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *policies)


def _linear(x: Array, weight: Array, bias: Array) -> Array:
    """A layer in full single precision, as torch has it. By default JAX rounds factors to 10 bits on a GPU, and the log
    densities of the policy that acted would differ from those of the one that learns by up to 5e-3 (measured, H200).
    """
    return jnp.matmul(x, weight.T, precision="highest") + bias


def _layer_norm(params: Params, name: str, x: Array) -> Array:
    if f"{name}.weight" not in params:
        return x
    centred = x - x.mean(axis=-1, keepdims=True)
    scaled = centred * jax.lax.rsqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-5)
    return scaled * params[f"{name}.weight"] + params[f"{name}.bias"]
