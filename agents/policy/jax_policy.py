"""Policies in JAX: a flat dict of arrays under torch's parameter names, and pure functions of it.

A `PolicyStack` holds the policies that act for one agent in K groups of worlds: learned policies of any network shape,
or scripts of the agent's robot. One call computes all their actions. Policies on the host (`host_policy`) are called
back.

The hidden state of recurrent policies is one array (N, units) per agent, with the state of the policy that acts in each
world. It is as wide as the widest policy of the stack needs, padded with zeros, so that the state of a world keeps its
place whichever policy acts there. Policies over skills (`agents.policy.skills`) keep their command there. A stack
without either has no such array.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.policy.host_policy import HostPolicy, HostSeats, act_on_host, host_seats
from agents.policy.skill_arrays import is_over_skills, strategy_of
from agents.policy.skills import command_memory_size, held_choice, skilled_actions
from agents.settings import SQUASH_EDGE, VARIANCE_FLOOR
from arenas.robots.robot import Script

Params = dict[str, Array]

_ACTIVATIONS = (jnp.tanh, jax.nn.relu, jax.nn.elu)  # in the order of settings.ACTIVATIONS


class PolicyStack(NamedTuple):
    """Policies of one agent in K groups of worlds. `stack_policies` makes one.

    Policies of one network shape are stacked in one part, with zeros in the groups of other policies. Thus arrays keep
    their shapes whichever policies act, and one compiled rollout serves all stacks of the same network shapes.
    """

    parts: tuple[Params, ...]  # one for each network shape, arrays (K, ...)
    part: Array  # (K,) int32: the part that holds a group's policy
    script: Array | None  # (K,) int32: 0 is a learned policy, n the agent's script n - 1; None: no scripts at all
    host: HostSeats | None = None  # None: no policies on the host at all


class Decision(NamedTuple):
    """Decisions of the policies of an agent in N worlds."""

    actions: Array  # (N, act) that the robot executes
    choices: Array  # (N, choice) what a learner learns: the actions, or of policies over skills their commands
    log_probs: Array  # (N,) of the choices; 0 of scripts and policies on the host
    memory: Array | None  # (N, units) hidden states afterwards, in stacks that need them


def policy_params(arrays: Mapping[str, np.ndarray | Array]) -> Params:
    """Return a policy in JAX from an actor's state dict."""
    return {k: jnp.asarray(v) for k, v in arrays.items()}


def stack_policies(
    policies: Sequence[Params | HostPolicy | int], reserve: Sequence[Params | HostPolicy | int] = ()
) -> PolicyStack:
    """Stack K policies, one for each group of worlds: a learned policy, one on the host, or a script's number from 0.

    Each network shape makes one part, which is evaluated for all worlds. A rollout is recompiled only for another set
    of shapes, or if scripts or policies on the host are added or removed: `reserve` lists policies for which a part is
    kept although none of them acts.
    """
    everyone = (*policies, *reserve)
    shapes = sorted({_shape(p) for p in everyone if not isinstance(p, (int, HostPolicy))})
    part = [0 if isinstance(p, (int, HostPolicy)) else shapes.index(_shape(p)) for p in policies]
    columns = []
    for number, shape in enumerate(shapes):
        empty = {name: np.zeros(size, dtype) for name, size, dtype in shape}
        columns.append(
            tuple(
                empty if isinstance(p, (int, HostPolicy)) or at != number else p
                for p, at in zip(policies, part, strict=True)
            )
        )
    scripts = None
    if any(isinstance(p, int) for p in everyone):
        scripts = jnp.asarray([p + 1 if isinstance(p, int) else 0 for p in policies], jnp.int32)
    sizes = {p.action_size for p in everyone if isinstance(p, HostPolicy)}
    numbers = [p.number if isinstance(p, HostPolicy) else 0 for p in policies]
    host = host_seats(numbers, sizes.pop()) if sizes else None
    return PolicyStack(tuple(_stack(column) for column in columns), jnp.asarray(part, jnp.int32), scripts, host)


def memory_size(stack: PolicyStack) -> int:
    """Return the width of the hidden state of a stack; 0 if no policy is recurrent."""
    return max((_memory_size(params) or command_memory_size(params) for params in stack.parts), default=0)


def update_memory(stack: PolicyStack, observations: Array, memory: Array, first: Array) -> Array:
    """Return the hidden state (N, units) after observations (N, obs), given the state before.

    The state restarts from zeros where an episode begins, `first` (N,) bool. Worlds are ordered as in `act`.
    """
    groups = stack.part.shape[0]
    seen = observations.reshape(groups, -1, observations.shape[-1])
    before = jnp.where(first[:, None], 0.0, memory).reshape(groups, -1, memory.shape[-1])
    after = before
    for number, params in enumerate(stack.parts):
        if size := _memory_size(params):
            own = jax.vmap(_gru)(params, jax.vmap(_trunk)(params, seen), before[..., :size])
            own = jnp.pad(own, ((0, 0), (0, 0), (0, before.shape[-1] - size)))
            after = jnp.where((stack.part == number)[:, None, None], own, after)
    return after.reshape(memory.shape)


def decide(
    stack: PolicyStack, observations: Array, keys: Array, scripts: Sequence[Script] = (), memory: Array | None = None,
    agent: str = "", first: Array | None = None, tick: Array | None = None,
) -> Decision:  # fmt: skip
    """Return the decisions for observations (N, obs) and one key per world (N,).

    The N worlds are K equal groups, one after the other. Learned policies are evaluated for all worlds, others only for
    their own groups. `memory` (N, units) are the hidden states before these observations. `first` (N,) bool marks where
    an episode begins (None: everywhere), and policies on the host are told the agent's name. `tick` () is the number of
    the decision in a rollout, see `held_choice`.
    """
    begins = jnp.ones(keys.shape, bool) if first is None else first
    if memory is not None:
        memory = update_memory(stack, observations, memory, begins)
    groups = stack.part.shape[0]
    seen, group_keys = observations.reshape(groups, -1, observations.shape[-1]), keys.reshape(groups, -1)
    kept, group_first = (
        None if memory is None else memory.reshape(groups, -1, memory.shape[-1]),
        begins.reshape(groups, -1),
    )
    choices = None
    if stack.parts:
        learned = _learned_decisions(stack, seen, group_keys, kept, group_first, tick)
        action, choices, log_prob, kept = learned
    elif stack.host is not None:
        action = jnp.zeros((*group_keys.shape, *stack.host.blank.shape))
        log_prob = jnp.zeros(group_keys.shape)
    else:
        like = jax.eval_shape(scripts[0], observations[0], keys[0])
        action, log_prob = jnp.zeros((*group_keys.shape, *like.shape), like.dtype), jnp.zeros(group_keys.shape)
    if stack.script is not None:
        branches = [lambda seen, group_keys, *own: own, *(_script_branch(script) for script in scripts)]
        action, log_prob = _each_group(
            lambda group: jax.lax.switch(group[0], branches, *group[1:]),
            (stack.script, seen, group_keys, action, log_prob),
        )
    if stack.host is not None:
        own, here = act_on_host(stack.host, agent, seen, group_keys, group_first), (stack.host.number > 0)[:, None]
        action, log_prob = jnp.where(here[..., None], own, action), jnp.where(here, 0.0, log_prob)
    choices = action if choices is None else choices
    return Decision(
        action.reshape(-1, action.shape[-1]), choices.reshape(-1, choices.shape[-1]), log_prob.reshape(-1),
        None if memory is None or kept is None else kept.reshape(memory.shape),
    )  # fmt: skip


def distribution(params: Params, observations: Array, memory: Array | None = None) -> tuple[Array, Array]:
    """Return mean (n, act) and standard deviation of the Gaussian for observations (n, obs), before squashing.

    The deviation is (act,), or (n, act) where the network computes it from observations. A recurrent policy needs its
    hidden state (n, units) after these observations; ValueError without one.
    """
    if size := _memory_size(params):
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
    """Return features (n, last hidden layer) of observations (n, obs)."""
    x = (observations - params["trunk.observation_mean"]) / jnp.sqrt(
        jnp.maximum(params["trunk.observation_var"], VARIANCE_FLOOR)
    )
    x = jnp.clip(x, -params["trunk.observation_clip"], params["trunk.observation_clip"])
    if "trunk.own" in params:
        x = _encode_entities(params, observations, x)
    x = _layer_norm(params, "trunk.norm.0", x)
    layers = sum(name.startswith("trunk.hidden.") and name.endswith(".weight") for name in params)
    for i in range(layers):
        x = _linear(x, params[f"trunk.hidden.{i}.weight"], params[f"trunk.hidden.{i}.bias"])
        x = jax.lax.switch(params["activation"], _ACTIVATIONS, x)
        x = _layer_norm(params, f"trunk.norm.{i + 1}", x)
    return x


def _encode_entities(params: Params, observations: Array, x: Array) -> Array:
    """Return own numbers and each set's mean and maximum, as `agents.policy.entities`, of normalised x (n, obs)."""
    found = [x[:, params["trunk.own"]]]
    for i in range(sum(name.endswith(".index") for name in params)):
        index = params[f"trunk.entities.{i}.index"]
        there = (observations[:, index] != 0).any(axis=-1, keepdims=True)
        rows = jnp.where(there, x[:, index], 0.0)
        there = (rows != 0).any(axis=-1, keepdims=True)
        for layer in range(2):
            name = f"trunk.entities.{i}.layers.{layer}"
            rows = _linear(rows, params[f"{name}.weight"], params[f"{name}.bias"])
            rows = jax.lax.switch(params["activation"], _ACTIVATIONS, rows)
        found.append(jnp.where(there, rows, 0.0).sum(axis=1) / jnp.maximum(there.sum(axis=1), 1))
        most = jnp.where(there, rows, jnp.finfo(rows.dtype).min).max(axis=1)
        found.append(jnp.where(there.any(axis=1), most, 0.0))
    return jnp.concatenate(found, axis=-1)


def _memory_size(params: Params) -> int:
    """Return the size of a policy's hidden state; 0 if it is not recurrent."""
    return params["gru.weight_hh"].shape[-1] if "gru.weight_hh" in params else 0


def _gru(params: Params, x: Array, memory: Array) -> Array:
    """Return the hidden state (n, units) after features (n, hidden), as `agents.policy.networks.GRU` computes it."""
    size = memory.shape[-1]
    news = _linear(x, params["gru.weight_ih"], params["gru.bias_ih"])
    own = _linear(memory, params["gru.weight_hh"], params["gru.bias_hh"])
    gates = jax.nn.sigmoid(news[:, : 2 * size] + own[:, : 2 * size])
    r, z = gates[:, :size], gates[:, size:]
    n = jnp.tanh(news[:, 2 * size :] + r * own[:, 2 * size :])
    return n + z * (memory - n)


def sample(params: Params, observations: Array, keys: Array, memory: Array | None = None) -> tuple[Array, Array]:
    """Return actions (n, act) and their log densities (n,) for observations (n, obs) and one key per world (n,).

    A recurrent policy needs its hidden state (n, units) after these observations.
    """
    mean, std = distribution(params, observations, memory)
    noise = jax.vmap(lambda key: jax.random.normal(key, mean.shape[-1:]))(keys)
    if "squash" in params:
        return _squashed(mean, std, mean + std * noise, params["squash"])
    log_density = -0.5 * noise**2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)
    return mean + std * noise, log_density.sum(axis=-1)


def _squashed(mean: Array, std: Array, drawn: Array, limit: Array) -> tuple[Array, Array]:
    """Return actions limit·tanh(drawn / limit) and their log densities (n,), computed from the rounded action.

    So does torch. Near the limit an action has too few digits to tell the sampled number, so that densities computed
    from the sample would differ from torch's. Without the barrier XLA may compute tanh twice and round the results
    differently.
    """
    share = jnp.clip(jnp.tanh(drawn / limit), -SQUASH_EDGE, SQUASH_EDGE)
    actions = jax.lax.optimization_barrier(limit * share)
    share = jnp.clip(actions * (1.0 / limit), -SQUASH_EDGE, SQUASH_EDGE)  # a product rounds alike everywhere
    outer, inner = jnp.log1p(share), jnp.log1p(-share)
    z = (0.5 * limit * (outer - inner) - mean) / std
    log_density = -0.5 * z**2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi) - outer - inner
    return actions, log_density.sum(axis=-1)


def mean_action(params: Params, observations: Array, memory: Array | None = None) -> Array:
    """Return the mean actions (n, act) for observations (n, obs), squashed if the policy squashes.

    A recurrent policy needs its hidden state (n, units) after these observations.
    """
    mean, _ = distribution(params, observations, memory)
    if "squash" not in params:
        return mean
    return params["squash"] * jnp.clip(jnp.tanh(mean / params["squash"]), -SQUASH_EDGE, SQUASH_EDGE)


def _learned_decisions(
    stack: PolicyStack, seen: Array, keys: Array, memory: Array | None, first: Array, tick: Array | None
) -> tuple[Array, Array | None, Array, Array | None]:
    """Return actions (K, n, act), choices, log densities (K, n) and hidden states, each group's from its own part.

    Choices (K, n, as many as the widest) are None if no part is over skills: they are then the actions.
    """
    skilled = any(map(is_over_skills, stack.parts))
    answers = []
    for params in stack.parts:
        if is_over_skills(params):
            if memory is None:
                raise ValueError("a policy over skills holds its command in its memory: give it one")
            answers.append(jax.vmap(partial(_by_skills, tick))(params, seen, keys, memory, first))
        else:
            action, density = jax.vmap(sample)(params, seen, keys, memory)
            answers.append((action, action, density, memory))
    width = max(choice.shape[-1] for _, choice, *_ in answers)
    action, choice, log_prob, kept = answers[0]
    choice = _widened(choice, width)
    for number, (other, other_choice, density, remembered) in enumerate(answers[1:], start=1):
        here = (stack.part == number)[:, None]
        action = jnp.where(here[..., None], other, action)
        log_prob = jnp.where(here, density, log_prob)
        if skilled:
            choice = jnp.where(here[..., None], _widened(other_choice, width), choice)
            kept = jnp.where(here[..., None], remembered, kept)
    return action, choice if skilled else None, log_prob, kept


def _by_skills(
    tick: Array | None, params: Params, seen: Array, keys: Array, memory: Array, first: Array
) -> tuple[Array, Array, Array, Array]:
    """Return action, choice, log density of a new choice, and memory (n, units) of a policy over skills."""
    new, log_prob = sample(strategy_of(params), seen, keys)
    choice, after = held_choice(params, new, memory, first, tick)
    return skilled_actions(params, seen, choice, mean_action), choice, log_prob, _widened(after, memory.shape[-1])


def _widened(values: Array, width: int) -> Array:
    """Return values (..., n) with zeros up to the width."""
    return jnp.pad(values, (*[(0, 0)] * (values.ndim - 1), (0, width - values.shape[-1])))


def _each_group(function: Callable, groups: tuple[Array, ...]) -> tuple[Array, Array]:
    """Apply a function of one group to all K groups.

    On a CPU one group follows the other, so that each computes its own script alone. On a GPU that loop waits for the
    host K times in each decision; there all groups compute all scripts at once.
    """
    return jax.lax.map(function, groups) if jax.default_backend() == "cpu" else jax.vmap(function)(groups)


def _script_branch(script: Script) -> Callable[..., tuple[Array, Array]]:
    """Return a function that gives a script's actions (n, act) and zero densities (n,) for a learned policy's."""
    return lambda seen, group_keys, action, log_prob: (jax.vmap(script)(seen, group_keys), jnp.zeros_like(log_prob))


def _shape(policy: Params) -> tuple[tuple[str, tuple[int, ...], str], ...]:
    """Return the names, sizes and types of a policy's arrays, which must agree for stacking."""
    return tuple((name, tuple(policy[name].shape), str(policy[name].dtype)) for name in sorted(policy))


@jax.jit
def _stack(policies: tuple[Params, ...]) -> Params:
    """Stack policies along a new first axis, in one call: a call for each array would take ten times as long."""
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *policies)


def _linear(x: Array, weight: Array, bias: Array) -> Array:
    """Apply a linear layer in full single precision, as torch does.

    By default JAX rounds factors to 10 bits on a GPU, and log densities while acting would differ from those while
    learning by up to 5e-3 (measured, H200).
    """
    return jnp.matmul(x, weight.T, precision="highest") + bias


def _layer_norm(params: Params, name: str, x: Array) -> Array:
    if f"{name}.weight" not in params:
        return x
    centred = x - x.mean(axis=-1, keepdims=True)
    scaled = centred * jax.lax.rsqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-5)
    return scaled * params[f"{name}.weight"] + params[f"{name}.bias"]
