"""REINFORCE (Williams, 1992) as a learner of a league: learner.class = "docs/examples/reinforce.py:Reinforce"."""

import torch

from agents.policy.networks import Actor
from agents.settings import Architecture


class Reinforce:
    """Raises the log density of each action by the standardised sum of the rewards that followed it in its episode."""

    def __init__(self, agents, settings, seed, device):
        if unknown := settings.keys() - {"lr", "gamma", "hidden"}:
            raise ValueError(f"settings: {', '.join(sorted(unknown))} is none of lr, gamma, hidden")
        self.lr, self.gamma = settings.get("lr", 0.1), settings.get("gamma", 0.99)
        architecture = Architecture((settings.get("hidden", 16),))
        with torch.random.fork_rng(devices=[]):  # weights are drawn from the global generator, which others use too
            torch.manual_seed(seed)
            self.actors = [
                Actor(agent.observation_size, agent.action_size, architecture, initial_std=0.8).to(device)
                for agent in agents
            ]

    def learn(self, batch):
        """Take one step up the gradient; return the mean discounted reward that followed a decision."""
        returns = self._returns(batch)
        counts = ~batch.void
        spread = returns[counts].std() + 1e-6
        advantage = ((returns - returns[counts].mean()) / spread).where(counts, 0.0)
        for i, actor in enumerate(self.actors):
            density = actor(batch.observations[i]).log_prob(batch.actions[i]).sum(-1)  # (T, N)
            gain = (density * advantage * batch.alive[i]).sum() / counts.sum()
            weights = list(actor.parameters())
            with torch.no_grad():
                for weight, slope in zip(weights, torch.autograd.grad(gain, weights), strict=True):
                    weight += self.lr * slope
        return {"return": returns[counts].mean().item()}

    def _returns(self, batch):
        """Return the discounted rewards (T, N) from each decision to the end of its episode."""
        over, following = batch.terminated | batch.truncated | batch.void, torch.zeros_like(batch.rewards[0])
        returns = torch.empty_like(batch.rewards)
        for t in reversed(range(len(returns))):
            following = batch.rewards[t] + self.gamma * following * ~over[t]
            returns[t] = following
        return returns

    def save(self):
        """Return everything to continue from: plain gradient ascent remembers nothing but the weights."""
        return {f"{i}/{name}": x for i, actor in enumerate(self.actors) for name, x in actor.state_dict().items()}

    def load(self, state):
        """Continue from what `save` gave."""
        for i, actor in enumerate(self.actors):
            actor.load_state_dict({name: torch.tensor(state[f"{i}/{name}"]) for name in actor.state_dict()})

    def export(self):
        """Return what plays: in matches, and since there is no `act`, in training too."""
        return [actor.state_dict() for actor in self.actors]
