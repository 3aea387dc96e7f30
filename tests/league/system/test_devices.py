"""Worker n takes GPU n, before anything that would take one is imported."""

import os

import pytest

from arenas.physics import cpu
from league.system import devices


@pytest.fixture(autouse=True)
def _asked_anew():
    devices.gpus.cache_clear()
    yield
    devices.gpus.cache_clear()


@pytest.mark.parametrize(("number", "taken"), [(0, "2"), (1, "5"), (2, "2")])
def test_workers_share_the_gpus_that_they_may_use_in_turn(monkeypatch, number, taken):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5")
    devices.take(number)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == taken


def test_where_there_are_none_nothing_is_set(monkeypatch, tmp_path):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    devices.take(3)
    assert "CUDA_VISIBLE_DEVICES" not in os.environ


def test_they_are_counted_as_the_driver_lists_them(monkeypatch, tmp_path):
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'GPU 0: H100 (UUID: a)'\necho 'GPU 1: H100 (UUID: b)'\n")
    tool.chmod(0o755)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    assert devices.gpus() == ("0", "1")


def test_of_a_cpu_all_cores_are_one_device_and_of_a_gpu_every_second_counts(monkeypatch):
    monkeypatch.setattr(devices.time, "process_time", lambda: 6.0)
    monkeypatch.setattr(devices.time, "monotonic", lambda: 100.0)
    monkeypatch.setattr(cpu, "cores", lambda: 4)
    assert devices.used("cpu") == 1.5
    assert devices.used("gpu") == 100.0
