"""Policies in JAX: a flat dict of arrays under torch's parameter names, and pure functions of it.

A `PolicyStack` holds the policies that act for one agent in K groups of worlds: learned policies of any network shape,
or scripts of the agent's robot. One call computes all their actions. Policies on the host (`host_policy`) are called
back.

The hidden state of recurrent policies is one array (N, units) per agent, with the state of the policy that acts in each
world. It is as wide as the widest policy of the stack needs, padded with zeros, so that the state of a world keeps its
place whichever policy acts there. Without recurrent policies there is none.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.policy.host_policy import HostPolicy, HostSeats, act_on_host, host_seats
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
    return max((_memory_size(params) for params in stack.parts), default=0)


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


def act(
    stack: PolicyStack, observations: Array, keys: Array, scripts: Sequence[Script] = (), memory: Array | None = None,
    agent: str = "", first: Array | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """Return actions (N, act) and log densities (N,) for observations (N, obs) and one key per world (N,).

    The N worlds are K equal groups, one after the other. The log density of a script and of a policy on the host is 0.
    Learned policies are evaluated for all worlds, others only for their own groups. `memory` (N, units) is the hidden
    state of recurrent policies that `update_memory` returned for these observations. Policies on the host are told the
    agent's name and where an episode begins, `first` (N,) bool (None: everywhere).
    """
    groups = stack.part.shape[0]
    seen, group_keys = observations.reshape(groups, -1, observations.shape[-1]), keys.reshape(groups, -1)
    if stack.parts:
        kept = None if memory is None else memory.reshape(groups, -1, memory.shape[-1])
        action, log_prob = _learned_actions(stack, seen, group_keys, kept)
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
        begins = jnp.ones(group_keys.shape, bool) if first is None else first.reshape(group_keys.shape)
        own, here = act_on_host(stack.host, agent, seen, group_keys, begins), (stack.host.number > 0)[:, None]
        action, log_prob = jnp.where(here[..., None], own, action), jnp.where(here, 0.0, log_prob)
    return action.reshape(-1, action.shape[-1]), log_prob.reshape(-1)


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


def _learned_actions(stack: PolicyStack, seen: Array, group_keys: Array, memory: Array | None) -> tuple[Array, Array]:
    """Return actions (K, n, act) and log densities (K, n), each group's from the part that holds its policy."""
    answers = [jax.vmap(sample)(params, seen, group_keys, memory) for params in stack.parts]
    action, log_prob = answers[0]
    for number, (other, density) in enumerate(answers[1:], start=1):
        here = (stack.part == number)[:, None]
        action = jnp.where(here[..., None], other, action)
        log_prob = jnp.where(here, density, log_prob)
    return action, log_prob


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
