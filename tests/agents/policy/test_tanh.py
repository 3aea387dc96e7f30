"""The tanh of networks on a CPU is tanh, with its gradients of first and second order."""

import pytest
import torch

from agents.policy.tanh import tanh


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 2e-7), (torch.float64, 4e-16)])
def test_it_is_tanh(dtype: torch.dtype, error: float):
    x = torch.cat([torch.linspace(-30, 30, 100_001, dtype=dtype), torch.tensor([0.0, 1e-30, -1e-8, 1e30], dtype=dtype)])
    y = tanh(x)
    assert y.dtype == dtype
    assert (y.double() - torch.tanh(x.double())).abs().max() <= error
    assert (y.abs() <= 1).all()


def test_it_keeps_what_is_no_number():
    y = tanh(torch.tensor([float("nan"), float("inf"), -float("inf")]))
    torch.testing.assert_close(y, torch.tensor([float("nan"), 1.0, -1.0]), equal_nan=True)


def test_half_the_digits_are_all_kept():
    x = torch.linspace(-0.1, 0.1, 1001).bfloat16()
    torch.testing.assert_close(tanh(x), torch.tanh(x), rtol=0, atol=0)


def test_its_gradients():
    x = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1), requires_grad=True)
    assert torch.autograd.gradcheck(tanh, x)
    assert torch.autograd.gradgradcheck(tanh, x)


def test_what_is_compiled_has_torchs_own():
    seen = []

    def looking(graph: torch.fx.GraphModule, inputs: list[torch.Tensor]):
        seen.extend(str(node.target) for node in graph.graph.nodes if node.op == "call_function")
        return graph.forward

    torch.compile(tanh, backend=looking)(torch.ones(3))
    assert len(seen) == 1
    assert "tanh" in seen[0]
