import numpy as np
import pytest
import torch
from torch import Tensor

from agents.learner.advantages import ValueNorm, advantages
from agents.learner.minibatches import mean_weights

NO = [False] * 4


def column(*values: object) -> Tensor:
    return torch.tensor(values)[:, None]


def at(t: int) -> Tensor:
    return column(*(i == t for i in range(4)))


# γ = λ = ½, V(s_t) = 1, 2, 3, 4. Decisions 2 and 3 are the same in every world:
#   δ_3 = 2 + ½·6 − 4 = 1     A_3 = 1
#   δ_2 = 0 + ½·4 − 3 = −1    A_2 = −1 + ¼·1 = −¾
# and δ_0 = 1 + ½·2 − 1 = 1. What differs is how decision 1 ends and what A_0 = 1 + ¼·A_1 makes of it.
@pytest.mark.parametrize(
    ("end", "reward", "next_value", "A_1"),
    [
        pytest.param("none", 0.0, 3.0, -0.5 + 0.25 * -0.75, id="goes on: δ = 0 + ½·3 − 2"),
        pytest.param("terminated", 5.0, 8.0, 3.0, id="terminated: δ = 5 − 2, no future"),
        pytest.param("truncated", 5.0, 8.0, 7.0, id="truncated: δ = 5 + ½·8 − 2, the true last observation"),
        pytest.param("void", 99.0, 99.0, 0.0, id="void: 0, and A_0 stops at V(s_1)"),
        pytest.param("void", np.nan, np.inf, 0.0, id="void: 0 whatever it holds"),
    ],
)
def test_advantages_by_hand(end, reward, next_value, A_1):
    flags = {name: at(1) if name == end else column(*NO) for name in ("terminated", "truncated", "void")}
    rewards = column(1.0, reward, 0.0, 2.0)
    values, next_values = column(1.0, 2.0, 3.0, 4.0), column(2.0, next_value, 4.0, 6.0)
    found = advantages(rewards, values, next_values, **flags, gamma=0.5, lam=0.5)
    assert found[:, 0].tolist() == [1 + 0.25 * A_1, A_1, -0.75, 1.0]


def test_advantages_equal_the_sum_over_the_rest_of_the_episode():
    rng = np.random.default_rng(0)
    T, N, gamma, lam = 40, 7, 0.97, 0.9
    r, v, v_next = rng.normal(size=(3, T, N))
    kind = rng.choice(4, size=(T, N), p=[0.8, 0.08, 0.06, 0.06])  # goes on, terminated, truncated, void
    expected = np.zeros((T, N))
    for n in range(N):
        for t in range(T):
            for k in range(t, T):  # Σ (γλ)^l δ_{t+l} up to the end of the episode
                if kind[k, n] == 3:
                    break
                future = 0.0 if kind[k, n] == 1 else gamma * v_next[k, n]
                expected[t, n] += (gamma * lam) ** (k - t) * (r[k, n] + future - v[k, n])
                if kind[k, n] != 0:
                    break
    ends = (torch.tensor(kind == i) for i in (1, 2, 3))
    found = advantages(*map(torch.tensor, (r, v, v_next)), *ends, gamma, lam)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def see(norm: ValueNorm, returns: torch.Tensor, valid: torch.Tensor | None = None) -> None:
    """Update by the returns that are valid, without any other all of them."""
    norm.update(returns, *mean_weights(torch.ones_like(returns, dtype=torch.bool) if valid is None else valid))


def test_value_norm_by_hand():
    norm = ValueNorm(beta=0.5)
    see(norm, torch.tensor([2.0, 4.0]))  # mean 3, mean square 10: both halved, and so is the weight
    assert [float(x) for x in norm.statistics()] == [3.0, 1.0]
    see(norm, torch.tensor([0.0]))  # sums 3/4 and 5/2, weight 3/4: mean 1, variance 10/3 − 1
    mean, std = norm.statistics()
    assert float(mean) == 1.0
    assert float(std) == pytest.approx((7 / 3) ** 0.5)
    assert float(norm.normalise(torch.tensor(8.0))) == pytest.approx(7 / (7 / 3) ** 0.5)
    assert float(norm.denormalise(norm.normalise(torch.tensor(8.0)))) == pytest.approx(8.0)


def test_value_norm_has_no_bias_towards_zero_at_the_start():
    returns = torch.tensor([10.0, 14.0])
    norm = ValueNorm()
    assert torch.equal(norm.normalise(returns), returns)
    assert torch.equal(norm.denormalise(returns), returns)
    see(norm, returns)
    mean, std = norm.statistics()
    assert float(mean) == pytest.approx(12.0, rel=1e-4)
    assert float(std) == pytest.approx(2.0, rel=1e-3)


def test_value_norm_never_divides_by_less_than_a_tenth():
    norm = ValueNorm()
    see(norm, torch.full((5,), 3.0))
    assert float(norm.statistics()[1]) == pytest.approx(0.1)


def test_value_norm_sees_what_is_valid_alone(same):
    norm, alone = ValueNorm(beta=0.5), ValueNorm(beta=0.5)
    see(norm, torch.tensor([2.0, 9.0, 4.0]), torch.tensor([True, False, True]))
    see(alone, torch.tensor([2.0, 4.0]))
    assert same(*({k: v.numpy() for k, v in each.state_dict().items()} for each in (norm, alone)))
    before = {k: v.numpy().copy() for k, v in norm.state_dict().items()}
    see(norm, torch.tensor([2.0, 9.0]), torch.zeros(2, dtype=torch.bool))
    assert same(before, {k: v.numpy() for k, v in norm.state_dict().items()})
