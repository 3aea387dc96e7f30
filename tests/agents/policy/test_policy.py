"""The same weights act in JAX and learn in torch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from agents.bridge import to_jax
from agents.policy.jax_policy import PolicyStack, decide, distribution, policy_params, sample, stack_policies
from agents.policy.networks import Actor
from agents.settings import ACTIVATIONS, Architecture

# Compiled once for each shape: call by call, JAX would compile every operation by itself.
distributions_of = jax.jit(jax.vmap(distribution))  # of a stack of policies
draw_each = jax.jit(jax.vmap(sample))
draw = jax.jit(sample)


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_jax_and_torch_agree_for_every_stacked_policy(activation, layer_norm, scramble):
    actors = [scramble(seed, Architecture((9, 7), activation, layer_norm)) for seed in range(3)]
    (params,) = stack_policies(to_jax([actor.state_dict() for actor in actors])).parts
    observations = jax.random.normal(jax.random.key(0), (3, 11, 20))
    mean, std = distributions_of(params, observations)
    actions, log_probs = draw_each(params, observations, jax.random.split(jax.random.key(1), (3, 11)))

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
        torch.manual_seed(0)
        actor = Actor(20, 2, Architecture(), initial_std=0.3)
    mean, std = distribution(*to_jax([actor.state_dict()]), jax.random.normal(jax.random.key(0), (256, 20)))
    np.testing.assert_allclose(std, 0.3, rtol=1e-6)
    assert float(jnp.abs(mean).max()) < 0.1


def test_samples_have_the_distribution_that_they_are_drawn_from(scramble):
    (policy,) = to_jax([scramble(3, Architecture((8,))).state_dict()])
    observation = jax.random.normal(jax.random.key(0), (20,))
    n = 40_000
    observations = jnp.broadcast_to(observation, (n, 20))
    actions, _ = draw(policy, observations, jax.random.split(jax.random.key(1), n))
    mean, std = distribution(policy, observation[None])
    z = np.asarray((actions - mean) / std)  # (n, 2), standard normal
    error = 5 / np.sqrt(n)  # five standard errors of a mean or a correlation
    assert np.abs(z.mean(0)).max() < error
    assert np.abs(z.std(0) - 1).max() < error
    assert abs(np.corrcoef(z.T)[0, 1]) < error


def test_equal_keys_give_equal_actions(scramble):
    (policy,) = to_jax([scramble(3, Architecture((8,))).state_dict()])
    keys = jax.random.split(jax.random.key(1), 2)[jnp.array([0, 1, 0])]
    actions, _ = draw(policy, jnp.zeros((3, 20)), keys)
    np.testing.assert_array_equal(actions[0], actions[2])
    assert not np.array_equal(actions[0], actions[1])


def test_a_feature_that_never_moved_does_not_explode_when_it_does():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        actor = Actor(3, 2, Architecture((8,)), initial_std=0.3)
    actor.trunk.observation_mean.fill_(5.0)
    actor.trunk.observation_var.zero_()
    actor.trunk.observation_clip.fill_(10.0)
    (policy,) = to_jax([actor.state_dict()])

    def means(x: float) -> tuple[np.ndarray, np.ndarray]:
        with torch.no_grad():
            return np.asarray(distribution(policy, jnp.full((1, 3), x))[0]), actor(torch.full((1, 3), x)).mean.numpy()

    for value in (means(5.2), means(1e6), means(5.0 + 0.1)):  # 20, 1e8 and 10 deviations of at least 0.01
        np.testing.assert_allclose(value[0], value[1], atol=1e-6)
        np.testing.assert_allclose(value[0], means(5.1)[0], atol=1e-6)
    assert np.abs(means(5.01)[0] - means(5.1)[0]).max() > 1e-3


# Whoever sits in a crew of these acts as it would alone: two networks of one shape, two of others, two scripts.
SHAPES = {
    "a": Architecture((8,)),
    "b": Architecture((8,)),
    "wide": Architecture((24, 8)),
    "norm": Architecture((8,), layer_norm=True),
}
SCRIPTS = (lambda observation, key: observation[:2], lambda observation, key: jax.random.uniform(key, (2,)))
WORLDS = 5  # in a group


@pytest.fixture(scope="module")
def member(scramble):
    actors = {name: policy_params(scramble(i, shape).state_dict()) for i, (name, shape) in enumerate(SHAPES.items())}
    return lambda who: who if isinstance(who, int) else actors[who]


def play(stack: PolicyStack, groups: int) -> tuple[np.ndarray, np.ndarray, jax.Array, jax.Array]:
    """Actions (K, n, act), densities (K, n), and the observations and keys that led to them."""
    observations = jax.random.normal(jax.random.key(4), (groups * WORLDS, 20))
    keys = jax.random.split(jax.random.key(5), groups * WORLDS)
    found = jax.jit(lambda *given: decide(*given, SCRIPTS))(stack, observations, keys)
    actions, log_probs = found.actions, found.log_probs
    shaped = (x.reshape(groups, WORLDS, *x.shape[1:]) for x in (observations, keys))
    return np.asarray(actions).reshape(groups, WORLDS, 2), np.asarray(log_probs).reshape(groups, WORLDS), *shaped


@pytest.mark.parametrize("backend", ["cpu", "gpu"])  # scripts group by group, or for all groups at once
@pytest.mark.parametrize("who", [["a"], ["a", "b", "a"], ["wide", "a", 1, "norm", 0, "b"], [1, "wide"], [0, 1]])
def test_policies_of_all_shapes_and_scripts_act_in_one_crew(who, backend, member, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    actions, log_probs, observations, keys = play(stack_policies([member(name) for name in who]), len(who))
    for k, name in enumerate(who):
        if isinstance(name, int):
            expected = jax.vmap(SCRIPTS[name])(observations[k], keys[k]), np.zeros(WORLDS)
        else:
            expected = draw(member(name), observations[k], keys[k])
        np.testing.assert_allclose(actions[k], expected[0], rtol=1e-5, atol=1e-5, err_msg=str(name))
        np.testing.assert_allclose(log_probs[k], expected[1], rtol=1e-4, atol=1e-4, err_msg=str(name))


def test_a_crew_pays_only_for_what_sits_in_it(member):
    alone = stack_policies([member("a"), member("b")])
    assert len(alone.parts) == 1
    assert alone.script is None
    assert len(stack_policies([member("a"), member("wide"), 1]).parts) == 2


def test_who_sits_where_never_changes_the_shapes_that_were_compiled(member):
    def shapes(stack: PolicyStack):
        return jax.tree.structure(stack), [(x.shape, x.dtype) for x in jax.tree.leaves(stack)]

    full = shapes(stack_policies([member("a"), member("wide"), 1]))
    also = [member("wide"), member("b"), 0]
    assert shapes(stack_policies([0, member("wide"), member("b")])) == full
    assert shapes(stack_policies([member("a"), member("b"), member("a")], also)) == full
    assert shapes(stack_policies([1, 1, 0], also)) == full
    assert shapes(stack_policies([member("a"), member("b"), member("a")])) != full


def test_on_a_cpu_a_script_is_computed_only_in_the_groups_where_it_sits(member, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    asked = []

    def script(observation, key):
        jax.debug.callback(lambda x: asked.append(float(x)), observation[0])
        return observation[:2]

    observations = jnp.repeat(jnp.arange(4.0), WORLDS)[:, None] * jnp.ones(20)
    keys = jax.random.split(jax.random.key(0), 4 * WORLDS)
    jax.block_until_ready(decide(stack_policies([member("a"), 0, member("b"), 0]), observations, keys, (script,)))
    jax.effects_barrier()
    assert sorted(asked) == [1.0] * WORLDS + [3.0] * WORLDS


# Squashed actions, deviations that depend on the state ----------------------------------------------------------------

KINDS = {
    "squashed": Architecture((9, 7), squash=1.0),
    "squashed to 2.5": Architecture((9, 7), "relu", squash=2.5),
    "state_std": Architecture((9, 7), "elu", layer_norm=True, state_std=True),
    "both": Architecture((9, 7), squash=0.7, state_std=True),
}


@pytest.mark.parametrize("architecture", KINDS.values(), ids=KINDS)
def test_jax_and_torch_agree_on_policies_of_every_kind(architecture, scramble):
    actors = [scramble(seed, architecture) for seed in range(3)]
    (params,) = stack_policies(to_jax([actor.state_dict() for actor in actors])).parts
    observations = jax.random.normal(jax.random.key(0), (3, 400, 20))
    mean, std = distributions_of(params, observations)
    actions, log_probs = draw_each(params, observations, jax.random.split(jax.random.key(1), (3, 400)))
    for k, actor in enumerate(actors):
        seen, done = (torch.tensor(np.asarray(x[k])) for x in (observations, actions))
        with torch.no_grad():
            gaussian, densities = actor.gaussian(seen), actor(seen).log_prob(done).sum(-1)
        np.testing.assert_allclose(mean[k], gaussian.mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(np.broadcast_to(std[k], mean[k].shape), gaussian.stddev, rtol=1e-5)
        np.testing.assert_allclose(log_probs[k], densities, rtol=1e-5, atol=1e-5)
    if architecture.squash:
        assert 0.9 * architecture.squash < float(jnp.abs(actions).max()) <= architecture.squash
    if architecture.state_std:
        assert float(jnp.std(std[0], axis=0).min()) > 0.01


def test_densities_agree_even_where_actions_are_pressed_against_their_limit(scramble):
    actor = scramble(0, Architecture((8,), squash=1.0))
    with torch.no_grad():
        actor.mean.bias.copy_(torch.tensor([5.0, 40.0]))  # tanh rounds to 1 from 9 on
    (policy,) = to_jax([actor.state_dict()])
    observations = jax.random.normal(jax.random.key(0), (500, 20))
    actions, log_probs = draw(policy, observations, jax.random.split(jax.random.key(1), 500))
    with torch.no_grad():
        densities = actor(torch.tensor(np.asarray(observations))).log_prob(torch.tensor(np.asarray(actions))).sum(-1)
    assert np.isfinite(np.asarray(log_probs)).all()
    np.testing.assert_allclose(log_probs, densities, rtol=1e-5)
    assert float(actions[:, 1].max()) < 1.0


def test_a_squashed_density_is_a_density_and_its_entropy_is_right():
    for limit, mean, std in ((1.0, 0.3, 0.8), (2.0, -1.5, 0.4), (0.5, 0.1, 1.0)):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            actor = Actor(1, 1, Architecture((2,), squash=limit), initial_std=std).double()
        with torch.no_grad():
            actor.mean.bias.fill_(mean)
            policy = actor(torch.zeros(1, dtype=torch.float64))
        edges = limit * torch.tanh(torch.linspace(-12, 12, 400_001).double())
        middle, width = (edges[1:] + edges[:-1]) / 2, edges.diff()
        log_prob = policy.log_prob(middle)
        density = log_prob.exp()
        assert float((density * width).sum()) == pytest.approx(1.0, abs=1e-4)
        assert float(policy.entropy()) == pytest.approx(-float((density * log_prob * width).sum()), abs=0.01)


def test_squashed_and_plain_policies_act_in_one_crew_each_as_its_own_kind(scramble):
    kinds = {name: Architecture((8,), squash=s, state_std=d) for name, s, d in (
        ("plain", None, False), ("squashed", 2.0, False), ("state", None, True), ("wider", 4.0, False)
    )}  # fmt: skip
    policies = {name: policy_params(scramble(i, kind).state_dict()) for i, (name, kind) in enumerate(kinds.items())}
    who = ["squashed", "plain", "state", "squashed", "wider"]
    stack = stack_policies([policies[name] for name in who])
    assert len(stack.parts) == 3  # the limit is a number, and no kind of its own
    actions, log_probs, observations, keys = play(stack, len(who))
    for k, name in enumerate(who):
        expected = draw(policies[name], observations[k], keys[k])
        np.testing.assert_allclose(actions[k], expected[0], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(log_probs[k], expected[1], rtol=1e-4, atol=1e-4)
    assert np.abs(actions[[0, 3]]).max() <= 2.0


@pytest.mark.parametrize("architecture", [Architecture((8,), squash=2.0), Architecture((8,), state_std=True)])
def test_a_fresh_policy_of_another_kind_begins_as_wide_as_a_plain_one(architecture):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        actor = Actor(20, 2, architecture, initial_std=0.3)
    mean, std = distribution(*to_jax([actor.state_dict()]), jax.random.normal(jax.random.key(0), (256, 20)))
    np.testing.assert_allclose(std, np.broadcast_to(0.3, std.shape), rtol=0.03)
    assert float(jnp.abs(mean).max()) < 0.1
