"""HAPPO's update of one team in plain JAX, compiled as one program: the reference for `HappoLearner.learn`'s speed.

Only the default learner: no LayerNorm, squashing, shared actors, running observation statistics, changing learning
rates, or agents that leave the game, and a batch without void decisions. It therefore needs none of the masks in
`agents/learner/happo.py`, which makes it a faster reference. T decisions, N worlds, B = T·N.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jax import Array

from agents.batch import Batch
from agents.learner.happo import HappoLearner, draw_seed
from agents.learner.minibatches import minibatch_orders
from agents.settings import VARIANCE_FLOOR, HappoConfig

Params = dict[str, Array]
Figures = dict[str, Array]
ACTIVATIONS = {"tanh": jnp.tanh, "relu": jax.nn.relu, "elu": jax.nn.elu}
BETAS, EPSILON, NORM_DECAY = (0.9, 0.999), 1e-5, 0.99999  # of Adam (betas, epsilon) and of the value normaliser


class Network(NamedTuple):
    """An actor or a critic under torch's parameter names, with Adam's state."""

    weights: Params
    buffers: Params  # not learnt
    first: Params  # moments of Adam
    second: Params
    steps: Array  # ()


class Share(NamedTuple):
    """An actor's part of a batch, as `agents.batch.Share`, in which every decision counts."""

    observations: Array  # (B, obs)
    actions: Array  # (B, act)
    log_probs: Array  # (B,) of the policy that acted
    MA: Array  # (B,) M·Â


class Team(NamedTuple):
    """Everything that an update changes."""

    actors: tuple[Network, ...]
    critic: Network
    norm: Array  # (3,) of the value normaliser: weighted sums of returns and their squares, and the sum of weights


def team_of(learner: HappoLearner) -> Team:
    """Return a learner's present team. Raises ValueError for settings that this module does not support."""
    c, state = learner.config, learner.save()
    architecture = c.architecture
    kinds = architecture.layer_norm, architecture.squash, architecture.state_std, architecture.recurrent
    if any(kinds) or c.method != "happo":
        raise ValueError("the update in JAX knows plain Gaussian policies and HAPPO only")
    if (
        c.share_actors
        or c.normalise_observations
        or c.target_kl
        or c.desired_kl
        or c.lr_decay_steps
        or not c.value_norm
    ):
        raise ValueError("the update in JAX knows the default learner only")
    if c.precision != "float32":
        raise ValueError("the update in JAX computes in float32 only")
    if c.critic_input != "own" or not c.fixed_order:
        raise ValueError("the update in JAX knows agents in a fixed order and a critic of its own team only")
    norm = jnp.stack([jnp.asarray(state[f"value_norm.{k}"]) for k in ("mean_sum", "square_sum", "weight")])
    actors = (_network(state, f"actor.{i}") for i in range(len(learner.actors)))
    return Team(tuple(actors), _network(state, "critic"), norm)


def _network(state: Mapping[str, np.ndarray], name: str) -> Network:
    own = {k.removeprefix(f"{name}."): jnp.asarray(v) for k, v in state.items() if k.startswith(f"{name}.")}
    learnt = [k for k in own if f"adam.{name}.{k}.step" in state]
    first, second = (
        {k: jnp.asarray(state[f"adam.{name}.{k}.{moment}"]) for k in learnt} for moment in ("exp_avg", "exp_avg_sq")
    )
    buffers = {k: v for k, v in own.items() if k not in learnt}
    return Network(
        {k: own[k] for k in learnt}, buffers, first, second, jnp.asarray(state[f"adam.{name}.{learnt[0]}.step"])
    )


def batch_of(batch: Batch) -> Batch:
    """Return the same batch as JAX arrays."""
    return jax.tree.map(lambda tensor: jnp.asarray(tensor.cpu().numpy()), batch)


def permutations_of(learner: HappoLearner, size: int) -> Array:
    """Return the permutations (agents + 1, epochs, B) of the learner's next update: the actors', then the critic's."""
    rng, on_device = torch.Generator(), torch.Generator(learner.device)
    rng.set_state(learner.rng.get_state())
    on_device.manual_seed(draw_seed(rng))
    drawn = minibatch_orders([size] * (len(learner.actors) + 1), learner.config.epochs, on_device)
    critic, *actors = (np.stack([order.cpu().numpy() for order in each]) for each in drawn)
    return jnp.asarray(np.stack([*actors, critic]))


def gap(one: Team, other: Team) -> float:
    """Return the largest difference of any weight of the actors and the critic."""
    weights = ([network.weights for network in (*team.actors, team.critic)] for team in (one, other))
    return max(float(jnp.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, weights), strict=True))


def draw(key: Array, parts: int, epochs: int, size: int) -> Array:
    """Draw permutations (parts, epochs, B)."""
    keys = jax.random.split(key, parts * epochs)
    return jax.vmap(lambda key: jax.random.permutation(key, size))(keys).reshape(parts, epochs, size)


def make_update(c: HappoConfig) -> Callable[[Team, Batch, Array], tuple[Team, Figures]]:
    """Return `update(team, batch, permutations) -> (team, figures)`, which the caller compiles.

    The figures are means over the update, and `finite`, true if they and all weights and moments are finite.
    """

    def update(team: Team, batch: Batch, permutations: Array) -> tuple[Team, Figures]:
        seen, seen_next = (jnp.concatenate(x, -1) for x in (batch.observations, batch.next_observations))
        mean, std = _statistics(team.norm)
        predictions = _value(team.critic, c, seen)
        values, next_values = predictions * std + mean, _value(team.critic, c, seen_next) * std + mean
        A = _advantages(batch, values, next_values, c)
        returns = A + values
        A_hat = ((A - A.mean()) / (A.std() + 1e-5)).reshape(-1)

        M, actors, per_actor = jnp.ones_like(A_hat), [], []
        for i, actor in enumerate(team.actors):
            rows = _flat((batch.observations[i], batch.actions[i], batch.log_probs[i]))
            share = Share(*rows, M * A_hat)
            moved, figures = _descend(actor, partial(_surrogate, c=c), share, permutations[i], c, c.lr)
            M *= jnp.exp(_log_prob(moved, c, share) - _log_prob(actor, c, share))
            actors.append(moved)
            per_actor.append(figures)

        seen, old, returns = _flat((seen, predictions, returns))
        norm, target = _targets(team.norm, returns[_rows(permutations[-1], c)])
        critic, of_critic = _descend(
            team.critic, partial(_value_loss, c=c), (seen, old), permutations[-1], c, c.critic_lr, (target,)
        )
        after = Team(tuple(actors), critic, norm)
        figures = jax.tree.map(lambda *x: jnp.stack(x).mean(), *per_actor)
        figures |= {f"critic_{k}": v for k, v in of_critic.items()}
        finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves((after, figures))]).all()
        return after, figures | {"finite": finite}

    return update


# The two passes ------------------------------------------------------------------------------------------------------


def _descend(
    network: Network, loss: Callable, data: Any, permutation: Array, c: HappoConfig, lr: float, more: tuple = ()
) -> tuple[Network, Figures]:
    """Do epochs × minibatches steps of Adam on rows of `data`; `more` has minibatches as its first axis."""
    minibatches = (*jax.tree.map(lambda x: x[_rows(permutation, c)], tuple(data)), *more)

    def step(network: Network, rows: tuple) -> tuple[Network, Figures]:
        (_, figures), gradient = jax.value_and_grad(loss, has_aux=True)(network.weights, network, rows)
        norm = jnp.sqrt(sum((g**2).sum() for g in gradient.values()))
        gradient = {k: g * jnp.minimum(1.0, c.max_grad_norm / (norm + 1e-6)) for k, g in gradient.items()}
        return _adam(network, gradient, lr), figures | {"grad_norm": norm}

    network, figures = jax.lax.scan(step, network, minibatches)
    return network, {name: values.mean() for name, values in figures.items()}


def _adam(network: Network, gradient: Params, lr: float) -> Network:
    """Do a step of Adam (Kingma and Ba, 2015), with torch's order of rounding."""
    steps = network.steps + 1
    first = {k: m + (1 - BETAS[0]) * (gradient[k] - m) for k, m in network.first.items()}
    second = {k: BETAS[1] * v + (1 - BETAS[1]) * gradient[k] ** 2 for k, v in network.second.items()}
    size, root = lr / (1 - BETAS[0] ** steps), jnp.sqrt(1 - BETAS[1] ** steps)
    weights = {k: w - size * first[k] / (jnp.sqrt(second[k]) / root + EPSILON) for k, w in network.weights.items()}
    return network._replace(weights=weights, first=first, second=second, steps=steps)


def _rows(permutation: Array, c: HappoConfig) -> Array:
    """Return row numbers of each minibatch, (epochs · minibatches, B / minibatches)."""
    return permutation.reshape(c.epochs * c.minibatches, -1)


def _flat(arrays: Sequence[Array]) -> list[Array]:
    """Reshape arrays (T, N, ...) to (B, ...)."""
    return [x.reshape(-1, *x.shape[2:]) for x in arrays]


# Losses --------------------------------------------------------------------------------------------------------------


def _surrogate(weights: Params, network: Network, rows: tuple, c: HappoConfig) -> tuple[Array, Figures]:
    """Compute the loss of `agents.learner.actor_learner.surrogate_loss`."""
    share = Share(*rows)
    network = network._replace(weights=weights)
    log_ratio = _log_prob(network, c, share) - share.log_probs
    ratio = jnp.exp(log_ratio)
    surrogate = jnp.minimum(ratio * share.MA, jnp.clip(ratio, 1 - c.clip, 1 + c.clip) * share.MA)
    entropy = (0.5 + 0.5 * jnp.log(2 * jnp.pi) + jnp.log(_deviation(network))).sum()
    loss = -surrogate.mean() - c.entropy_coef * entropy
    kl = (ratio - 1 - log_ratio).mean()
    return loss, {"policy_loss": loss, "entropy": entropy, "ratio": ratio.mean(), "kl": kl}


def _value_loss(weights: Params, network: Network, rows: tuple, c: HappoConfig) -> tuple[Array, Figures]:
    """Compute the loss of `agents.learner.critic_learner.value_loss`."""
    seen, old, target = rows
    value = _value(network._replace(weights=weights), c, seen)
    clipped = old + jnp.clip(value - old, -c.clip, c.clip)

    def huber(error: Array) -> Array:
        size = jnp.abs(error)
        return jnp.where(size <= c.huber_delta, 0.5 * error**2, c.huber_delta * (size - 0.5 * c.huber_delta))

    loss = jnp.maximum(huber(target - value), huber(target - clipped)).mean()
    return loss, {"loss": loss}


def _log_prob(network: Network, c: HappoConfig, share: Share) -> Array:
    """Compute log densities (B,) of the actions."""
    std = _deviation(network)
    z = (share.actions - _forward(network, "mean", c, share.observations)) / std
    return (-0.5 * z**2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)).sum(-1)


def _deviation(network: Network) -> Array:
    return jax.nn.sigmoid(network.weights["std_logit"]) * network.buffers["std_scale"]


def _value(network: Network, c: HappoConfig, seen: Array) -> Array:
    return _forward(network, "value", c, seen).squeeze(-1)


def _forward(network: Network, head: str, c: HappoConfig, x: Array) -> Array:
    """Evaluate trunk and head, in full single precision as torch does."""
    weights, fixed = network.weights, network.buffers
    x = (x - fixed["trunk.observation_mean"]) / jnp.sqrt(jnp.maximum(fixed["trunk.observation_var"], VARIANCE_FLOOR))
    x = jnp.clip(x, -fixed["trunk.observation_clip"], fixed["trunk.observation_clip"])

    def linear(name: str, x: Array) -> Array:
        return jnp.matmul(x, weights[f"{name}.weight"].T, precision="highest") + weights[f"{name}.bias"]

    for i in range(len(c.architecture.hidden)):
        x = ACTIVATIONS[c.architecture.activation](linear(f"trunk.hidden.{i}", x))
    return linear(head, x)


# Returns -------------------------------------------------------------------------------------------------------------


def _advantages(batch: Batch, values: Array, next_values: Array, c: HappoConfig) -> Array:
    """Compute `agents.learner.advantages.advantages` (T, N)."""
    deltas = batch.rewards + c.gamma * next_values * ~batch.terminated - values
    going_on = c.gamma * c.gae_lambda * ~(batch.terminated | batch.truncated)

    def back(advantage: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        advantage = at[0] + at[1] * advantage
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(values[0]), (deltas, going_on), reverse=True)[1]


def _targets(norm: Array, returns: Array) -> tuple[Array, Array]:
    """Update the value normaliser by minibatches of returns (S, b); return it and the normalised returns."""

    def see(norm: Array, returns: Array) -> tuple[Array, Array]:
        seen = jnp.stack([returns.mean(), (returns**2).mean(), jnp.ones(())])
        norm = NORM_DECAY * norm + (1 - NORM_DECAY) * seen
        mean, std = _statistics(norm)
        return norm, (returns - mean) / std

    return jax.lax.scan(see, norm, returns)


def _statistics(norm: Array) -> tuple[Array, Array]:
    """Compute `ValueNorm.statistics`: mean and standard deviation (), in units of reward."""
    weight = jnp.maximum(norm[2], 1e-12)
    mean = norm[0] / weight
    std = jnp.sqrt(jnp.maximum(norm[1] / weight - mean**2, 0.01))
    return mean, jnp.where(norm[2] > 0, std, 1.0)
