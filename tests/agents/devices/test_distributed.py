"""Two ranks that learn from half a batch each, as processes through gloo, against one that learns from the whole."""

import multiprocessing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils import _pytree as pytree

from agents.batch import Batch
from agents.devices import distributed
from agents.errors import Diverged
from agents.learner.happo import HappoLearner
from agents.learner.learner_state import check_ranks_agree
from agents.settings import HappoConfig
from tests.agents import variants
from tests.agents.variants import SIDES, SIGHT, with_sides

RANKS = 2
BASE = replace(variants.BASE, minibatches=1)
VARIANTS = variants.VARIANTS | {
    "plain": {"value_norm": False, "normalise_observations": False, "fixed_order": True}
}  # fmt: skip
SPLIT = {f"split-{method}": {"method": method, "minibatches": 3} for method in ("happo", "ippo")}
T, N = 8, 12  # of the whole batch


@dataclass
class Case:
    """Batches for a fresh learner, one after the other, of which each rank has the worlds of its own."""

    config: HappoConfig
    batches: list[Batch]

    def learner(self, comm: distributed.Communicator = distributed.SINGLE_PROCESS) -> HappoLearner:
        return HappoLearner([4, 4], [2, 2], self.config, seed=3, critic_size=SIGHT, comm=comm)

    def part(self, rank: int) -> "Case":
        width = N // RANKS
        return replace(self, batches=[part(b, slice(rank * width, (rank + 1) * width)) for b in self.batches])

    def learn(self, comm: distributed.Communicator = distributed.SINGLE_PROCESS) -> tuple[dict[str, np.ndarray], Any]:
        """The state that all updates leave, and what the last of them told."""
        learner, told = self.learner(comm), {}
        for batch in self.batches:
            try:
                told = learner.learn(batch)
            except Diverged as error:
                told = str(error)
        return learner.save(), told


def part(batch: Batch, worlds: slice) -> Batch:
    cut = pytree.tree_map(lambda x: x[:, worlds], batch._replace(critic_memories=()))
    return cut._replace(critic_memories=[memory[worlds] for memory in batch.critic_memories])


def rank_main(rank: int, port: int, folder: Path) -> None:
    """A rank's process: every case, one after the other."""
    torch.set_num_threads(1)
    comm = distributed.join(rank, RANKS, port, on_gpus=False)
    cases: Mapping[str, Case] = torch.load(folder / "cases", weights_only=False)
    found = {name: case.part(rank).learn(comm) for name, case in cases.items()}
    seen = comm.gather(rank), comm.broadcast(f"of rank {rank}"), comm.sum_numbers([1.0, float(rank)]), parted(comm)
    torch.save((found, seen), folder / f"rank{rank}")


def parted(comm: distributed.Communicator) -> str:
    """What is said of two players when a rank's last bit of one of them is another."""
    players = {name: HappoLearner([4], [2], BASE, seed=1, comm=comm) for name in ("blue", "red")}
    check_ranks_agree(players)
    with torch.no_grad():
        bias = players["red"].actors[0].mean.bias
        bias[0] = torch.nextafter(bias[0], torch.tensor(float(comm.rank)))
    with pytest.raises(RuntimeError) as caught:
        check_ranks_agree(players)
    return str(caught.value)


def uneven(learner: HappoLearner, experience: Callable[..., Batch], seed: int, void: float = 0.6) -> Batch:
    """Most that is void lies in the second half of the worlds, and most that is dead in the first."""
    batch, rng = experience(learner, seed, T, N), torch.Generator().manual_seed(seed)
    late = torch.arange(N) >= N // RANKS
    chance = torch.rand((T, N), generator=rng)
    alive = [torch.rand((T, N), generator=rng) < torch.where(late, 0.95, 0.3 + 0.3 * i) for i in range(2)]
    gone = [a.roll(-1, 0) & a for a in alive]
    batch = batch._replace(alive=alive, next_alive=gone, void=chance < torch.where(late, void, 0.05))
    return with_sides(batch, SIDES.get(learner.config.critic_input, 0), seed=seed)


@pytest.fixture(scope="module")
def cases(experience) -> dict[str, Case]:
    found = {name: Case(replace(BASE, **settings), []) for name, settings in (VARIANTS | SPLIT).items()}
    for case in found.values():
        case.batches = [uneven(case.learner(), experience, seed) for seed in (1, 2)]
    broadcast = found["happo"]
    whole = uneven(broadcast.learner(), experience, 1, void=1.1)
    nobody = whole._replace(void=torch.ones_like(whole.void))
    bad = broadcast.batches[1]._replace(
        rewards=broadcast.batches[1].rewards.clone(), void=torch.zeros((T, N), dtype=torch.bool)
    )
    bad.rewards[2, -1] = float("nan")
    more = {"one rank knows nothing": [whole], "nobody knows": [nobody], "bad": [broadcast.batches[0], bad]}
    return found | {name: replace(broadcast, batches=batches) for name, batches in more.items()}


@pytest.fixture(scope="module")
def ranks(cases, tmp_path_factory) -> list[tuple[dict[str, tuple[dict[str, np.ndarray], Any]], Any]]:
    """What each rank's process found."""
    folder, meeting = tmp_path_factory.mktemp("ranks"), distributed.rendezvous()
    torch.save(cases, folder / "cases")
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=rank_main, args=(rank, meeting.port, folder)) for rank in range(RANKS)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(300)
    assert [process.exitcode for process in processes] == [0] * RANKS
    return [torch.load(folder / f"rank{rank}", weights_only=False) for rank in range(RANKS)]


def gap(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> float:
    assert a.keys() == b.keys()
    return max(float(np.abs(a[k].astype(float) - b[k].astype(float)).max()) for k in a)


@pytest.mark.parametrize("name", [*VARIANTS, "one rank knows nothing"])
def test_two_ranks_with_half_a_batch_each_learn_what_one_learns_from_the_whole(cases, ranks, name):
    (state, told), start = cases[name].learn(), cases[name].learner().save()
    for found, _ in ranks:
        split, figures = found[name]
        assert gap(split, state) < 1e-5
        assert figures == pytest.approx(told, rel=1e-4, abs=1e-5)
    assert gap(start, state) > 1e-3
    alone, _ = cases[name].part(0).learn()  # what the other rank saw matters, unless it was nothing
    assert (gap(alone, state) < 1e-5) == (name not in VARIANTS)


@pytest.mark.parametrize("name", SPLIT)
def test_with_minibatches_the_parts_are_others_and_all_ranks_hold_the_same_bytes(cases, ranks, name):
    (broadcast, told), (second, other) = (found[name] for found, _ in ranks)
    assert told == other
    assert all(np.array_equal(broadcast[k], second[k]) for k in broadcast)
    state, _ = cases[name].learn()
    assert 1e-5 < gap(broadcast, state) < 0.2  # each rank permutes its own rows


@pytest.mark.parametrize("name", [*VARIANTS, "one rank knows nothing", "nobody knows"])
def test_all_ranks_hold_the_same_bytes(ranks, name):
    (broadcast, told), (second, other) = (found[name] for found, _ in ranks)
    assert told == other
    assert all(np.array_equal(broadcast[k], second[k]) for k in broadcast)


def test_where_nobody_knows_anything_nothing_is_learnt(cases, ranks):
    for found, _ in ranks:
        state, told = found["nobody knows"]
        assert told == {}
        assert gap(state, cases["nobody knows"].learner().save()) == 0.0


def test_what_is_not_finite_on_one_rank_is_refused_by_all_before_anything_changes(cases, ranks):
    before, _ = replace(cases["bad"], batches=cases["bad"].batches[:1]).learn()
    for found, _ in ranks:
        state, told = found["bad"]
        assert told == "not finite: rewards"
        assert gap(state, before) < 1e-5


def test_ranks_ask_the_first_one_tell_each_other_and_notice_when_they_part(ranks):
    parted = "the ranks no longer hold the same red; nothing of this turn is written"
    assert [seen for _, seen in ranks] == [([0, 1], "of rank 0", [2.0, 1.0], parted)] * RANKS
