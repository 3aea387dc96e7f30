"""Soft actor-critic (Haarnoja et al., 2018) for one team, with replay and large batches (FastSAC, Seo et al., 2025).

The team has a squashed Gaussian actor and a temperature for each agent, and a twin critic of its observations and all
its agents' actions. After each rollout its decisions join the replay buffer, and `replay_ratio` decisions for each new
one are learnt from:

    y = r / unit + γ (1 − terminated) (Q'(s', a') − Σᵢ αᵢ (log πᵢ(a'ᵢ | o'ᵢ) + H̄ᵢ)),  a' ~ π

or the same over `n_step` decisions. Q' is the mean of both target critics. Temperatures αᵢ keep each entropy at
H̄ᵢ, and the bonus counts from there: its mean is then 0. Thus values stay in the range of the rewards, and an early end
costs nothing more than they say.

Agents then improve one after the other in a random order, each with the new actions of those before it (HASAC, Liu et
al., 2024), or all at once. Agents that are out of the game act by zeros and add nothing to the sum.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from zlib import crc32

import numpy as np
import torch
from torch import Tensor, nn

from agents.batch import Batch
from agents.devices.cuda_graphs import GraphCache, Runner
from agents.learner import checkpoint
from agents.learner.happo import draw_seed
from agents.learner.metric_means import MetricSums, read_means
from agents.learner.optimizer import Adam, autocast_networks, matmul_precision, step
from agents.off_policy.agent import SacAgent, architecture_of
from agents.off_policy.critics import Bins, InputNorm, RewardScale, TwinCritic, merge_statistics
from agents.off_policy.replay import NOBODY, Decisions, Layout, Replay, more_size, valid_rows
from agents.settings import HappoConfig
from arenas.state import AgentSpec

SAVED = ("rows", "valid", "tags", "state")  # of the replay buffer
TEMPERATURE_PACE = 10.0  # of its learning rate, since it has to follow the entropy
MOST_SAVED = 16 * 2**20  # bytes of a buffer in a checkpoint


class SacLearner:
    """A team that learns by soft actor-critic; see `agents.learner.interface.Learner`.

    `critic_size` is the number of inputs of the critic, without actions (0: its team's observations alone). Raises
    ValueError for settings that it refuses.
    """

    def __init__(
        self, agents: Sequence[AgentSpec], settings: HappoConfig, seed: int, device: torch.device, critic_size: int = 0
    ):
        self.config, self.own, self.device = settings, settings.sac, device
        self.rng = torch.Generator().manual_seed(seed)  # part of the state
        self.device_rng = torch.Generator(device)  # each update seeds it from `rng`
        self.graphs = GraphCache(device, settings.cuda_graphs)
        self._observation_sizes = [agent.observation_size for agent in agents]
        self._action_sizes = [agent.action_size for agent in agents]
        seen = critic_size or sum(self._observation_sizes)
        self._layout = Layout(self._observation_sizes, self._action_sizes, seen - sum(self._observation_sizes))
        self._check_saved_size()
        with torch.random.fork_rng(devices=[]):  # nn.init draws from the global generator, which must not change
            torch.manual_seed(seed)
            firsts = np.cumsum([0, *self._action_sizes]).tolist()
            self.agents = [SacAgent(a, i, firsts[i], settings, device) for i, a in enumerate(agents)]
            inputs = seen + sum(self._action_sizes)
            self.critic, self.target = (
                TwinCritic(inputs, self.own.critic_hidden, self.own.bins).to(device) for _ in range(2)
            )
        self.target.load_state_dict(self.critic.state_dict())
        self.target.requires_grad_(False)
        self.bins, self.input_norm = Bins(self.own.bins).to(device), InputNorm(seen).to(device)
        self.rewards = RewardScale().to(device)
        self.temperatures = _Temperatures(len(agents), self.own.temperature).to(device)
        self.critic_optimizer = Adam(self.critic, torch.tensor(self.own.lr, device=device))
        faster = torch.tensor(min(1.0, TEMPERATURE_PACE * self.own.lr), device=device)
        self.temperature_optimizer = Adam(self.temperatures, faster)
        self.metric_sums = MetricSums(("value_loss", "value", "critic_grad_norm"), device)
        self.replay: Replay | None = None  # from the first batch on: a league makes more learners than learn
        self.steps = torch.zeros((), dtype=torch.int64)  # of the critic
        self._tags: Sequence[int] = (NOBODY,)
        self._limit = architecture_of(settings).squash or 1.0
        self._target_entropies = torch.tensor(self._action_sizes, device=device) * (
            self.own.target_entropy + math.log(self._limit)
        )
        self._actor_steps = [partial(self._improve_actor, agent) for agent in self.agents]

    # The five methods ------------------------------------------------------------------------------------------------

    def act(self) -> list[dict[str, Tensor]]:
        """Return the policies by which its agents act in the next rollout: those that `export` gives."""
        return self.export()

    def export(self) -> list[dict[str, Tensor]]:
        """Return each agent's actor's state dict, which is its policy; the tensors are live."""
        return [{k: v.detach() for k, v in agent.network.state_dict().items()} for agent in self.agents]

    def learn(self, batch: Batch) -> dict[str, float]:
        """Keep a rollout's decisions, and take the gradient steps that are due; return means over these.

        Void decisions, and agents in decisions that they took no part in, are never learnt from. Raises Diverged if
        losses or the resulting state are not finite.
        """
        with matmul_precision(self.config.precision):
            self.device_rng.manual_seed(draw_seed(self.rng))
            for metric_sums in self._metric_sums():
                metric_sums.sums.zero_()
            replay = self._remember(batch)
            found = {"replay": float(replay.usable)}
            if replay.usable >= self.own.replay.start:
                self._take_steps(replay, batch.void.numel())
            found |= read_means(self._metric_sums())  # waits for the device, which still reads the batch until then
            found["temperature"] = self.temperatures().mean().item()
        checkpoint.raise_diverged([name for name, value in found.items() if not math.isfinite(value)])
        checkpoint.check_finite(self._tensors())
        return found

    def save(self) -> dict[str, np.ndarray]:
        """Return everything that `load` needs to continue, the replay buffer only if the settings want that."""
        state = checkpoint.write({**self._tensors(), "rewards.returns": self.rewards.returns}, self.rng)
        if self.own.replay.saved:
            replay = self.replay or Replay(1, self._layout.width, self.device)
            state |= {f"replay.{name}": tensor.cpu().numpy() for name, tensor in replay.saved().items()}
        return state

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore a `save()`; a replay buffer that it does not hold is empty then.

        Raises ValueError naming arrays that are missing, of another shape or not finite.
        """
        tensors = self._tensors()
        fixed = [k for k in tensors if k.endswith((".activation", ".squash", ".index", ".own"))]
        checkpoint.read(tensors, fixed, self.rng, state)
        self.rewards.returns = torch.tensor(state.get("rewards.returns", np.zeros(0, np.float32)), device=self.device)
        if self.replay is not None:
            self.replay.clear()
        if self.own.replay.saved and len(state.get("replay.rows", ())):
            held = [torch.tensor(state[f"replay.{name}"], device=self.device) for name in SAVED]
            self._buffer().load(*held)

    # Two more that a league calls ------------------------------------------------------------------------------------

    def reseed(self, seed: int) -> None:
        """Give the learner other random numbers."""
        self.rng.manual_seed(seed)

    def meet(self, opponents: Sequence[str]) -> None:
        """Note against whom the next rollouts are: one text for each of equal groups of worlds, in their order.

        With `replay.forget = "opponents"` decisions against all others are dropped.
        """
        self._tags = [crc32(text.encode()) for text in opponents] or (NOBODY,)
        if self.own.replay.forget == "opponents" and self.replay is not None:
            self.replay.keep(self._tags)

    # Replay ----------------------------------------------------------------------------------------------------------

    def _buffer(self) -> Replay:
        if self.replay is None:
            self.replay = Replay(self.own.replay.capacity, self._layout.width, self.device)
        return self.replay

    def _remember(self, batch: Batch) -> Replay:
        """Put a clean batch into the buffer and into the statistics of observations and rewards."""
        layout, replay = self._layout, self._buffer()
        if more_size(batch) != self._layout.more:
            raise ValueError(f"the critic observes {more_size(batch)} further numbers, not {self._layout.more}")
        rows = layout.rows(batch, self.config.gamma, self.own.n_step)
        valid = valid_rows(batch)
        T, N = batch.void.shape
        tags = torch.tensor(self._tags, device=self.device).repeat_interleave(N // len(self._tags)).repeat(T)
        replay.append(rows, valid, tags)
        seen = layout.decisions(rows)
        for i, agent in enumerate(self.agents):
            agent.observe(seen.observations[i], seen.alive[:, i])
        norm = self.input_norm
        merge_statistics(norm.mean, norm.var, norm.count, _critic_seen(seen), valid.float())
        self.rewards.note(batch.rewards, batch.terminated | batch.truncated | batch.void, self.config.gamma)
        return replay

    def _check_saved_size(self) -> None:
        rows = self.own.replay
        size = rows.capacity * 4 * self._layout.width
        if rows.saved and size > MOST_SAVED:
            most = MOST_SAVED // (4 * self._layout.width)
            raise ValueError(
                f"sac.replay.saved: {rows.capacity} decisions are {size / 2**20:.0f} MiB in each checkpoint; use a"
                f" sac.replay.capacity of {most} or less, or false"
            )

    # Gradient steps --------------------------------------------------------------------------------------------------

    def _take_steps(self, replay: Replay, new: int) -> None:
        """Take the steps that are due for `new` decisions."""
        own, rng = self.own, self.device_rng
        run = self.graphs.for_shape((own.batch,))
        for _ in range(max(1, round(own.replay_ratio * new / own.batch))):
            places = replay.draw(own.batch, rng)
            noise = torch.randn(2, own.batch, sum(self._action_sizes), generator=rng, device=self.device)
            rows = run(self._fetch, places)
            run(self._improve_critic, rows, noise[0], replay.any_valid)
            self.steps += 1
            if int(self.steps) % own.actor_every == 0:
                self._improve_actors(run, rows, noise[1])

    def _fetch(self, places: Tensor) -> Tensor:
        """Return the rows (B, width) of the buffer at these places; zeros if the buffer holds none that is valid."""
        replay = self._buffer()
        return replay.rows.index_select(0, places) * replay.any_valid

    def _improve_critic(self, rows: Tensor, noise: Tensor, any_valid: Tensor) -> None:
        """Take one step of the critic, and let the target follow."""
        batch = self._layout.decisions(rows)
        targets = self.targets(batch, noise)
        with autocast_networks(self.config.precision, rows.device):
            logits = self.critic(self.input_norm(_critic_seen(batch)), batch.actions / self._limit)
        loss = self.bins.losses(logits, targets).mean(-1).sum()
        norm = step(self.critic_optimizer, self.critic_optimizer.gradient(loss), self.own.max_grad_norm, any_valid)
        self.metric_sums.add(
            any_valid, value_loss=loss, value=targets.mean() * self.rewards.unit, critic_grad_norm=norm
        )
        with torch.no_grad():
            theirs: list[Tensor] = [*self.target.parameters()]
            mine: list[Tensor] = [*self.critic.parameters()]
            torch._foreach_lerp_(theirs, mine, self.own.tau)  # pyright: ignore[reportPrivateImportUsage]

    @torch.no_grad()
    def targets(self, batch: Decisions, noise: Tensor) -> Tensor:
        """Return the critic's targets (B,) in units of the scaled reward; `noise` (B, sum of act) draws actions."""
        actions, bonus = [], torch.zeros_like(batch.rewards)
        temperatures = self.temperatures()
        for i, agent in enumerate(self.agents):
            own, log_probs = agent.sample(batch.next_observations[i], noise)
            there = batch.next_alive[:, i]
            actions.append(own * there[:, None])
            bonus -= temperatures[i] * (log_probs + self._target_entropies[i]) * there
        seen = self.input_norm(_critic_seen(batch, after=True))
        values = self._values(self.target, seen, torch.cat(actions, -1))
        return batch.rewards / self.rewards.unit + batch.discounts * (values + bonus)

    def _values(self, critic: TwinCritic, seen: Tensor, actions: Tensor) -> Tensor:
        """Return the mean of both critics' values (B,)."""
        with autocast_networks(self.config.precision, seen.device):
            logits = critic(seen, actions / self._limit)
        return self.bins.values(logits).mean(0)

    def _improve_actors(self, run: Runner, rows: Tensor, noise: Tensor) -> None:
        """Take one step of each actor, then one of the temperatures."""
        joint = run(self._draw_joint, rows, noise)
        order = range(len(self.agents))
        if self.own.sequence and not self.config.fixed_order:
            order = torch.randperm(len(self.agents), generator=self.rng).tolist()
        for i in order:
            run(self._actor_steps[i], rows, joint, noise)
        run(self._improve_temperatures)

    @torch.no_grad()
    def _draw_joint(self, rows: Tensor, noise: Tensor) -> Tensor:
        """Return the team's actions (B, sum of act) by its present policies; zeros of agents that are out."""
        batch = self._layout.decisions(rows)
        drawn = [agent.sample(batch.observations[i], noise)[0] for i, agent in enumerate(self.agents)]
        return torch.cat([own * batch.alive[:, i, None] for i, own in enumerate(drawn)], -1)

    def _improve_actor(self, agent: SacAgent, rows: Tensor, joint: Tensor, noise: Tensor) -> None:
        """Take one step of an actor, whose values are those of the critic for the team's `joint` actions."""
        batch, i = self._layout.decisions(rows), agent.number
        seen, temperature = self.input_norm(_critic_seen(batch)), self.temperatures().detach()[i]
        judge = partial(self._values, self.critic, seen)
        agent.improve(batch.observations[i], batch.alive[:, i], joint, noise, temperature, judge)

    def _improve_temperatures(self) -> None:
        """Raise temperatures of policies whose entropy is below its target, and lower the others."""
        gap = torch.stack([agent.entropy for agent in self.agents]) - self._target_entropies
        loss = (self.temperatures.logs * gap).sum()
        gradient = self.temperature_optimizer.gradient(loss)
        self.temperature_optimizer.step(gradient, torch.ones_like(loss))

    # State -----------------------------------------------------------------------------------------------------------

    def _metric_sums(self) -> list[MetricSums]:
        return [self.metric_sums, *(agent.metric_sums for agent in self.agents)]

    def _tensors(self) -> dict[str, Tensor]:
        """Return all tensors of the state by name, but those of the replay buffer."""
        modules: dict[str, nn.Module] = {f"actor.{agent.number}": agent.network for agent in self.agents}
        modules |= {"critic": self.critic, "target": self.target, "temperatures": self.temperatures}
        modules |= {"input_norm": self.input_norm, "rewards": self.rewards}
        optimizers = {f"actor.{agent.number}": agent.optimizer for agent in self.agents}
        optimizers |= {"critic": self.critic_optimizer, "temperatures": self.temperature_optimizer}
        tensors = {f"{name}.{k}": v for name, module in modules.items() for k, v in module.state_dict().items()}
        tensors |= {f"adam.{name}.{k}": v for name, adam in optimizers.items() for k, v in adam.tensors().items()}
        tensors |= {f"actor.{agent.number}.observed": agent.observed for agent in self.agents}
        return tensors | {"steps": self.steps}


class _Temperatures(nn.Module):
    """A temperature for each of `count` agents, by its logarithm."""

    def __init__(self, count: int, first: float):
        super().__init__()
        self.logs = nn.Parameter(torch.full((count,), math.log(first)))

    def forward(self) -> Tensor:
        """Return the temperatures (agents,)."""
        return self.logs.exp()


def _critic_seen(batch: Decisions, after: bool = False) -> Tensor:
    """Return what the critic observes (B, inputs) before decisions, or `after` them."""
    own, more = (batch.next_observations, batch.next_more) if after else (batch.observations, batch.more)
    return torch.cat([*own, more], -1)
