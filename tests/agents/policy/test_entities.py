"""Sets of entities: their order and absent ones have no effect, in torch and in JAX alike."""

import jax
import numpy as np
import pytest
import torch

from agents.learner.happo import HappoLearner
from agents.policy.constant_inputs import silence_constant_inputs
from agents.policy.entity_places import own_numbers, places, refitted
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


# Other numbers of entities --------------------------------------------------------------------------------------------

MORE = (((2, 3), (4, 5), (6, 7), (12, 13)), ((8, 11), (9, 10)))  # four and two, the second set at other places
FEWER = (((2, 3), (4, 5)), ((6, 8), (7, 9)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_policy_sees_more_entities_as_it_saw_fewer(kind):
    arrays = {name: value.numpy() for name, value in actor(KINDS[kind]).state_dict().items()}
    seen = observations()
    more = np.zeros((len(seen), 14), np.float32)
    more[:, [*range(8), 8, 11, 9, 10]] = seen[:, [*range(8), 8, 10, 9, 11]]  # the fourth of the first set is absent
    grown = refitted({f"a.{k}": v for k, v in arrays.items()}, "a.", places(MORE, 14))
    grown = {name.removeprefix("a."): value for name, value in grown.items()}
    memory = np.zeros((len(seen), 4), np.float32)
    for one, other in zip(
        distribution(policy_params(arrays), seen, memory), distribution(policy_params(grown), more, memory), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-6)
    more[:, 12:] = 0.7  # and has an effect where it is there, which that of an equal one elsewhere in the set equals
    same = more.copy()
    same[:, [2, 3, 12, 13]] = more[:, [12, 13, 2, 3]]
    first, second = (distribution(policy_params(grown), x, memory)[0] for x in (more, same))
    if kind != "elu, recurrent":  # which acts by its memory alone
        assert np.abs(first - distribution(policy_params(arrays), seen)[0]).max() > 0.01
    np.testing.assert_allclose(first, second, atol=1e-5)
    back = refitted(grown, "", places(SETS, SIZE))
    assert back.keys() == arrays.keys()
    for name, value in arrays.items():
        np.testing.assert_array_equal(back[name], value, err_msg=name)


@pytest.mark.parametrize(
    ("sets", "size", "problem"),
    [
        (SETS[:1], SIZE, "2 sets of entities there and 1 here"),
        ((), SIZE, "sets of entities there, and none here"),
        (SETS, SIZE + 1, "2 numbers of its observation belong to no entity there, and 3 here"),
        ((((2, 3),), ((4, 5, 6),)), 7, "an entity of set 1 has 2 numbers there and 3 here"),
    ],
)
def test_sets_that_differ_in_more_than_their_numbers_are_refused(sets, size, problem):
    arrays = {name: value.numpy() for name, value in actor(KINDS["plain"]).state_dict().items()}
    with pytest.raises(ValueError, match=problem):
        refitted(arrays, "", places(sets, size))


def test_a_learner_goes_on_from_one_that_saw_fewer_entities():
    config = HappoConfig(Architecture((8,), entities=4), normalise_observations=True)
    of_three, of_two = (
        HappoLearner((size, size), (2, 2), config, seed=seed, entities=[sets, sets])
        for size, sets, seed in ((SIZE, SETS, 1), (10, FEWER, 2))
    )
    state = of_two.save()
    state["actor.1.trunk.observation_mean"][:] = [1, 2, 3, 4, 3, 4, 5, 5, 6, 6]
    state["actor.1.observed"][:] = [7, 7, 8, 8, 8, 8, 9, 9, 9, 9]
    of_three.warm_start([(state, 1), None], None, from_other_arena=True)
    found = of_three.save()
    assert found["actor.0.trunk.observation_mean"].tolist() == [1, 2, 3, 4, 3, 4, 3, 4, 5, 5, 6, 6]
    assert found["actor.0.observed"].tolist() == [7, 7, 8, 8, 8, 8, 8, 8, 9, 9, 9, 9]
    for name in ("mean.weight", "trunk.hidden.0.weight", "trunk.entities.1.layers.1.weight"):
        np.testing.assert_array_equal(found[f"actor.0.{name}"], state[f"actor.1.{name}"], err_msg=name)
    assert not np.array_equal(found["actor.1.mean.weight"], state["actor.1.mean.weight"])
