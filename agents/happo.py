"""HAPPO (Kuba et al., 2022; Zhong et al., 2024) for one team: an actor per agent, one critic, one value normaliser.

The team's agents are updated one after the other. Each maximises the clipped surrogate of PPO on an advantage that is
multiplied by M, the product of the probability ratios of the agents before it, so that every step improves the joint
policy that those before it have already made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from agents.networks import Actor, Architecture, Critic
from agents.returns import ValueNorm, advantages


@dataclass(frozen=True)
class HappoConfig:
    """The learner's settings; HARL-A's own values are in docs/learning.md."""

    architecture: Architecture = field(default_factory=Architecture)
    """Networks of actors and critics."""
    lr: float = field(default=1e-3, metadata={"low": 0.0, "high": 1.0})
    """Adam's step size for the actors."""
    critic_lr: float = field(default=1e-3, metadata={"low": 0.0, "high": 1.0})
    """Adam's step size for the critic."""
    gamma: float = field(default=0.985, metadata={"low": 0.0, "high": 1.0})
    """Discount per decision."""
    lam: float = field(default=0.95, metadata={"low": 0.0, "high": 1.0})
    """λ of the advantage estimate."""
    clip: float = field(default=0.2, metadata={"low": 0.0, "high": 1.0})
    """PPO's ε, for ratios and for values."""
    entropy: float = field(default=0.005, metadata={"low": 0.0})
    """Weight of the entropy bonus."""
    epochs: int = field(default=4, metadata={"low": 1})
    """Passes over each batch, for actors and critic."""
    minibatches: int = field(default=4, metadata={"low": 1})
    """Parts into which each pass splits the batch."""
    max_grad_norm: float = field(default=0.5, metadata={"low": 0.0})
    """Gradients are scaled down to this norm."""
    huber_delta: float = field(default=10.0, metadata={"low": 0.0})
    """Where the value loss turns from square to linear, in normalised units."""
    initial_std: float = field(default=0.8, metadata={"low": 0.01, "high": 10.0})
    """Standard deviation of a fresh policy's actions (HARL-A: 0.366)."""
    value_norm: bool = True
    """Normalise returns by their running mean and deviation (ValueNorm)."""
    normalise_observations: bool = False
    """Normalise observations by their running mean and deviation; the statistics are part of the policy."""
    fixed_order: bool = False
    """Update the agents in the team's order instead of a fresh random one each time (HARL-A: true)."""


class Batch(NamedTuple):
    """A team's experience of T decisions in N worlds, one entry per agent in the sequences."""

    observations: Sequence[Tensor]  # (T, N, obs)
    next_observations: Sequence[Tensor]  # (T, N, obs)
    actions: Sequence[Tensor]  # (T, N, act)
    log_probs: Sequence[Tensor]  # (T, N)
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) bool
    truncated: Tensor  # (T, N) bool
    void: Tensor  # (T, N) bool: what this decision led to is unknown


class Learner:
    """A team that learns, on `device` auto, cpu or cuda. Its whole state is `state()`, from which `load` goes on."""

    def __init__(
        self,
        observation_sizes: Sequence[int],
        action_sizes: Sequence[int],
        config: HappoConfig,
        seed: int,
        device: str = "cpu",
    ):
        self.config = config
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(device)
        self.rng = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):  # nn.init draws from the global generator; leave that as it was
            torch.manual_seed(seed)
            arch = config.architecture
            sizes = zip(observation_sizes, action_sizes, strict=True)
            self.actors = [Actor(o, a, arch, config.initial_std).to(self.device) for o, a in sizes]
            self.critic = Critic(observation_sizes, arch).to(self.device)
        self.value_norm = ValueNorm().to(self.device)
        self.observation_count = torch.zeros(())
        self.actor_optimizers = [_adam(actor, config.lr) for actor in self.actors]
        self.critic_optimizer = _adam(self.critic, config.critic_lr)

    def update(self, batch: Batch) -> dict[str, float]:
        """One HAPPO update of every actor and of the critic; returns losses and diagnostics, means over the update.

        Void decisions are left out: whatever they hold, the update is the same. Where all are void there is none.
        """
        c = self.config
        valid = ~batch.void  # (T, N); below, x[valid] has one row for each of the B valid decisions
        if not valid.any():
            return {}
        team = torch.cat(list(batch.observations), -1)  # (T, N, all own observations)
        with torch.no_grad():
            predictions = self.critic(team)  # in normalised units, as all that the critic says
            values = self._denormalise(predictions)
            next_values = self._denormalise(self.critic(torch.cat(list(batch.next_observations), -1)))
        A = advantages(
            batch.rewards, values, next_values, batch.terminated, batch.truncated, batch.void, c.gamma, c.lam
        )[valid]  # (B,)
        values = values[valid]
        returns = A + values
        A_hat = (A - A.mean()) / (A.std(correction=0) + 1e-5)

        M = torch.ones_like(A)  # the ratios of the agents that have already moved, (B,)
        stats: dict[str, list[Tensor]] = {}
        for i in self._order():
            obs, actions = batch.observations[i][valid], batch.actions[i][valid]
            before = self._log_probs(i, obs, actions)
            self._update_actor(i, obs, actions, batch.log_probs[i][valid], M * A_hat, stats)
            M = M * torch.exp(self._log_probs(i, obs, actions) - before)
        self._update_critic(team[valid], predictions[valid], returns, stats)
        if c.normalise_observations:
            self._observe([o[valid] for o in batch.observations])
        spread = returns.var(correction=0).clamp(min=1e-8)
        stats["explained_variance"] = [1 - (returns - values).var(correction=0) / spread]
        return {name: float(torch.stack(x).mean()) for name, x in stats.items()}

    @torch.no_grad()
    def _log_probs(self, i: int, obs: Tensor, actions: Tensor) -> Tensor:
        """Log densities of the actions under agent i's present policy."""
        return self.actors[i](obs).log_prob(actions).sum(-1)

    def _update_actor(
        self,
        i: int,
        obs: Tensor,
        actions: Tensor,
        old: Tensor,
        MA: Tensor,
        stats: dict[str, list[Tensor]],
    ) -> None:
        """Clipped surrogate of PPO on M·Â, an entropy bonus, `epochs` × `minibatches` steps of Adam."""
        c, actor = self.config, self.actors[i]
        for rows in self._minibatches(len(obs)):
            policy = actor(obs[rows])
            ratio = torch.exp(policy.log_prob(actions[rows]).sum(-1) - old[rows])
            surrogate = torch.min(ratio * MA[rows], ratio.clamp(1 - c.clip, 1 + c.clip) * MA[rows])
            entropy = policy.entropy().sum(-1).mean()
            loss = -surrogate.mean() - c.entropy * entropy
            self._step(self.actor_optimizers[i], actor, loss)
            _note(stats, policy_loss=loss, entropy=entropy, ratio=ratio.mean())

    def _update_critic(self, team: Tensor, old: Tensor, returns: Tensor, stats: dict[str, list[Tensor]]) -> None:
        """Clipped value loss under Huber, on returns that the normaliser has just seen."""
        c = self.config
        for rows in self._minibatches(len(team)):
            if c.value_norm:
                self.value_norm.update(returns[rows])
            target, value = self._normalise(returns[rows]), self.critic(team[rows])
            clipped = old[rows] + (value - old[rows]).clamp(-c.clip, c.clip)
            loss = torch.max(self._huber(target - value), self._huber(target - clipped)).mean()
            self._step(self.critic_optimizer, self.critic, loss)
            _note(stats, value_loss=loss)

    def _step(self, optimizer: torch.optim.Adam, module: nn.Module, loss: Tensor) -> None:
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(module.parameters(), self.config.max_grad_norm)
        optimizer.step()

    def _order(self) -> list[int]:
        n = len(self.actors)
        return list(range(n)) if self.config.fixed_order else torch.randperm(n, generator=self.rng).tolist()

    def _minibatches(self, size: int) -> list[Tensor]:
        """Row indices: `epochs` random splits into `minibatches` parts."""
        c = self.config
        splits = (
            torch.randperm(size, generator=self.rng).to(self.device).chunk(c.minibatches) for _ in range(c.epochs)
        )
        return [rows for split in splits for rows in split]

    def _huber(self, error: Tensor) -> Tensor:
        """e²/2 inside δ, δ(|e| − δ/2) outside."""
        return nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=self.config.huber_delta)

    def _normalise(self, returns: Tensor) -> Tensor:
        return self.value_norm.normalise(returns) if self.config.value_norm else returns

    def _denormalise(self, values: Tensor) -> Tensor:
        return self.value_norm.denormalise(values) if self.config.value_norm else values

    @torch.no_grad()
    def _observe(self, observations: Sequence[Tensor]) -> None:
        """Merge observations (B, obs) into the running statistics (Chan et al., 1979), after they were learnt from."""
        n = len(observations[0])
        weight = n / (float(self.observation_count) + n)
        self.observation_count += n
        trunks = [*(actor.trunk for actor in self.actors), self.critic.trunk]
        for trunk, obs in zip(trunks, [*observations, torch.cat(list(observations), -1)], strict=True):
            gap = obs.mean(0) - trunk.observation_mean
            var = trunk.observation_var
            var += weight * (obs.var(0, correction=0) - var) + weight * (1 - weight) * gap**2
            trunk.observation_mean += weight * gap

    # State -----------------------------------------------------------------------------------------------------------

    def policies(self) -> list[dict[str, Tensor]]:
        """Each actor's state dict, which is its policy; the tensors are live."""
        return [{k: v.detach() for k, v in actor.state_dict().items()} for actor in self.actors]

    def state(self) -> dict[str, np.ndarray]:
        """Everything that going on needs: weights, optimisers, normalisers, random numbers."""
        arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in self._tensors().items()}
        return {**arrays, "rng": self.rng.get_state().numpy().copy()}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from `state()`. Raises ValueError naming what is missing, of another shape or another activation."""
        tensors = self._tensors()
        wrong = [k for k, t in tensors.items() if k not in state or np.shape(state[k]) != tuple(t.shape)]
        fixed = [f"actor.{i}.activation" for i in range(len(self.actors))]
        wrong += [k for k in fixed if k not in wrong and state[k] != tensors[k].item()]
        wrong += ["rng"] if "rng" not in state else []
        if wrong:
            raise ValueError(f"the checkpoint does not fit this learner: {', '.join(wrong[:3])} ({len(wrong)} in all)")
        with torch.no_grad():
            for name, tensor in tensors.items():
                tensor.copy_(torch.from_numpy(np.array(state[name])))
        self.rng.set_state(torch.from_numpy(np.array(state["rng"])))

    def _optimized(self) -> list[tuple[torch.optim.Adam, nn.Module]]:
        return [*zip(self.actor_optimizers, self.actors, strict=True), (self.critic_optimizer, self.critic)]

    def _tensors(self) -> dict[str, Tensor]:
        """Every tensor of the state by name."""
        modules = {**{f"actor.{i}": a for i, a in enumerate(self.actors)}, "critic": self.critic}
        tensors = {f"{m}.{k}": v for m, module in modules.items() for k, v in module.state_dict().items()}
        tensors |= {f"value_norm.{k}": v for k, v in self.value_norm.state_dict().items()}
        tensors["observation_count"] = self.observation_count
        for name, (optimizer, module) in zip(modules, self._optimized(), strict=True):
            for parameter_name, parameter in module.named_parameters():
                moments = optimizer.state[parameter]
                tensors |= {f"adam.{name}.{parameter_name}.{k}": v for k, v in moments.items()}
        return tensors


def _adam(module: nn.Module, lr: float) -> torch.optim.Adam:
    """Adam with its moments made at once, where it would make them at its first step: a fresh state is complete too."""
    optimizer = torch.optim.Adam(module.parameters(), lr=lr, eps=1e-5, foreach=True)
    for parameter in module.parameters():
        optimizer.state[parameter] = {
            "step": torch.zeros(()),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return optimizer


def _note(stats: dict[str, list[Tensor]], **values: Tensor) -> None:
    """Keep values on the device: reading each one would make the GPU wait a hundred times an update."""
    for name, value in values.items():
        stats.setdefault(name, []).append(value.detach())
