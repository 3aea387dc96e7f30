"""Losses that torch.compile has made few kernels of teach what plain ones do, in every variant."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from agents.happo import Learner
from tests.agents.variants import BASE, EVERY_UPDATE, SIGHT, experienced

HERE = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"))]
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]  # of torch.compile itself


def assert_alike(variant: dict[str, Any], device: str, experience, rounding: float) -> None:
    compiled, plain = (
        Learner([4, 4, 3], [2, 2, 1], replace(BASE, **variant, compiled=on), 3, device, sight=SIGHT)
        for on in (True, False)
    )
    for seed in range(3):
        batch = experienced(experience, plain, seed, N=6)
        one, other = compiled.update(batch), plain.update(batch)
        assert one == pytest.approx(other, rel=10 * rounding, abs=rounding)
    theirs = plain.state()
    for name, array in compiled.state().items():
        np.testing.assert_allclose(array, theirs[name], rtol=rounding, atol=rounding, err_msg=name)


@pytest.mark.parametrize("variant", EVERY_UPDATE.values(), ids=EVERY_UPDATE)
def test_every_variant_is_one_graph(variant: dict, experience, monkeypatch):
    """Without the compiler itself, which takes a minute for all of them."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))
    assert_alike(variant, "cpu", experience, 1e-2 if "precision" in variant else 1e-6)


@pytest.mark.parametrize("device", HERE)
@pytest.mark.parametrize("name", ["happo", "paper"])
def test_a_compiled_update_is_an_update(name: str, device: str, experience):
    assert_alike(EVERY_UPDATE[name], device, experience, 1e-4)
