"""The twin critic, its bins, statistics and the scale of rewards, against other ways to compute them."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from agents.off_policy.critics import LIMIT, SMOOTHING, Bins, RewardScale, TwinCritic, merge_statistics


def test_a_twin_critic_is_two_networks():
    rng = torch.Generator().manual_seed(1)
    twins = TwinCritic(5, (7, 6), 11)
    assert not twins(torch.zeros(3, 4), torch.zeros(3, 1)).any()
    with torch.no_grad():
        for tensor in twins.parameters():
            tensor += 0.3 * torch.randn(tensor.shape, generator=rng)
    x = torch.randn(9, 5, generator=rng)
    for k in range(2):
        features = x
        for i, width in enumerate((7, 6)):
            layer, norm = nn.Linear(features.shape[-1], width), nn.LayerNorm(width)
            layer.weight, layer.bias = nn.Parameter(twins.weights[i][k].T), nn.Parameter(twins.biases[i][k, 0])
            norm.weight, norm.bias = nn.Parameter(twins.gains[i][k, 0]), nn.Parameter(twins.shifts[i][k, 0])
            features = nn.functional.silu(norm(layer(features)))
        expected = features @ twins.last[k] + twins.last_bias[k]
        torch.testing.assert_close(twins(x[:, :4], x[:, 4:])[k], expected)


def test_a_histogram_is_the_gaussian_around_its_value():
    bins, value = Bins(21), 1.37
    (found,) = bins.histogram(torch.tensor([value]))
    normal = torch.distributions.Normal(value, SMOOTHING * bins.width)
    for centre, share in zip(bins.centres.tolist(), found.tolist(), strict=True):
        points = torch.linspace(centre - bins.width / 2, centre + bins.width / 2, 2001, dtype=torch.float64)
        assert share == pytest.approx(torch.trapezoid(normal.log_prob(points).exp(), points).item(), abs=1e-6)
    assert found.sum().item() == pytest.approx(1.0, abs=1e-6)


def test_values_come_back_from_the_logits_of_their_histogram():
    bins = Bins(101)
    values = torch.linspace(-4.5, 4.5, 37)
    torch.testing.assert_close(bins.values(bins.histogram(values).clamp(min=1e-30).log()), values, atol=1e-4, rtol=0)
    beyond = bins.values(bins.histogram(torch.tensor([-100.0, 100.0])).clamp(min=1e-30).log())
    assert beyond.abs().max() <= LIMIT
    assert beyond[1] > LIMIT - 0.1


def test_the_loss_is_least_at_the_target():
    bins, targets = Bins(21), torch.tensor([0.4, -2.0])
    logits = bins.histogram(targets).clamp(min=1e-30).log().expand(2, 2, 21).clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(bins.losses(logits, targets).sum(), logits)
    assert slope.abs().max() < 1e-6
    other = bins.histogram(targets + 0.5).clamp(min=1e-30).log().expand(2, 2, 21)
    assert (bins.losses(other, targets) > bins.losses(logits, targets) + 0.1).all()


def test_statistics_are_those_of_all_rows_that_count():
    rng = np.random.default_rng(1)
    mean, var, count = torch.zeros(3), torch.ones(3), torch.zeros(())
    rows, counts = rng.normal(2.0, 3.0, (90, 3)), rng.random(90) < 0.6
    for part in range(0, 90, 30):
        here = slice(part, part + 30)
        merge_statistics(mean, var, count, torch.tensor(rows[here]).float(), torch.tensor(counts[here]).float())
    np.testing.assert_allclose(mean, rows[counts].mean(0), rtol=1e-5)
    np.testing.assert_allclose(var, rows[counts].var(0), rtol=1e-5)
    merge_statistics(mean, var, count, torch.full((4, 3), 1e9), torch.zeros(4))
    np.testing.assert_allclose(mean, rows[counts].mean(0), rtol=1e-5)


def test_the_unit_of_rewards_follows_their_discounted_sums_across_batches():
    scale, gamma = RewardScale(), 0.5
    assert scale.unit == 1
    rewards = torch.tensor([[1.0, 0.0], [2.0, 0.0], [0.0, 4.0], [0.0, 1.0]])
    over = torch.tensor([[False, False], [True, False], [False, False], [False, False]])
    scale.note(rewards[:2], over[:2], gamma)
    scale.note(rewards[2:], over[2:], gamma)
    sums = [1.0, 2.5, 0.0, 0.0, 0.0, 0.0, 4.0, 3.0]  # the first world's episode ended with its second decision
    assert scale.unit.item() == pytest.approx(max(math.sqrt(np.square(sums).mean()), 4.0 / LIMIT))
    for _ in range(1000):
        scale.note(torch.zeros(2, 2), torch.ones(2, 2, dtype=torch.bool), gamma)
    assert scale.unit.item() == pytest.approx(4.0 / LIMIT)
