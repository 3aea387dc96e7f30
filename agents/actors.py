"""How an actor learns: PPO's clipped surrogate on M·Â (Schulman et al., 2017), and what bounds its steps."""

from collections.abc import Sequence

import torch
from torch import Tensor

from agents.batch import Share
from agents.networks import Actor
from agents.optimise import Figures, adam, minibatches, note, step
from agents.settings import HappoConfig

LEAST_LR, MOST_LR, LR_FACTOR = 1e-5, 1e-2, 1.5  # of the adaptive step size, as in rsl_rl


class ActorLearner:
    """An actor that learns, and the agents of the team that act by it: one, or several equal ones."""

    def __init__(self, network: Actor, agents: Sequence[int], config: HappoConfig):
        self.network, self.agents, self.config = network, tuple(agents), config
        self.optimizer = adam(network, config.lr)
        self.lr = torch.tensor(config.lr, dtype=torch.float64)  # part of the state where it adapts

    @torch.no_grad()
    def log_probs(self, share: Share) -> Tensor:
        """Log densities (B,) of the actions under the present policy."""
        return self.network(share.observations).log_prob(share.actions).sum(-1)

    def update(self, share: Share, decay: float, rng: torch.Generator, figures: Figures) -> None:
        """`epochs` × `minibatches` steps of Adam, fewer where the policy has moved by more than `kl_stop`.

        `decay` is what is left of the step size.
        """
        c = self.config
        for _ in range(c.epochs):
            moved = []
            for rows in minibatches(len(share.actions), c.minibatches, rng, share.actions.device):
                loss, found = surrogate_loss(self.network, Share(*(x[rows] for x in share)), c)
                if c.kl_step is not None:
                    self._adapt(float(found["kl"]), c.kl_step)
                norm = step(self.optimizer, self.network, loss, c.max_grad_norm, self.lr.item() * decay)
                note(figures, policy_loss=loss, **found, actor_grad_norm=norm)
                moved.append(found["kl"])
            if c.kl_stop is not None and float(torch.stack(moved).mean()) > c.kl_stop:
                break

    def _adapt(self, kl: float, target: float) -> None:
        """Smaller steps where the policy moved by more than twice the target, larger ones below half of it."""
        if kl > 2 * target:
            self.lr.copy_((self.lr / LR_FACTOR).clamp(min=LEAST_LR))
        elif 0 < kl < target / 2:
            self.lr.copy_((self.lr * LR_FACTOR).clamp(max=MOST_LR))


def surrogate_loss(network: Actor, share: Share, c: HappoConfig) -> tuple[Tensor, dict[str, Tensor]]:
    """Clipped surrogate and entropy bonus as a loss, and figures of the policy that it was computed for."""
    policy = network(share.observations)
    log_ratio = policy.log_prob(share.actions).sum(-1) - share.log_probs
    ratio = torch.exp(log_ratio)
    surrogate = torch.min(ratio * share.MA, ratio.clamp(1 - c.clip, 1 + c.clip) * share.MA)
    entropy = policy.entropy().sum(-1).mean()
    loss = -surrogate.mean() - c.entropy * entropy
    kl = (ratio - 1 - log_ratio).detach().mean()  # never negative, and of low variance (Schulman, 2020)
    return loss, {"entropy": entropy, "ratio": ratio.mean(), "kl": kl}
