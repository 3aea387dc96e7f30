"""What all variants must leave as it is: plain HAPPO, written straight down, learns what the learner learns.

Here what counts for nothing is left out by index; the learner, whose shapes must not depend on it, gives it no weight.
"""

import copy
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from agents.batch import Batch
from agents.learner.advantages import advantages
from agents.learner.happo import HappoLearner, draw_seed
from agents.settings import Architecture, HappoConfig

DEFAULT = HappoConfig()
PAPER = HappoConfig(
    Architecture((16, 16), "relu", True), lr=5e-4, critic_lr=5e-4, gamma=0.99, entropy_coef=0.01, epochs=5,
    minibatches=1, max_grad_norm=10.0, initial_std=0.3655, fixed_order=True,
)  # fmt: skip


class Plain:
    """The learner without a variant, a class or a setting too many; it starts from another's weights."""

    def __init__(self, learner: HappoLearner):
        (critic,) = learner.critic_learners
        self.actors, self.critic, self.norm = copy.deepcopy((learner.actors, critic.network, critic.value_norm))
        self.rng, self.shuffle_rng = torch.Generator(), torch.Generator()
        self.rng.set_state(learner.rng.get_state())
        self.c = c = learner.config
        self.adams = [torch.optim.Adam(a.parameters(), c.lr, eps=1e-5, foreach=True) for a in self.actors]
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), c.critic_lr, eps=1e-5, foreach=True)

    def update(self, batch: Batch) -> None:
        c, valid = self.c, ~batch.void
        self.shuffle_rng.manual_seed(draw_seed(self.rng))
        with torch.no_grad():
            team, following = (
                torch.cat([o.where(a[..., None], 0.0) for o, a in zip(obs, alive, strict=True)], -1)
                for obs, alive in (
                    (batch.observations, batch.alive), (batch.next_observations, batch.next_alive)
                )
            )  # fmt: skip
            said = self.critic(team)
            V, V_next = self.norm.denormalise(said), self.norm.denormalise(self.critic(following))
            ends = batch.terminated, batch.truncated, batch.void
            A = advantages(batch.rewards, V, V_next, *ends, c.gamma, c.gae_lambda)[valid]
            R, said, team = A + V[valid], said[valid], team[valid]
            somebody = torch.stack(list(batch.alive)).any(0)[valid]
            A_hat = (A - A[somebody].mean()) / (A[somebody].std(correction=0) + 1e-5)
        for k in self.splits(valid.flatten()):
            self.see(R[k])
            target, value = self.norm.normalise(R[k]), self.critic(team[k])
            held = said[k] + (value - said[k]).clamp(-c.clip, c.clip)
            losses = [
                nn.functional.huber_loss(v, torch.zeros_like(v), reduction="none", delta=c.huber_delta)
                for v in (target - value, target - held)
            ]
            self.step(self.critic, self.critic_adam, torch.max(*losses).mean())
        M, n = torch.ones_like(A), len(self.actors)
        for i in range(n) if c.fixed_order else torch.randperm(n, generator=self.rng).tolist():
            rows, own, actor = batch.alive[i][valid], batch.alive[i] & valid, self.actors[i]
            obs, acts, old, MA = (
                *(x[i][own] for x in (batch.observations, batch.actions, batch.log_probs)),
                (M * A_hat)[rows],
            )
            with torch.no_grad():
                before = actor(obs).log_prob(acts).sum(-1)
            for k in self.splits(own.flatten()):
                policy = actor(obs[k])
                r = torch.exp(policy.log_prob(acts[k]).sum(-1) - old[k])
                gain = torch.min(r * MA[k], r.clamp(1 - c.clip, 1 + c.clip) * MA[k]).mean()
                self.step(actor, self.adams[i], -gain - c.entropy_coef * policy.entropy().sum(-1).mean())
            with torch.no_grad():
                M[rows] *= torch.exp(actor(obs).log_prob(acts).sum(-1) - before)

    def splits(self, counts: Tensor) -> list[Tensor]:
        """Minibatches of all B rows, of which those that count are kept, as numbers among these."""
        number, size = counts.cumsum(0) - 1, len(counts)
        passes = [
            torch.randperm(size, generator=self.shuffle_rng).chunk(self.c.minibatches) for _ in range(self.c.epochs)
        ]
        kept = [number[weights[counts[weights]]] for mean_weights in passes for weights in mean_weights]
        return [k for k in kept if len(k)]

    def see(self, R: Tensor) -> None:
        """The value normaliser's sums fade by β."""
        sums = (self.norm.mean_sum, R.mean()), (self.norm.square_sum, (R**2).mean()), (self.norm.weight, 1.0)
        for kept, new in sums:
            kept.mul_(self.norm.beta).add_((1 - self.norm.beta) * new)

    def step(self, module: nn.Module, adam: torch.optim.Adam, loss: Tensor) -> None:
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(module.parameters(), self.c.max_grad_norm)
        adam.step()


@pytest.mark.parametrize(
    "config", [DEFAULT, PAPER, replace(DEFAULT, minibatches=3)], ids=["default", "paper", "uneven"]
)
def test_the_default_learner_is_plain_happo(config, experience):
    learner = HappoLearner([4, 3, 5], [2, 1, 3], config, seed=3)
    plain = Plain(learner)
    for seed in range(3):
        batch = experience(learner, seed=seed, void=0.1)
        rng = torch.Generator().manual_seed(seed)
        batch = batch._replace(alive=[torch.rand(a.shape, generator=rng) < 0.8 for a in batch.alive])
        learner.learn(batch)
        plain.update(batch)
    modules = [*zip(plain.actors, learner.actors, strict=True), (plain.critic, learner.critic_learners[0].network)]
    for ours, theirs in (*modules, (plain.norm, learner.critic_learners[0].value_norm)):
        for name, tensor in ours.state_dict().items():
            torch.testing.assert_close(tensor, theirs.state_dict()[name], atol=1e-6, rtol=1e-6, msg=name)
    assert torch.equal(plain.rng.get_state(), learner.rng.get_state())
    fresh = HappoLearner([4, 3, 5], [2, 1, 3], config, seed=3)
    assert not torch.equal(fresh.actors[2].mean.weight, learner.actors[2].mean.weight)
