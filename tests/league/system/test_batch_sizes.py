"""Worlds and batches by device and arena, where no setting gives them."""

import pytest

from league.config.sections import Rating
from league.system import batch_sizes
from league.system.batch_sizes import Batch


@pytest.fixture
def memory(monkeypatch):
    """Sets a GPU's memory in GB; None: nothing tells it."""

    def of(gigabytes):
        monkeypatch.setattr(batch_sizes, "_gpu_memory", lambda: gigabytes and gigabytes * 1e9)

    of(None)
    return of


@pytest.mark.parametrize(
    ("given", "backend", "batch"),
    [
        (Rating(), "cpu", Batch(512, 4)),
        (Rating(), "gpu", Batch(4096, 32)),
        (Rating(worlds=64, pairings=2), "gpu", Batch(64, 2)),
        (Rating(worlds=64), "cpu", Batch(64, 4)),
        (Rating(worlds=2), "cpu", Batch(2, 1)),
        (Rating(worlds=100), "cpu", Batch(100, 2)),
        (Rating(worlds=1024), "gpu", Batch(1024, 8)),
        (Rating(worlds=65536), "gpu", Batch(65536, 32)),
        (Rating(pairings=3), "cpu", Batch(516, 3)),
        (Rating(pairings=4), "gpu", Batch(4096, 4)),
        (Rating(pairings=4096), "cpu", Batch(8192, 4096)),
    ],
)
def test_a_batch_is_as_the_settings_say_and_else_by_the_device(memory, given, backend, batch):
    assert batch_sizes.batch(given, backend) == batch
    assert batch.worlds % (2 * batch.pairings) == 0


def test_a_small_gpu_has_smaller_batches_and_fewer_worlds(memory):
    large = batch_sizes.training("sumo-2v2", "gpu")
    memory(85)
    assert (batch_sizes.training("sumo-2v2", "gpu"), batch_sizes.batch(Rating(), "gpu")) == (large, Batch(4096, 32))
    memory(8)
    assert batch_sizes.training("sumo-2v2", "gpu") * batch_sizes.WORLD_BYTES <= 2e9
    small = batch_sizes.batch(Rating(), "gpu")
    assert small.worlds * batch_sizes.WORLD_BYTES <= 2e9
    assert small.worlds // small.pairings == 128


def test_where_training_waits_for_ratings_a_gpus_batches_are_smaller_and_a_cpus_are_not(memory):
    assert batch_sizes.batch(Rating(), "gpu", soon=True) == Batch(1024, 8)
    assert batch_sizes.batch(Rating(worlds=64, pairings=2), "gpu", soon=True) == Batch(64, 2)
    assert batch_sizes.batch(Rating(), "cpu", soon=True) == batch_sizes.batch(Rating(), "cpu")


def test_each_arena_has_its_own_worlds_on_a_gpu_and_all_the_same_on_a_cpu(memory, monkeypatch):
    monkeypatch.setattr(batch_sizes, "GPU_WORLDS", {"anymal-walk": 3000})
    assert batch_sizes.training("anymal-walk", "gpu") == 3000
    assert batch_sizes.training("sumo-2v2", "gpu") == batch_sizes.OTHER_GPU_WORLDS
    assert batch_sizes.training("anymal-walk", "cpu") == batch_sizes.CPU_WORLDS == 256
