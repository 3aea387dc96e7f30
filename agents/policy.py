"""Policies as JAX sees them: a flat dict of arrays under torch's parameter names, and pure functions of it.

A policy that is *scripted* has the one leaf `script`, the number of the arena's script plus one; a learned one has
`script` 0. Stacked policies carry a leading axis K: K opponents act in one call, each for its own group of worlds.
"""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

Params = dict[str, Array]

_ACTIVATIONS = (jnp.tanh, jax.nn.relu, jax.nn.elu)  # in the order of networks.ACTIVATIONS
LEARNED = 0


def learned(arrays: Mapping[str, np.ndarray | Array]) -> Params:
    """A learned policy from an actor's state dict."""
    return {**{k: jnp.asarray(v) for k, v in arrays.items()}, "script": jnp.asarray(LEARNED, jnp.int32)}


def scripted(number: int) -> Params:
    """The arena's script `number`, counted from 0."""
    return {"script": jnp.asarray(number + 1, jnp.int32)}


def stack(policies: Sequence[Params]) -> Params:
    """K policies along a new first axis; a scripted one is filled up with zeros in the shapes of its learned peers.

    Raises ValueError if two learned policies differ in their shapes, and so cannot act in one batch.
    """
    template: Params = {}
    for policy in policies:
        shapes = {k: v.shape for k, v in policy.items()}
        if len(policy) > 1 and template and shapes != {k: v.shape for k, v in template.items()}:
            raise ValueError("policies of different network shapes cannot act in one batch: give each its own batch")
        template = policy if len(policy) > 1 else template
    filled = [{**{k: jnp.zeros_like(v) for k, v in template.items()}, **policy} for policy in policies]
    return {k: jnp.stack([policy[k] for policy in filled]) for k in filled[0]}


def distribution(params: Params, observations: Array) -> tuple[Array, Array]:
    """Mean (n, act) and standard deviation (act,) of the actions for observations (n, obs)."""
    x = (observations - params["trunk.observation_mean"]) / jnp.sqrt(params["trunk.observation_var"] + 1e-8)
    x = _layer_norm(params, 0, x)
    layers = sum(name.startswith("trunk.hidden.") and name.endswith(".weight") for name in params)
    for i in range(layers):
        x = _linear(x, params[f"trunk.hidden.{i}.weight"], params[f"trunk.hidden.{i}.bias"])
        x = jax.lax.switch(params["activation"], _ACTIVATIONS, x)
        x = _layer_norm(params, i + 1, x)
    mean = _linear(x, params["mean.weight"], params["mean.bias"])
    return mean, jax.nn.sigmoid(params["std_logit"]) * params["std_scale"]


def sample(params: Params, observations: Array, keys: Array) -> tuple[Array, Array]:
    """Actions (n, act) and their log densities (n,) for observations (n, obs) and one key per world (n,)."""
    mean, std = distribution(params, observations)
    noise = jax.vmap(lambda key: jax.random.normal(key, mean.shape[-1:]))(keys)
    log_density = -0.5 * noise**2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)
    return mean + std * noise, log_density.sum(axis=-1)


def _linear(x: Array, weight: Array, bias: Array) -> Array:
    """A layer in full single precision, as torch has it. By default JAX rounds factors to 10 bits on a GPU, and the log
    densities of the policy that acted would differ from those of the one that learns by up to 5e-3 (measured, H200).
    """
    return jnp.matmul(x, weight.T, precision="highest") + bias


def _layer_norm(params: Params, i: int, x: Array) -> Array:
    if f"trunk.norm.{i}.weight" not in params:
        return x
    centred = x - x.mean(axis=-1, keepdims=True)
    scaled = centred * jax.lax.rsqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-5)
    return scaled * params[f"trunk.norm.{i}.weight"] + params[f"trunk.norm.{i}.bias"]
