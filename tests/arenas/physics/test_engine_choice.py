"""Which engine is taken where, and which is refused."""

import jax
import pytest

from arenas.errors import EngineError
from arenas.physics.registry import resolve_engine


@pytest.mark.parametrize(("backend", "name"), [("cpu", "c"), ("tpu", "c"), ("gpu", "warp")])
def test_auto_is_warp_on_a_gpu_and_c_elsewhere(backend, name, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert resolve_engine("auto") == name


@pytest.mark.parametrize("threads", [1, 2, 3, 4])
def test_mjx_is_refused_on_a_cpu_where_xla_has_too_few_threads_not_to_hang(threads, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setenv("NPROC", str(threads))
    if threads in (1, 4):
        assert resolve_engine("jax") == "jax"
    else:
        with pytest.raises(EngineError, match=f"has {threads} threads.* NPROC=4"):
            resolve_engine("jax")
