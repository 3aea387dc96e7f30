"""An agent that learns by soft actor-critic: its actor, and how it samples and improves."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from agents.learner.metric_means import MetricSums
from agents.learner.minibatches import mean_weights
from agents.learner.optimizer import Adam, autocast_networks, step
from agents.off_policy.critics import merge_statistics
from agents.policy.networks import Actor, SquashedGaussian
from agents.settings import OBSERVATION_CLIP, Architecture, HappoConfig
from arenas.state import AgentSpec

Judge = Callable[[Tensor], Tensor]  # values (B,) of the team's actions (B, sum of act)


def architecture_of(config: HappoConfig) -> Architecture:
    """Return the architecture of actors: squashed, to ±1 where the settings do not say otherwise, with their own σ."""
    given = config.architecture
    return replace(given, squash=1.0 if given.squash is None else given.squash, state_std=True)


class SacAgent:
    """The actor of one agent of a team, whose actions are the columns from `first` on among the team's."""

    def __init__(self, agent: AgentSpec, number: int, first: int, config: HappoConfig, device: torch.device):
        sets = [each.places for each in agent.entities]
        self.network = Actor(
            agent.observation_size, agent.action_size, architecture_of(config), config.initial_std, sets
        ).to(device)
        self.number, self.config = number, config
        self.columns = slice(first, first + agent.action_size)
        self.optimizer = Adam(self.network, torch.tensor(config.sac.lr, device=device))
        self.observed = torch.zeros((), device=device)  # decisions in the statistics of its observations
        self.entropy = torch.zeros((), device=device)  # of its policy, in the newest step
        self.metric_sums = MetricSums(("policy_loss", "entropy", "actor_grad_norm"), device)

    def sample(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions (B, act) for observations and the team's noise (B, sum of act), and log densities (B,)."""
        with autocast_networks(self.config.precision, noise.device):
            policy = self.network(observations)
        assert isinstance(policy, SquashedGaussian)
        actions, log_probs = policy.rsample(noise[:, self.columns])
        return actions, log_probs.sum(-1)

    def observe(self, observations: Tensor, alive: Tensor) -> None:
        """Merge observations (B, obs) of decisions in which it was `alive` (B,) into its statistics."""
        trunk = self.network.trunk
        merge_statistics(trunk.observation_mean, trunk.observation_var, self.observed, observations, alive)
        trunk.observation_clip.masked_fill_(self.observed > 0, OBSERVATION_CLIP)

    def improve(
        self, observations: Tensor, alive: Tensor, joint: Tensor, noise: Tensor, temperature: Tensor, judge: Judge
    ) -> None:
        """Take one step up the critic's values of the team's `joint` actions (B, sum of act), with its own new ones.

        Decisions in which it was not `alive` (B,) have no weight. In a sequence its columns of `joint` hold the actions
        of the new policy afterwards.
        """
        weights, any_valid = mean_weights(alive)
        actions, log_probs = self.sample(observations, noise)
        whole = torch.cat([joint[:, : self.columns.start], actions, joint[:, self.columns.stop :]], -1)
        loss = ((temperature * log_probs - judge(whole)) * weights).sum()
        norm = step(self.optimizer, self.optimizer.gradient(loss), self.config.sac.max_grad_norm, any_valid)
        with torch.no_grad():
            self.entropy.copy_(-(log_probs * weights).sum())
            if self.config.sac.sequence:
                joint[:, self.columns] = self.sample(observations, noise)[0] * alive[:, None]
        self.metric_sums.add(any_valid, policy_loss=loss, entropy=self.entropy, actor_grad_norm=norm)
