"""Losses and steps that torch.compile has made few kernels of teach what plain ones do, in every variant."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner.happo import HappoLearner
from agents.learner.optimizer import Adam, maybe_compiled, step
from tests.agents.variants import AGENTS, BASE, EVERY_UPDATE, SIGHT, experienced

IN_CI = {"happo", "hatrpo", "shared", "recurrent", "squashed", "bf16", "paper"}  # one for each kind of kernel
ON_A_GPU = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]
HERE = ["cpu", pytest.param("cuda", marks=ON_A_GPU)]
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of torch.compile itself
    pytest.mark.filterwarnings("ignore:TensorFloat32 tensor cores"),  # its advice, which learner.precision is for
]


class Twins(Communicator):
    """Two ranks that have the same rows, and whose messages no compiler may take into a kernel."""

    size = 2

    def sum(self, *tensors: Tensor) -> list[Tensor]:
        """Twice each."""
        assert not torch.compiler.is_compiling()
        return [2 * x.detach() for x in tensors]


def assert_alike(
    variant: dict[str, Any], device: str, experience, rounding: float, comm: Communicator = SINGLE_PROCESS,
    agents: int = 3,
) -> None:  # fmt: skip
    sizes = [each[-agents:] for each in AGENTS]
    compiled, plain = (
        HappoLearner(*sizes, replace(BASE, **variant, compiled=on), 3, device, critic_size=SIGHT, comm=comm)
        for on in (True, False)
    )
    for seed in range(3):
        batch = experienced(experience, plain, seed, N=6)
        one, other = compiled.learn(batch), plain.learn(batch)
        # HATRPO's natural gradient takes advantages, whose last digits differ, and later critics', ten times as hard.
        hard = variant.get("method") == "hatrpo"
        bound = (50 if seed else 5) * rounding if hard else rounding
        figures = 10 * bound
        # LayerNorm divides by the deviation of six numbers: plain updates from batches that differ in their last digits
        # end 5e-6 apart (recurrent, shared; paper), and a figure of paper by 7e-4 of itself.
        if variant.get("architecture", BASE.architecture).layer_norm:
            bound, figures = max(bound, 1e-5), max(figures, 5e-4)
        assert one == pytest.approx(other, rel=figures, abs=bound)
        theirs = plain.save()
        for name, array in compiled.save().items():
            np.testing.assert_allclose(array, theirs[name], rtol=bound, atol=bound, err_msg=name)


@pytest.fixture
def eager(monkeypatch) -> None:
    """Without the compiler itself, which takes a minute for all variants: what it is given is run as it is."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))


@pytest.mark.parametrize(
    "variant",
    [pytest.param(v, id=k, marks=pytest.mark.slow if k in IN_CI else pytest.mark.gpu) for k, v in EVERY_UPDATE.items()],
)
def test_every_variant_is_one_graph(variant: dict, experience, eager):
    assert_alike(variant, "cpu", experience, 1e-2 if "precision" in variant else 1e-6)


@pytest.mark.slow
def test_what_ranks_tell_each_other_is_not_compiled(experience, eager):
    assert_alike({}, "cpu", experience, 1e-6, Twins())


@pytest.mark.slow
def test_a_minibatch_in_which_nothing_counts_changes_nothing(experience, eager):
    """With one known decision, two of three minibatches are empty."""
    learner, plain = (HappoLearner([4, 3], [2, 1], replace(BASE, compiled=on), 3) for on in (True, False))
    batch = experience(plain, seed=4)
    void = torch.ones_like(batch.void)
    void[3, 2] = False
    for each in (learner, plain):
        each.learn(batch._replace(void=void))
    state, expected = learner.save(), plain.save()
    for name, array in state.items():
        np.testing.assert_allclose(array, expected[name], rtol=1e-6, atol=1e-6, err_msg=name)
    assert {array.item() for name, array in state.items() if name.endswith(".step")} == {BASE.epochs}


@pytest.mark.slow
def test_no_list_of_a_step_holds_two_tensors_of_one_parameter(monkeypatch):
    """On a GPU one kernel is made of a list, whose parts run in any order; a CPU shows nothing of it."""
    layer = nn.Linear(5, 3)
    optimizer = Adam(layer, torch.tensor(0.01))
    each = optimizer.parameters, optimizer.steps, optimizer.first, optimizer.second
    of = {id(x): k for tensors in each for k, x in enumerate(tensors)}
    written, copy = [], torch._foreach_copy_

    def looking(to: list[Tensor], source: list[Tensor]) -> None:
        written.append([of[id(x)] for x in to])
        copy(to, source)

    monkeypatch.setattr(torch, "_foreach_copy_", looking)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)  # so that it is written out
    step(optimizer, [torch.ones_like(p) for p in layer.parameters()], 0.5, torch.tensor(1.0))
    assert written == [[0, 1]] * 4


Take = Callable[[Adam, list[Tensor], float, Tensor], Tensor]


def assert_steps_alike(ours: Take, theirs: Take, device: str) -> None:
    """Compare steps of gradients that are scaled down and that are not, that are not taught and that are broken."""
    layers = [nn.Linear(5, 3).to(device) for _ in range(2)]
    layers[0].load_state_dict(layers[1].state_dict())
    optimizers = [Adam(layer, torch.tensor(0.01, device=device)) for layer in layers]
    rng = torch.Generator().manual_seed(5)
    for size, any_valid in ((1e3, 1.0), (1e-2, 1.0), (math.nan, 0.0), (math.inf, 0.0), (1.0, 1.0), (math.nan, 1.0)):
        kept = [p.detach().clone() for p in layers[0].parameters()]
        gradient = [size * torch.randn(p.shape, generator=rng).to(device) for p in kept]
        norms = [
            take(optimizer, [g.clone() for g in gradient], 0.5, torch.tensor(any_valid, device=device))
            for take, optimizer in zip((ours, theirs), optimizers, strict=True)
        ]
        torch.testing.assert_close(*norms, equal_nan=True)
        one, other = (
            {**layer.state_dict(), **{f"adam.{k}": v for k, v in optimizer.tensors().items()}}
            for layer, optimizer in zip(layers, optimizers, strict=True)
        )
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7, equal_nan=True)
        stayed = all(torch.equal(p, q) for p, q in zip(kept, layers[0].parameters(), strict=True))
        assert stayed == (any_valid == 0.0)
    assert one["adam.bias.step"] == 4
    assert one["weight"].isnan().all()


def test_a_step_that_is_written_out_is_a_step():
    """As compiled code has it, without the compiler."""

    def written_out(optimizer: Adam, gradient: list[Tensor], max_grad_norm: float, any_valid: Tensor) -> Tensor:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch.compiler, "is_compiling", lambda: True)
            return step(optimizer, gradient, max_grad_norm, any_valid)

    assert_steps_alike(written_out, step, "cpu")


@pytest.mark.slow
@pytest.mark.parametrize("device", HERE)
def test_a_compiled_step_is_a_step(device: str):
    assert_steps_alike(maybe_compiled(step, True), step, device)


@pytest.mark.slow
@pytest.mark.parametrize("device", HERE)
@pytest.mark.parametrize("name", ["happo", pytest.param("paper", marks=pytest.mark.gpu)])  # a CPU compiles for a minute
def test_a_compiled_update_is_an_update(name: str, device: str, experience):
    """Compare updates of two unlike agents only, because a compiler takes seconds for the kernels of each network."""
    assert_alike(EVERY_UPDATE[name], device, experience, 1e-4, agents=2)
