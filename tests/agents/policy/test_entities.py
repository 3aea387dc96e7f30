"""Sets of entities: their order and absent ones have no effect, in torch and in JAX alike."""

import jax
import numpy as np
import pytest
import torch

from agents.learner.happo import HappoLearner
from agents.policy.constant_inputs import silence_constant_inputs
from agents.policy.entities import own_numbers
from agents.policy.jax_policy import distribution, policy_params
from agents.policy.networks import Actor
from agents.settings import Architecture, HappoConfig

SETS = (((2, 3), (4, 5), (6, 7)), ((8, 10), (9, 11)))  # the second by columns
SIZE = 12
KINDS = {
    "plain": Architecture((9, 7), entities=6),
    "relu, LayerNorm": Architecture((9,), "relu", layer_norm=True, entities=5),
    "elu, recurrent": Architecture((9,), "elu", recurrent=4, entities=5),
}


def actor(architecture: Architecture, sets=SETS, size=SIZE) -> Actor:
    torch.manual_seed(0)
    made = Actor(size, 2, architecture, 0.5, sets)
    with torch.no_grad():
        for weights in made.parameters():
            weights += 0.3 * torch.randn(weights.shape)
        mean, var = torch.randn(size), torch.rand(size) + 0.1
        made.trunk.renormalise(mean, var, torch.ones(size, dtype=torch.bool))
        made.trunk.observation_clip.fill_(3.0)
    return made


def observations(worlds: int = 16) -> np.ndarray:
    """Every other world lacks an entity of each set; the last one lacks all."""
    seen = np.random.default_rng(1).normal(size=(worlds, SIZE)).astype(np.float32)
    seen[::2, 4:6] = 0.0
    seen[::2, 8] = seen[::2, 10] = 0.0
    seen[-1, 2:] = 0.0
    return seen


def moved(seen: np.ndarray) -> np.ndarray:
    """The same with the entities of each set in another order."""
    found = seen.copy()
    found[:, [2, 3, 4, 5, 6, 7]] = seen[:, [6, 7, 2, 3, 4, 5]]
    found[:, [8, 10, 9, 11]] = seen[:, [9, 11, 8, 10]]
    return found


def features(made: Actor, seen: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return made.trunk(torch.tensor(seen)).numpy()


@pytest.mark.parametrize("kind", KINDS)
def test_an_order_of_entities_has_no_effect(kind):
    made, seen = actor(KINDS[kind]), observations()
    np.testing.assert_allclose(features(made, moved(seen)), features(made, seen), atol=1e-5)
    other = seen.copy()
    other[:, [2, 4]] = seen[:, [4, 2]]  # one number of two entities: these are other entities
    assert np.abs(features(made, other) - features(made, seen))[1::2].max() > 1e-2
    flat = actor(Architecture(KINDS[kind].hidden, KINDS[kind].activation, KINDS[kind].layer_norm))
    assert np.abs(features(flat, moved(seen)) - features(flat, seen)).max() > 1e-2


@pytest.mark.parametrize("kind", ["plain", "relu, LayerNorm"])
def test_jax_acts_by_the_same_sets(kind):
    made, seen = actor(KINDS[kind]), observations()
    with torch.no_grad():
        gaussian = made.gaussian(torch.tensor(seen))
    policy = policy_params({name: x.numpy() for name, x in made.state_dict().items()})
    mean, std = jax.jit(distribution)(policy, seen)
    np.testing.assert_allclose(mean, gaussian.mean.numpy(), atol=1e-5)
    np.testing.assert_allclose(np.broadcast_to(std, mean.shape), gaussian.stddev.numpy(), atol=1e-6)
    np.testing.assert_allclose(jax.jit(distribution)(policy, moved(seen))[0], mean, atol=1e-5)


def test_an_absent_entity_is_as_if_there_were_fewer():
    made = actor(KINDS["plain"])
    fewer = Actor(10, 2, KINDS["plain"], 0.5, (((2, 3), (4, 5)), ((6, 8), (7, 9))))
    state = {name: x for name, x in made.state_dict().items() if not name.endswith((".own", ".index"))}
    kept = [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]
    for name in ("trunk.observation_mean", "trunk.observation_var"):
        state[name] = state[name][kept]
    fewer.load_state_dict(state, strict=False)
    seen = observations()
    seen[:, 4:6] = 0.0
    np.testing.assert_allclose(features(fewer, seen[:, kept]), features(made, seen), atol=1e-6)


def test_new_statistics_are_those_of_the_set_and_keep_the_policy():
    made, seen = actor(KINDS["plain"]), observations()[1::2][:-1]  # worlds in which no entity is absent
    made.trunk.observation_clip.fill_(1e6)
    before = features(made, seen)
    mean, var = torch.randn(SIZE), torch.rand(SIZE) + 0.1
    with torch.no_grad():
        made.trunk.renormalise(mean, var, torch.ones(SIZE, dtype=torch.bool))
    np.testing.assert_allclose(features(made, seen), before, atol=2e-5)
    first = [2, 4, 6]
    pooled = made.trunk.observation_var[first]
    assert pooled.tolist() == pytest.approx([float(var[first].mean() + mean[first].var(unbiased=False))] * 3)
    np.testing.assert_allclose(made.trunk.observation_mean[first], [mean[first].mean()] * 3, rtol=1e-6)
    assert float(made.trunk.observation_mean[0]) == float(mean[0])


def test_constant_inputs_are_silenced_in_the_encoder_and_beside_it():
    made = actor(KINDS["plain"])
    arrays = {name: x.numpy().copy() for name, x in made.state_dict().items()}
    for place in (1, 3, 5, 7):  # an own number, and the second number of each entity of the first set
        arrays["trunk.observation_var"][place] = 0.0
    silent = silence_constant_inputs(arrays)
    assert not silent["trunk.hidden.0.weight"][:, 1].any()
    assert silent["trunk.hidden.0.weight"][:, [0, 2, 3]].any(axis=0).all()
    assert not silent["trunk.entities.0.layers.0.weight"][:, 1].any()
    assert silent["trunk.entities.0.layers.0.weight"][:, 0].all()
    np.testing.assert_array_equal(
        silent["trunk.entities.1.layers.0.weight"], arrays["trunk.entities.1.layers.0.weight"]
    )


def test_own_numbers_are_all_others():
    assert own_numbers(SIZE, SETS) == [0, 1]
    assert own_numbers(3, ()) == [0, 1, 2]
    assert "trunk.own" not in Actor(SIZE, 2, Architecture(), 0.5, SETS).state_dict()


def learner(sets) -> HappoLearner:
    config = HappoConfig(Architecture((8,), entities=4))
    return HappoLearner((SIZE,), (2,), config, seed=1, entities=[sets])


def test_a_learner_keeps_its_sets_and_refuses_others():
    one, other = learner(SETS), learner(SETS)
    assert [name for name in one.export()[0] if name.endswith(".index")] == [
        "trunk.entities.0.index", "trunk.entities.1.index",
    ]  # fmt: skip
    assert len(one.critic_learners[0].network.trunk.entities) == 2
    one.reseed(5)
    other.load(one.save())
    for name, values in one.export()[0].items():
        np.testing.assert_array_equal(other.export()[0][name], values, err_msg=name)
    with pytest.raises(ValueError, match="index"):
        learner((SETS[0][::-1], SETS[1])).load(one.save())
