"""How an actor learns: PPO's clipped surrogate on M·Â (Schulman et al., 2017), and what bounds its steps."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from agents.batch import Batch, Sequences, Share, rows, rows_of
from agents.graphs import Run
from agents.networks import Actor
from agents.optimise import Adam, Tally, fused, minibatches, networks, parts, step
from agents.parallel import ALONE, Together
from agents.settings import HappoConfig

LEAST_LR, MOST_LR, LR_FACTOR = 1e-5, 1e-2, 1.5  # of the adaptive step size, as in rsl_rl
FIGURES = ("policy_loss", "entropy", "ratio", "kl", "actor_grad_norm")


class ActorLearner:
    """An actor that learns, and the agents of the team that act by it: one, or several equal ones."""

    def __init__(self, network: Actor, agents: Sequence[int], config: HappoConfig, together: Together = ALONE):
        self.network, self.agents, self.config, self.together = network, tuple(agents), config, together
        device = network.std_scale.device
        self.lr = torch.tensor(config.lr, dtype=torch.float64, device=device)  # part of the state where it adapts
        self.rate = torch.tensor(config.lr, device=device)  # what Adam steps by: `lr`, or what has decayed of it
        self.optimizer = Adam(network, self.rate)
        self.tally = Tally(FIGURES, device)
        self.surrogate_loss = fused(surrogate_loss, config.compiled)
        self.loss = fused(self._loss, config.compiled and together.size == 1)  # messages are no part of kernels
        self.step = fused(self._step, config.compiled)
        self.log_probs = fused(self._log_probs, config.compiled)
        self.ratios = fused(self._ratios, config.compiled)

    @torch.no_grad()
    def share(self, batch: Batch, M: Tensor, A_hat: Sequence[Tensor]) -> Share:
        """What the agents did in a clean batch, one after the other, each with its own M·Â."""
        chunk, units, found = self.config.sequence, self.config.architecture.recurrent, []
        for i in self.agents:
            actions, old, alive = (rows(x[i], chunk) for x in (batch.actions, batch.log_probs, batch.alive))
            obs = self.network.trunk.normalised(rows(batch.observations[i], chunk))
            if chunk is not None:
                obs = Sequences(obs, rows(batch.first[0], chunk), batch.memories[i][..., :units].flatten(0, 1))
            found.append(Share(obs, actions, old, (M * A_hat[i]).masked_fill(~alive, 0.0), alive))
        return pytree.tree_map(lambda *each: torch.cat(each), *found)

    def seen(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """(B, obs) What agents saw in the decisions of a clean batch, one after the other; (B,) bool: took part."""
        mine = [(batch.observations[i].flatten(0, 1), batch.alive[i].flatten()) for i in self.agents]
        return torch.cat([obs for obs, _ in mine]), torch.cat([alive for _, alive in mine])

    @torch.no_grad()
    def _log_probs(self, share: Share) -> Tensor:
        """Log densities (B,) of the actions under the present policy."""
        return self.network(share.observations).log_prob(share.actions).sum(-1)

    @torch.no_grad()
    def _ratios(self, share: Share, before: Tensor) -> Tensor:
        """(B / agents,) By how much the densities of the agents' actions have risen; 1 where an agent took no part."""
        ratio = torch.exp(self._log_probs(share) - before).masked_fill(~share.valid, 1.0)
        return torch.stack(ratio.chunk(len(self.agents))).prod(0)

    def rows_of(self, batch: Batch) -> int:
        """How many rows its shares of a batch have."""
        return len(self.agents) * rows_of(batch, self.config.sequence)

    def update(self, share: Share, decay: float, orders: Sequence[Tensor], run: Run) -> None:
        """`minibatches` steps of Adam for each order of the rows, fewer where the policy moves by more than `kl_stop`.

        `decay` is what is left of the step size.
        """
        c = self.config
        self.rate.copy_(self.lr * decay)
        for order in orders:
            moved = run(self.learn, share, order)
            if c.kl_stop is not None and moved.item() > c.kl_stop:
                break

    def learn(self, share: Share, order: Tensor) -> Tensor:
        """One pass over the rows in this order; () the mean KL divergence of its minibatches."""
        c, before = self.config, self.tally.sums.clone()
        for minibatch in minibatches(share, order, c.minibatches):
            loss, found, taught = self.loss(minibatch)
            mine = (*self.optimizer.slope(loss), loss.detach(), found["entropy"], found["rise"], found["kl"])
            *gradient, loss, entropy, rise, kl = self.together.sum(*mine)
            if c.kl_step is not None:  # not in what is compiled: torch 2.13 leaves out what it writes to a float64 ()
                self._adapt(kl, c.kl_step)
            self.step(gradient, taught, loss, entropy, rise, kl)
        return self.tally.mean("kl", before)

    def _loss(self, share: Share) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """The loss of a minibatch and its figures; and whether any decision counts, () 1 or 0."""
        part, taught = parts(share.valid, self.together)
        return *self.surrogate_loss(self.network, share, part, self.config), taught

    def _step(
        self, gradient: Sequence[Tensor], taught: Tensor, loss: Tensor, entropy: Tensor, rise: Tensor, kl: Tensor
    ) -> None:
        """A step of Adam down the gradient, and the figures of the minibatch that it is from."""
        norm = step(self.optimizer, gradient, self.config.max_grad_norm, taught)
        self.tally.note(taught, policy_loss=loss, entropy=entropy, ratio=1 + rise, kl=kl, actor_grad_norm=norm)

    def _adapt(self, kl: Tensor, target: float) -> None:
        """Smaller steps where the policy moved by more than twice the target, larger ones below half of it."""
        smaller, larger = (self.lr / LR_FACTOR).clamp(min=LEAST_LR), (self.lr * LR_FACTOR).clamp(max=MOST_LR)
        lr = torch.where((kl > 0) & (kl < target / 2), larger, self.lr)
        self.lr.copy_(torch.where(kl > 2 * target, smaller, lr))
        self.rate.copy_(self.lr)


def surrogate_loss(network: Actor, share: Share, part: Tensor, c: HappoConfig) -> tuple[Tensor, dict[str, Tensor]]:
    """Clipped surrogate and entropy bonus as a loss, and figures of the policy that it was computed for.

    Each is a sum over the decisions, of which `part` (B, ...) is what each is worth in a mean. `rise` is the mean ratio
    less 1; where a decision is worth nothing its ratio is 1, whatever the policy says there.
    """
    with networks(c.precision, share.MA.device):
        policy = network(share.observations)
    log_ratio = (policy.log_prob(share.actions).sum(-1) - share.log_probs).masked_fill(~share.valid, 0.0)
    rise = torch.expm1(log_ratio)  # r − 1
    # min(r·MÂ, clip(r, 1 ± ε)·MÂ) = MÂ + min((r − 1)·MÂ, ε·|MÂ|), of which half as many kernels make the gradient
    surrogate = share.MA + (rise * share.MA).clamp(max=c.clip * share.MA.abs())
    entropy = (policy.entropy().sum(-1) * part).sum()
    loss = -(surrogate * part).sum() - c.entropy * entropy
    entropy, rise, log_ratio = entropy.detach(), rise.detach(), log_ratio.detach()
    kl = ((rise - log_ratio) * part).sum()  # never negative, and of low variance (Schulman, 2020)
    return loss, {"entropy": entropy, "rise": (rise * part).sum(), "kl": kl}
