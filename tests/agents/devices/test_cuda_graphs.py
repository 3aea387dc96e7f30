"""Replaying an update is updating: on a GPU by CUDA graphs, and here by the recorder of kernels.py."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.devices import cuda_graphs
from agents.learner.happo import HappoLearner
from tests.agents.variants import BASE, EVERY_UPDATE, SIGHT, experienced

# One for each kind of update, and what makes other kernels of it; the recorder has seen the rest of these in others.
QUICK = {"happo", "hatrpo", "recurrent"}
SLOW = {"ippo", "shared", "target_kl", "desired_kl", "privileged", "squashed", "bf16", "recurrent, shared", "paper"}


def when(variant: str) -> list[pytest.MarkDecorator]:
    """Return the mark under which a variant is tried."""
    return [] if variant in QUICK else [pytest.mark.slow if variant in SLOW else pytest.mark.gpu]


def pair(variant: dict, device: str) -> tuple[HappoLearner, HappoLearner]:
    """Two equal learners of which the first replays."""
    replaying, plain = (
        HappoLearner([4, 4, 3], [2, 2, 1], replace(BASE, **variant, cuda_graphs=on), 3, device, critic_size=SIGHT)
        for on in (True, False)
    )
    replaying.graphs.on = True
    return replaying, plain


def assert_equal(one: HappoLearner, other: HappoLearner) -> None:
    theirs = other.save()
    for name, array in one.save().items():
        np.testing.assert_allclose(array, theirs[name], rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    "variant",
    [pytest.param(v, id=k, marks=when(k)) for k, v in EVERY_UPDATE.items()],
)
def test_a_replayed_update_is_an_update(variant, device, experience):
    replaying, plain = pair(variant, device)
    kept = replaying.save()
    for seed, worlds in enumerate((6, 6, 6, 9, 9, 6, 9)):
        batch = experienced(experience, plain, seed, worlds)
        if seed == 4:  # another state under the same graphs
            for learner in (replaying, plain):
                learner.load(kept)
        update = HappoLearner.update_critic_only if seed == 2 else HappoLearner.learn
        told, expected = update(replaying, batch), update(plain, batch)
        assert told == pytest.approx(expected, rel=1e-5, abs=1e-6)
        assert_equal(replaying, plain)
    lanes = [lane for each in replaying.graphs._by_shape.values() for lane in (each, each._other)]
    recorded = [known for lane in lanes for known in lane._known.values()]
    assert sum(known.replay is not None for known in recorded) >= 10
    assert any(not np.array_equal(x, kept[name]) for name, x in replaying.save().items() if name.startswith("actor"))
    assert not plain.graphs._by_shape


def test_what_was_recorded_sees_other_dice_advantages_and_step_sizes(device, experience):
    """A replay that had kept any of them would still look like learning."""
    replaying, plain = pair({"lr_decay_steps": 10**6}, device)
    for seed in range(4):
        batch = experienced(experience, plain, seed, 6)
        for learner in (replaying, plain):
            learner.rng.manual_seed(100 + seed)
            learner.steps.fill_(seed * 10**5)
            learner.learn(batch)
        assert_equal(replaying, plain)


def test_a_batch_without_any_known_decision_changes_nothing_in_a_replay(device, experience, same):
    replaying, plain = pair({}, device)
    batches = [experienced(experience, plain, seed, 6) for seed in range(4)]
    for batch in batches[:3]:
        replaying.learn(batch)
    before = replaying.save()
    assert replaying.learn(batches[3]._replace(void=torch.ones_like(batches[3].void))) == {}
    assert same(before, replaying.save())


def test_few_shapes_are_kept(device, experience):
    replaying, plain = pair({}, device)
    for worlds in (3, 4, 5, 6, 3, 7, 3):
        batch = experienced(experience, plain, worlds, worlds)
        for learner in (replaying, plain):
            learner.learn(batch)
        assert_equal(replaying, plain)
    assert [shape[1] for shape in replaying.graphs._by_shape] == [5, 6, 7, 3]
    assert len(replaying.graphs._by_shape) == cuda_graphs.MAX_SHAPES


def test_a_function_that_gets_the_result_of_another_run_gets_always_the_same(device):
    run = cuda_graphs.GraphCache(torch.device("cuda"), on=True).for_shape((1, 1))
    number = torch.ones(3, device=device)

    def twice(x: torch.Tensor) -> torch.Tensor:
        return 2 * x

    def negated(x: torch.Tensor) -> torch.Tensor:
        return -x

    for k in range(1, 4):
        assert run(negated, run(twice, k * number)).tolist() == [-2.0 * k] * 3
    with pytest.raises(RuntimeError, match="got something else"):
        run(negated, number)


def test_what_asks_the_device_cannot_be_recorded(device):
    run = cuda_graphs.GraphCache(torch.device("cuda"), on=True).for_shape((1, 1))

    def asking(x: torch.Tensor) -> torch.Tensor:
        return -x if x.sum() > 0 else x

    assert run(asking, torch.ones(3, device=device)).tolist() == [-1.0] * 3
    if device == "cpu":
        with pytest.raises(RuntimeError, match="waits for the device"):
            run(asking, torch.ones(3))


def test_graphs_are_for_a_gpu():
    assert isinstance(HappoLearner([4], [2], BASE, 0).graphs.for_shape((8, 6)), cuda_graphs.EagerRunner)
    assert isinstance(cuda_graphs.GraphCache(torch.device("cuda"), on=False).for_shape((8, 6)), cuda_graphs.EagerRunner)
