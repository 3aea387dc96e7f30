"""The meeting of ranks that others have started: places, interfaces, and what two ranks of torchrun learn."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.devices import rendezvous
from agents.devices.rendezvous import Place, RanksError, place_of
from tests.agents.devices.test_distributed import BASE, Case, gap, uneven
from tests.faults.servers import free_port

ROOT = Path(__file__).parents[3]
TORCHRUN = {
    "RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "node0",
    "MASTER_PORT": "29500", "TORCHELASTIC_USE_AGENT_STORE": "True",
}  # fmt: skip
SRUN = {
    "SLURM_PROCID": "3", "SLURM_NTASKS": "4", "SLURM_LOCALID": "1", "SLURM_NTASKS_PER_NODE": "2",
    "MASTER_ADDR": "node0", "MASTER_PORT": "29500",
}  # fmt: skip


def test_torchrun_and_srun_name_a_place_each_in_its_way():
    assert place_of(TORCHRUN) == Place(3, 4, "node0", 29500, 1, 2, served=True)
    assert place_of(SRUN) == Place(3, 4, "node0", 29500, 1, 2)
    assert place_of(SRUN | TORCHRUN | {"RANK": "0"}).rank == 0  # torchrun within a job of Slurm
    assert place_of({**TORCHRUN, "LOCAL_RANK": ""}).local_rank == 0


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"MASTER_ADDR": ""}, "MASTER_ADDR is not set"),
        ({"RANK": "4"}, "RANK is 4, and WORLD_SIZE is 4"),
        ({"WORLD_SIZE": "many"}, "WORLD_SIZE is 'many'"),
        ({"MASTER_PORT": "70000"}, "MASTER_PORT is 70000"),
    ],
)
def test_variables_that_make_no_sense_need_a_person(wrong, reason):
    with pytest.raises(RanksError, match=reason) as caught:
        place_of(TORCHRUN | wrong)
    assert not caught.value.transient
    with pytest.raises(RanksError, match="RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT is not set"):
        place_of({})


@pytest.mark.skipif(sys.platform != "linux", reason="interfaces are asked of Linux")
def test_messages_take_the_loopback_only_to_an_address_that_is_given_as_one(monkeypatch):
    assert [rendezvous.interface(each) for each in ("127.0.0.1", "localhost")] == ["lo", "lo"]
    monkeypatch.setattr(rendezvous, "_source_of", {("node0", 9): "127.0.1.1", rendezvous.ANYWHERE: "192.0.2.7"}.get)
    monkeypatch.setattr(rendezvous, "_addresses", {"lo": {"127.0.0.1"}}.get)
    monkeypatch.setattr(rendezvous.socket, "if_nameindex", lambda: [(1, "lo")])
    assert rendezvous.interface("node0") is None
    monkeypatch.setattr(rendezvous, "_addresses", {"lo": {"127.0.0.1"}, "eth1": {"192.0.2.7"}}.get)
    monkeypatch.setattr(rendezvous.socket, "if_nameindex", lambda: [(1, "lo"), (2, "eth1")])
    assert rendezvous.interface("node0") == "eth1"


@pytest.mark.slow
def test_two_ranks_of_torchrun_learn_what_one_process_learns_from_the_whole_batch(experience, tmp_path):
    case = Case(BASE, [])
    case.batches = [uneven(case.learner(), experience, seed) for seed in (1, 2)]
    torch.save(case, tmp_path / "case")
    subprocess.run(
        [
            sys.executable, "-m", "torch.distributed.run", "--nnodes", "1", "--nproc-per-node", "2",
            "--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{free_port()}", "--local-addr", "127.0.0.1",
            "-m", "tests.agents.devices.learn_as_rank", tmp_path,
        ],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, timeout=300,
    )  # fmt: skip
    (state, told), start = case.learn(), case.learner().save()
    (first, figures), (second, _) = (torch.load(tmp_path / f"rank{r}", weights_only=False) for r in (0, 1))
    assert gap(first, state) < 1e-5
    assert gap(start, state) > 1e-3
    assert figures == pytest.approx(told, rel=1e-4, abs=1e-5)
    assert all(np.array_equal(first[k], second[k]) for k in first)
