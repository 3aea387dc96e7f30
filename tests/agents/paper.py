"""Teams that learn by HAPPO, and the paper's formulas, written here a second time. PLAIN has γ = 0: A = r − V(s)."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from agents.learner.happo import HappoLearner
from agents.settings import Architecture, HappoConfig

PLAIN = HappoConfig(
    Architecture((5,)), lr=0.02, critic_lr=0.05, gamma=0.0, entropy_coef=0.01, epochs=3, minibatches=1,
    max_grad_norm=0.02, fixed_order=True, value_norm=False,
)  # fmt: skip
FULL = replace(
    PLAIN, gamma=0.97, epochs=2, minibatches=3, fixed_order=False, value_norm=True, normalise_observations=True
)


def new_learner(agents: int, config: HappoConfig = PLAIN, seed: int = 0) -> HappoLearner:
    """Of a team of up to three, all of them unlike."""
    return HappoLearner([4, 3, 5][:agents], [2, 1, 3][:agents], config, seed)


def critic_of(learner: HappoLearner) -> torch.nn.Module:
    return learner.critic_learners[0].network


def log_density(actor: torch.nn.Module, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """log N(a; μ, σ) and the entropy ½ log(2πe σ²), summed over the action's numbers."""
    std = torch.sigmoid(actor.std_logit) * actor.std_scale
    z = (actions - actor.mean(actor.trunk(obs))) / std
    log_probs = (-z * z / 2 - std.log() - math.log(2 * math.pi) / 2).sum(-1)
    return log_probs, (0.5 + math.log(2 * math.pi) / 2 + std.log()).sum()


def adam_step(module: torch.nn.Module, optimizer: torch.optim.Adam, loss: Tensor, max_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    norm = math.sqrt(sum(float((g**2).sum()) for g in gradients))
    assert norm > max_norm  # else the clip of gradients would go untested
    for g in gradients:
        g *= max_norm / norm
    optimizer.step()


def ppo(actor: torch.nn.Module, obs: Tensor, actions: Tensor, old: Tensor, A: Tensor, c: HappoConfig) -> float:
    """PPO (Schulman et al., 2017, eq. 7) on the whole batch; returns the share of clipped ratios."""
    optimizer = torch.optim.Adam(actor.parameters(), c.lr, eps=1e-5)
    clipped = 0.0
    for _ in range(c.epochs):
        log_probs, entropy = log_density(actor, obs, actions)
        r = (log_probs - old).exp()
        bound = torch.where(A > 0, torch.full_like(A, 1 + c.clip), torch.full_like(A, 1 - c.clip))
        gain = torch.where(A > 0, torch.minimum(r, bound), torch.maximum(r, bound)) * A
        adam_step(actor, optimizer, -gain.mean() - c.entropy_coef * entropy, c.max_grad_norm)
        clipped = float((gain != r * A).float().mean())
    return clipped


def standardised_advantage(learner: HappoLearner, batch) -> Tensor:
    with torch.no_grad():
        A = (batch.rewards - critic_of(learner)(torch.cat(list(batch.observations), -1))).flatten()
    return (A - A.mean()) / (A.std(correction=0) + 1e-5)


def worst_gap(a: torch.nn.Module, b: torch.nn.Module) -> float:
    """How far apart two networks are in the weight in which they differ most."""
    return max(float((x - y).detach().abs().max()) for x, y in zip(a.parameters(), b.parameters(), strict=True))
