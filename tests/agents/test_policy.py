"""The same weights act in JAX and learn in torch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from agents.bridge import to_jax
from agents.networks import ACTIVATIONS, Actor, Architecture
from agents.policy import distribution, learned, sample, scripted, stack


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_jax_and_torch_agree_for_every_stacked_policy(activation, layer_norm, scramble):
    actors = [scramble(seed, Architecture((9, 7), activation, layer_norm)) for seed in range(3)]
    params = stack(to_jax([actor.state_dict() for actor in actors]))
    observations = jax.random.normal(jax.random.key(0), (3, 11, 20))
    mean, std = jax.vmap(distribution)(params, observations)
    actions, log_probs = jax.vmap(sample)(params, observations, jax.random.split(jax.random.key(1), (3, 11)))

    for k, actor in enumerate(actors):
        with torch.no_grad():
            theirs = actor(torch.tensor(np.asarray(observations[k])))
            densities = theirs.log_prob(torch.tensor(np.asarray(actions[k]))).sum(-1)
        np.testing.assert_allclose(mean[k], theirs.mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(np.broadcast_to(std[k], (11, 2)), theirs.stddev, rtol=1e-5)
        np.testing.assert_allclose(log_probs[k], densities, rtol=1e-4, atol=1e-4)
    assert not np.allclose(mean[0], mean[1])


@pytest.mark.parametrize("layer_norm", [False, True])
def test_every_name_and_number_crosses_both_ways(layer_norm, scramble):
    architecture = Architecture((9, 7), "elu", layer_norm)
    state = scramble(0, architecture).state_dict()
    (policy,) = to_jax([state])
    assert int(policy.pop("script")) == 0
    back = Actor(20, 2, architecture, initial_std=0.1)
    back.load_state_dict({name: torch.tensor(np.asarray(array)) for name, array in policy.items()}, strict=True)
    assert all(torch.equal(tensor, state[name]) for name, tensor in back.state_dict().items())
    assert all(str(array.dtype) == str(state[name].dtype).removeprefix("torch.") for name, array in policy.items())


def test_a_policy_in_jax_does_not_change_while_torch_goes_on_learning(scramble):
    actor = scramble(0, Architecture((8,)))
    (policy,) = to_jax([actor.state_dict()])
    before = np.array(policy["mean.weight"])
    with torch.no_grad():
        actor.mean.weight += 1.0
    np.testing.assert_array_equal(policy["mean.weight"], before)


def test_a_fresh_policy_has_the_wanted_deviation_and_hardly_a_mean():
    with torch.random.fork_rng(devices=[]):
        actor = Actor(20, 2, Architecture(), initial_std=0.3)
    mean, std = distribution(*to_jax([actor.state_dict()]), jax.random.normal(jax.random.key(0), (256, 20)))
    np.testing.assert_allclose(std, 0.3, rtol=1e-6)
    assert float(jnp.abs(mean).max()) < 0.1


def test_samples_have_the_distribution_that_they_are_drawn_from(scramble):
    (policy,) = to_jax([scramble(3, Architecture((8,))).state_dict()])
    observation = jax.random.normal(jax.random.key(0), (20,))
    n = 40_000
    observations = jnp.broadcast_to(observation, (n, 20))
    actions, _ = sample(policy, observations, jax.random.split(jax.random.key(1), n))
    mean, std = distribution(policy, observation[None])
    z = np.asarray((actions - mean) / std)  # (n, 2), standard normal
    error = 5 / np.sqrt(n)  # five standard errors of a mean or a correlation
    assert np.abs(z.mean(0)).max() < error
    assert np.abs(z.std(0) - 1).max() < error
    assert abs(np.corrcoef(z.T)[0, 1]) < error


def test_equal_keys_give_equal_actions(scramble):
    (policy,) = to_jax([scramble(3, Architecture((8,))).state_dict()])
    keys = jax.random.split(jax.random.key(1), 2)[jnp.array([0, 1, 0])]
    actions, _ = sample(policy, jnp.zeros((3, 20)), keys)
    np.testing.assert_array_equal(actions[0], actions[2])
    assert not np.array_equal(actions[0], actions[1])


@pytest.mark.parametrize("other", [Architecture((8, 8)), Architecture((9,)), Architecture((8,), layer_norm=True)])
def test_policies_of_different_shapes_cannot_be_stacked(other, scramble):
    policies = [learned(scramble(0, a).state_dict()) for a in (Architecture((8,)), other)]
    with pytest.raises(ValueError, match="different network shapes"):
        stack([policies[0], scripted(1), policies[1]])


def test_scripts_take_the_shapes_of_their_learned_peers(scramble):
    policy = learned(scramble(0, Architecture((8,))).state_dict())
    stacked = stack([scripted(2), policy, scripted(0)])
    assert stacked["script"].tolist() == [3, 0, 1]
    assert {name: array.shape[1:] for name, array in stacked.items()} == {k: v.shape for k, v in policy.items()}
    np.testing.assert_array_equal(stacked["mean.weight"][1], policy["mean.weight"])
    assert stack([scripted(2), scripted(1)])["script"].tolist() == [3, 2]
