"""HAPPO (Kuba et al., 2022; Zhong et al., 2024) and its variants for one team: actors, critics, value normalisers.

The team's agents are updated one after the other. Each maximises the clipped surrogate of PPO on an advantage that is
multiplied by M, the product of the probability ratios of the agents before it, so that every step improves the joint
policy that those before it have already made. HATRPO does the same by trust region; MAPPO and IPPO leave M out, and in
IPPO each agent has a critic of its own. Equal robots may share an actor, which then is updated once, from all they did.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from agents import checkpoint
from agents.actors import ActorLearner
from agents.batch import Batch, Critique, Share
from agents.checkpoint import State
from agents.critics import CriticLearner
from agents.networks import Actor, Critic
from agents.optimise import Figures, moments, note
from agents.settings import OBSERVATION_CLIP, HappoConfig
from agents.trust_region import TrustRegionLearner


class Learner:
    """A team that learns, on `device` auto, cpu or cuda. Its whole state is `state()`, from which `load` goes on.

    `kinds` are the agents' robots; agents of one kind and equal sizes are equal. Without them all are of one kind.
    `others` are the observation sizes of the other teams' agents, in the order in which batches hold them.
    """

    def __init__(
        self,
        observation_sizes: Sequence[int],
        action_sizes: Sequence[int],
        config: HappoConfig,
        seed: int,
        device: str = "cpu",
        kinds: Sequence[str] = (),
        others: Sequence[int] = (),
    ):
        self.config = c = config
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(device)
        self.rng = torch.Generator().manual_seed(seed)
        n, arch = len(observation_sizes), c.architecture
        equal = list(zip(kinds or [""] * n, observation_sizes, action_sizes, strict=True))
        self.leaders = [equal.index(e) if c.share_actors else i for i, e in enumerate(equal)]
        together = {leader: [i for i in range(n) if self.leaders[i] == leader] for leader in sorted({*self.leaders})}
        circles = [[i] for i in range(n)] if c.method == "ippo" else [list(range(n))]
        sizes = [sum(observation_sizes[i] for i in circle) for circle in circles]
        with torch.random.fork_rng(devices=[]):  # nn.init draws from the global generator; leave that as it was
            torch.manual_seed(seed)
            actors = [Actor(*equal[leader][1:], arch, c.initial_std).to(self.device) for leader in together]
            extra = others if c.critic_input == "all" else ()
            critics = [Critic([size, *extra], arch).to(self.device) for size in sizes]
        kind = TrustRegionLearner if c.method == "hatrpo" else ActorLearner
        self.actor_learners = [kind(a, agents, c) for a, agents in zip(actors, together.values(), strict=True)]
        self.critic_learners = [CriticLearner(v, circle, c) for v, circle in zip(critics, circles, strict=True)]
        self.observation_counts = torch.zeros(len(actors) + len(critics))  # of each actor, then of each critic
        self.steps = torch.zeros((), dtype=torch.int64)  # decisions × worlds learnt from, where step sizes decay

    @property
    def actors(self) -> list[Actor]:
        """Each agent's actor; those that share one have the same."""
        by_leader = {learner.agents[0]: learner.network for learner in self.actor_learners}
        return [by_leader[leader] for leader in self.leaders]

    def update(self, batch: Batch) -> dict[str, float]:
        """One update of every actor and critic; returns losses and diagnostics, means over the update.

        Void decisions are left out: whatever they hold, the update is the same. Where all are void there is none. So
        are the numbers of an agent that was not alive: its rows teach its actor nothing and leave M as it is, a
        decision without any living agent is no part of Â's mean and deviation, and the critic sees zeros for it.
        Raises Diverged where rewards, actions, log densities, losses, gradients or the state that results are not
        finite; the state is then worthless, and `load` brings back one that is not.
        """
        valid = ~batch.void  # (T, N); below, x[valid] has one row for each of the B valid decisions
        self._check_batch(batch)
        if not valid.any():
            self._check_state()  # a policy that is not finite makes every world void
            return {}
        critiques = [critic.criticise(batch, valid) for critic in self.critic_learners]
        alive = [a[valid] for a in batch.alive]
        A_hat = self._standardised(critiques, alive)

        M = torch.ones_like(critiques[0].advantages)  # the ratios of the agents that have already moved, (B,)
        decay, figures = self._decay(), Figures()
        for k in self._order():
            actor = self.actor_learners[k]
            parts = [self._share(batch, valid, i, (M * A_hat[i])[alive[i]]) for i in actor.agents]
            share = Share(*(torch.cat(x) for x in zip(*parts, strict=True))) if len(parts) > 1 else parts[0]
            if not len(share.actions):
                continue  # out of the game all the time
            before = actor.log_probs(share)
            actor.update(share, decay, self.rng, figures)
            if self.config.method in ("happo", "hatrpo"):
                ratios = torch.exp(actor.log_probs(share) - before).split([len(p.actions) for p in parts])
                for i, ratio in zip(actor.agents, ratios, strict=True):
                    M[alive[i]] *= ratio
        for critic, critique in zip(self.critic_learners, critiques, strict=True):
            critic.update(critique, decay, self.rng, figures)
        if self.config.normalise_observations:
            self._observe(batch, valid, critiques)
        self._pace(batch, decay, figures)
        return self._read(figures)

    def update_critic_only(self, batch: Batch) -> dict[str, float]:
        """The critics' share of `update`, for a team whose policy rests: its values follow what others learn meanwhile.

        Actors and observation statistics, which are part of the policy, stay as they are. Raises Diverged as `update`.
        """
        valid = ~batch.void
        self._check_batch(batch)
        if not valid.any():
            self._check_state()
            return {}
        figures = Figures()
        for critic in self.critic_learners:
            critic.update(critic.criticise(batch, valid), self._decay(), self.rng, figures)
        return self._read(figures)

    def _standardised(self, critiques: Sequence[Critique], alive: Sequence[Tensor]) -> list[Tensor]:
        """Each agent's Â (B,): the team's, with the mean and deviation of the decisions in which anybody took part.

        In IPPO its own critic's, with those of the decisions in which it took part itself.
        """

        def standardised(A: Tensor, acted: Tensor) -> Tensor:
            there = A[acted]
            return (A - there.mean()) / (there.std(correction=0) + 1e-5) if len(there) else A

        if self.config.method == "ippo":
            return [standardised(critique.advantages, a) for critique, a in zip(critiques, alive, strict=True)]
        return [standardised(critiques[0].advantages, torch.stack(list(alive)).any(0))] * len(alive)

    def _share(self, batch: Batch, valid: Tensor, i: int, MA: Tensor) -> Share:
        """The decisions that agent i took part in, and what they were good for."""
        own = batch.alive[i] & valid  # (T, N)
        return Share(batch.observations[i][own], batch.actions[i][own], batch.log_probs[i][own], MA)

    def _order(self) -> list[int]:
        n = len(self.actor_learners)
        return list(range(n)) if self.config.fixed_order else torch.randperm(n, generator=self.rng).tolist()

    def _decay(self) -> float:
        """What is left of the step sizes."""
        span = self.config.decay_steps
        return max(0.0, 1.0 - self.steps.item() / span) if span else 1.0

    def _pace(self, batch: Batch, decay: float, figures: Figures) -> None:
        """Count the steps where step sizes decay, and tell the step size where it changes."""
        c = self.config
        if c.decay_steps:
            self.steps += batch.rewards.numel()
        if c.decay_steps or c.kl_step is not None:
            for actor in (a for a in self.actor_learners if a.optimizer):
                note(figures, lr=(actor.lr * decay).float().to(self.device))

    @torch.no_grad()
    def _observe(self, batch: Batch, valid: Tensor, critiques: Sequence[Critique]) -> None:
        """Merge what actors saw, each (B_i, obs), and what critics saw into the running statistics (Chan et al., 1979),
        after they were learnt from.
        """
        rows = [[batch.observations[i][batch.alive[i] & valid] for i in a.agents] for a in self.actor_learners]
        seen = [*(torch.cat(r) for r in rows), *(critique.seen for critique in critiques)]
        trunks = [learner.network.trunk for learner in (*self.actor_learners, *self.critic_learners)]
        for k, (trunk, obs) in enumerate(zip(trunks, seen, strict=True)):
            if not (n := len(obs)):
                continue
            weight = n / (float(self.observation_counts[k]) + n)
            self.observation_counts[k] += n
            gap = obs.mean(0) - trunk.observation_mean
            var = trunk.observation_var
            var += weight * (obs.var(0, correction=0) - var) + weight * (1 - weight) * gap**2
            trunk.observation_mean += weight * gap
            trunk.observation_clip.fill_(OBSERVATION_CLIP)  # from now on there is something to normalise by

    # Whether all is finite -------------------------------------------------------------------------------------------

    def _check_batch(self, batch: Batch) -> None:
        """Raise Diverged where a valid decision holds what no update can learn from; nothing has changed by then."""
        held = {"rewards": batch.rewards}
        for i, alive in enumerate(batch.alive):
            held[f"agent {i}'s actions"] = batch.actions[i].sum(-1).where(alive, 0.0)  # finite where all of them are
            held[f"agent {i}'s log densities"] = batch.log_probs[i].where(alive, 0.0)
        sound = torch.stack([(x.isfinite() | batch.void).all() for x in held.values()])
        checkpoint.refuse([name for name, ok in zip(held, sound.tolist(), strict=True) if not ok])

    def _check_state(self) -> None:
        """Raise Diverged where weights, Adam's moments or normalisers are not finite."""
        checkpoint.check_finite(self._tensors(), self.device)

    def _read(self, figures: Figures) -> dict[str, float]:
        """The figures' means, fetched at once when all is done. Raises Diverged where they or the state are not finite.

        Reading them also keeps tensors that are views of JAX's buffers alive until torch has finished with them.
        """
        means = torch.stack([torch.stack(x).mean() for x in figures.values()]).tolist()
        found = dict(zip(figures, means, strict=True))
        checkpoint.refuse([name for name, value in found.items() if not math.isfinite(value)])
        self._check_state()
        return found

    # State -----------------------------------------------------------------------------------------------------------

    def policies(self) -> list[dict[str, Tensor]]:
        """Each agent's actor's state dict, which is its policy; the tensors are live."""
        return [{k: v.detach() for k, v in actor.state_dict().items()} for actor in self.actors]

    def state(self) -> dict[str, np.ndarray]:
        """Everything that going on needs: weights, optimisers, normalisers, random numbers."""
        return checkpoint.write(self._tensors(), self.rng)

    def load(self, state: State) -> None:
        """Go on from `state()`.

        Raises ValueError naming what is missing, of another shape, activation or kind of policy, or not finite; then
        nothing changed.
        """
        tensors = self._tensors()
        fixed = [k for k in tensors if k.endswith((".activation", ".squash")) or k == "sharing"]
        checkpoint.read(tensors, fixed, self.rng, state)

    def inherit(self, actors: Sequence[tuple[State, int] | None], critic: State | None) -> None:
        """Begin with weights of other learners: for each agent `state()` and the number of an agent there, or None.

        An actor brings its deviation and what it knows of observations, and so do critics, with their value
        normalisers. What is None stays as it is, and so do optimisers, step counts and random numbers. Agents that
        share an actor go on from what is given for the first of them. Raises ValueError as `load` does.
        """
        state = self.state()
        for i, source in enumerate(actors):
            if source is not None and self.leaders[i] == i:
                state = checkpoint.with_actor(state, i, *source)
        self.load(checkpoint.with_critics(state, critic) if critic is not None else state)

    def _tensors(self) -> dict[str, Tensor]:
        """Every tensor of the state by name. A setting that is off adds none."""
        alone = len(self.critic_learners) == 1
        named = {f"actor.{actor.agents[0]}": actor for actor in self.actor_learners}
        named |= {"critic" if alone else f"critic.{i}": critic for i, critic in enumerate(self.critic_learners)}
        tensors = {f"{m}.{k}": v for m, learner in named.items() for k, v in learner.network.state_dict().items()}
        for i, critic in enumerate(self.critic_learners):
            name = "value_norm" if alone else f"value_norm.{i}"
            tensors |= {f"{name}.{k}": v for k, v in critic.value_norm.state_dict().items()}
        tensors["observation_counts"] = self.observation_counts
        for name, learner in named.items():
            tensors |= moments(f"adam.{name}", learner.network, learner.optimizer)
            if isinstance(learner, ActorLearner) and self.config.kl_step is not None:
                tensors[f"adam.{name}.lr"] = learner.lr
        if self.config.decay_steps:
            tensors["steps"] = self.steps
        if self.config.share_actors:
            tensors["sharing"] = torch.tensor(self.leaders)
        return tensors
