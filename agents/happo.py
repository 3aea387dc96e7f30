"""HAPPO (Kuba et al., 2022; Zhong et al., 2024) and its variants for one team: actors, critics, value normalisers.

The team's agents are updated one after the other. Each maximises the clipped surrogate of PPO on an advantage that is
multiplied by M, the product of the probability ratios of the agents before it, so that every step improves the joint
policy that those before it have already made. HATRPO does the same by trust region; MAPPO and IPPO leave M out, and in
IPPO each agent has a critic of its own. Equal robots may share an actor, which then is updated once, from all they did.
"""

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from agents import checkpoint
from agents.actors import ActorLearner
from agents.batch import Batch, Critique, clean, rows
from agents.checkpoint import State
from agents.critics import CriticLearner
from agents.graphs import Graphs, Run
from agents.networks import Actor, Critic
from agents.optimise import Tally, fused, means, orders, parts, products
from agents.parallel import ALONE, Together
from agents.settings import OBSERVATION_CLIP, HappoConfig
from agents.trust_region import TrustRegionLearner

Update = Callable[["Learner", Batch], dict[str, float]]


class Made(NamedTuple):
    """What a learner that is alone in learning is made of: `Learner(*made)` has its shape, and `load` does the rest."""

    observation_sizes: tuple[int, ...]
    action_sizes: tuple[int, ...]
    config: HappoConfig
    seed: int
    device: str
    kinds: tuple[str, ...]
    others: tuple[int, ...]
    sight: int


def _precisely(update: Update) -> Update:
    """An update with matrix products as its learner's settings have them."""

    @wraps(update)
    def with_products(learner: "Learner", batch: Batch) -> dict[str, float]:
        with products(learner.config.precision):
            return update(learner, batch)

    return with_products


class Learner:
    """A team that learns, on `device` auto, cpu or cuda. Its whole state is `state()`, from which `load` goes on.

    `kinds` are the agents' robots; agents of one kind and equal sizes are equal. Without them all are of one kind.
    `others` are the observation sizes of the other teams' agents, in the order in which batches hold them; `sight` is
    how many numbers the critic sees where these are no observations in their order (critic_input privileged, same).
    `together` are the ranks that hold this learner; each updates it from batches of its own, all of one shape.
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
        sight: int = 0,
        together: Together = ALONE,
    ):
        self.config = c = config
        self.together = together
        sizes = tuple(observation_sizes), tuple(action_sizes)
        self._made = Made(*sizes, config, seed, device, tuple(kinds), tuple(others), sight)
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(device)
        self.rng = torch.Generator().manual_seed(seed)  # part of the state; `dice` have a fresh seed of it each update
        self.dice = torch.Generator(self.device)
        self.graphs = Graphs(self.device, c.graphs and together.recordable)
        n, arch = len(observation_sizes), c.architecture
        equal = list(zip(kinds or [""] * n, observation_sizes, action_sizes, strict=True))
        self.leaders = [equal.index(e) if c.share_actors else i for i, e in enumerate(equal)]
        led = {leader: [i for i in range(n) if self.leaders[i] == leader] for leader in sorted({*self.leaders})}
        circles = [[i] for i in range(n)] if c.method == "ippo" else [list(range(n))]
        sizes = [sum(observation_sizes[i] for i in circle) for circle in circles]
        with torch.random.fork_rng(devices=[]):  # nn.init draws from the global generator; leave that as it was
            torch.manual_seed(seed)
            actors = [Actor(*equal[leader][1:], arch, c.initial_std).to(self.device) for leader in led]
            extra = others if c.critic_input == "all" else ()
            sights = [[size, *extra] if c.critic_input in ("own", "all") else [sight] for size in sizes]
            critics = [Critic(seen, arch).to(self.device) for seen in sights]
        kind = TrustRegionLearner if c.method == "hatrpo" else ActorLearner
        self.actor_learners = [kind(a, agents, c, together) for a, agents in zip(actors, led.values(), strict=True)]
        of_critics = enumerate(zip(critics, circles, strict=True))
        self.critic_learners = [
            CriticLearner(critic, circle, c, k, together.lane()) for k, (critic, circle) in of_critics
        ]
        self.standardised = fused(self._standardised, c.compiled and together.size == 1)
        self.remembered: Sequence[Tensor] = ()
        # Of each actor, then of each critic: of how many decisions it knows each number that it sees.
        trunks = [network.trunk for network in (*actors, *critics)]
        self.observed = [torch.zeros_like(trunk.observation_mean) for trunk in trunks]
        self.steps = torch.zeros((), dtype=torch.int64)  # decisions × worlds learnt from, where step sizes decay

    @property
    def made(self) -> Made:
        """What another one of this shape is made of, in this process or another."""
        return self._made._replace(config=self.config)

    @property
    def actors(self) -> list[Actor]:
        """Each agent's actor; those that share one have the same."""
        by_leader = {learner.agents[0]: learner.network for learner in self.actor_learners}
        return [by_leader[leader] for leader in self.leaders]

    @_precisely
    def update(self, batch: Batch) -> dict[str, float]:
        """One update of every actor and critic; returns losses and diagnostics, means over the update.

        Void decisions count for nothing: whatever they hold, the update is the same. Where all are void there is none.
        So are the numbers of an agent that was not alive: its rows teach its actor nothing and leave M as it is, a
        decision without any living agent is no part of Â's mean and deviation, and the critic sees zeros for it.
        Where networks are recurrent, `remembered` then tells what each critic remembers (N, units) after the last
        decision, for the batch that goes on from there; after a batch in which all is void it is empty.
        Raises Diverged where rewards, actions, log densities, losses, gradients or the state that results are not
        finite; the state is then worthless, and `load` brings back one that is not.
        """
        run = self.graphs.of(batch.rewards.shape)
        batch, known = self._begin(batch, run)
        if not known:
            return {}
        order, critics = self._order(), self.critic_learners
        with run.beside():  # a GPU sorts them while it sees what the critics make of the batch
            drawn = self._orders([*critics, *(self.actor_learners[k] for k in order)], batch)
        critiques = self._criticised(batch, run)
        A_hat = run(self.standardised, critiques, batch.alive)
        run.meet()
        decay = self._decay()
        with run.beside() as beside:  # critics and actors do not know of each other from here on
            for critic, critique, mine in zip(critics, critiques, drawn[: len(critics)], strict=True):
                critic.update(critique, decay, mine, beside)

        M = torch.ones_like(critiques[0].advantages)  # the ratios of the agents that have already moved, as rows
        for k, mine in zip(order, drawn[len(critics) :], strict=True):
            actor = self.actor_learners[k]
            share = run(actor.share, batch, M, A_hat)
            if self.config.method in ("happo", "hatrpo") and k != order[-1]:  # after the last one nobody asks for M
                before = run(actor.log_probs, share)
                actor.update(share, decay, mine, run)
                M *= run(actor.ratios, share, before)
            else:
                actor.update(share, decay, mine, run)
        run.meet()
        if self.config.normalise_observations:
            run(self._observe, batch)
        return self._read(self._pace(batch, decay))

    @_precisely
    def update_critic_only(self, batch: Batch) -> dict[str, float]:
        """The critics' share of `update`, for a team whose policy rests: its values follow what others learn meanwhile.

        Actors and observation statistics, which are part of the policy, stay as they are. Raises Diverged as `update`.
        """
        run = self.graphs.of(batch.rewards.shape)
        batch, known = self._begin(batch, run)
        if not known:
            return {}
        critics = self.critic_learners
        for critic, critique, mine in zip(
            critics, self._criticised(batch, run), self._orders(critics, batch), strict=True
        ):
            critic.update(critique, self._decay(), mine, run)
        return self._read({})

    def values(self, batch: Batch) -> list[Tensor]:
        """What each critic holds the states to be worth in which the decisions were made, (T, N) in units of reward.

        Nothing is learnt, and no dice are thrown.
        """
        with products(self.config.precision):
            batch = clean(self._recalling(batch))
            return [critic.values(batch) for critic in self.critic_learners]

    def _recalling(self, batch: Batch) -> Batch:
        """The batch with critics that remember nothing, where they could and it does not say what."""
        if self.config.sequence is None or batch.recalled:
            return batch
        fresh = batch.rewards.new_zeros(batch.rewards.shape[1], self.config.architecture.recurrent)
        return batch._replace(recalled=[fresh] * len(self.critic_learners))

    def _begin(self, batch: Batch, run: Run) -> tuple[Batch, bool]:
        """The batch with zeros where it means nothing, and whether any decision is known; throws the dice anew.

        Raises Diverged where it holds what no update can learn from; nothing has changed by then.
        """
        self.remembered, agents = (), range(len(batch.actions))
        batch = self._recalling(batch)
        held = ["rewards", *(f"agent {i}'s {what}" for i in agents for what in ("actions", "log densities"))]
        batch, found = run(_cleaned, batch)
        known, *bad = self.together.any(found).tolist()
        checkpoint.refuse([name for name, here in zip(held, bad, strict=True) if here])
        if not known:
            self._check_state()  # a policy that is not finite makes every world void
            return batch, False
        self.dice.manual_seed((draw_seed(self.rng) + self.together.rank) % 2**63)  # each permutes its own rows
        for tally in self._tallies():
            tally.sums.zero_()
        return batch, True

    def _criticised(self, batch: Batch, run: Run) -> list[Critique]:
        critiques = [run(critic.criticise, batch) for critic in self.critic_learners]
        self.remembered = [last for critique in critiques for last in critique.last]
        return critiques

    @torch.no_grad()
    def _standardised(self, critiques: Sequence[Critique], alive: Sequence[Tensor]) -> list[Tensor]:
        """Each agent's Â as rows: the team's, with the mean and deviation of the decisions in which anybody took part.

        In IPPO its own critic's, with those of the decisions in which it took part itself.
        """

        def standardised(A: Tensor, acted: Tensor) -> Tensor:
            part, _ = parts(rows(acted, self.config.sequence), self.together)
            (mean,) = self.together.sum((A * part).sum())
            gap = A - mean
            (variance,) = self.together.sum((gap**2 * part).sum())
            return gap / (torch.sqrt(variance) + 1e-5)

        if self.config.method == "ippo":
            return [standardised(critique.advantages, a) for critique, a in zip(critiques, alive, strict=True)]
        return [standardised(critiques[0].advantages, torch.stack(list(alive)).any(0))] * len(alive)

    def _order(self) -> list[int]:
        n = len(self.actor_learners)
        return list(range(n)) if self.config.fixed_order else torch.randperm(n, generator=self.rng).tolist()

    def _orders(self, learners: Sequence[ActorLearner | CriticLearner], batch: Batch) -> list[Sequence[Tensor]]:
        """For each learner the orders in which it will go through its rows of the batch."""
        return orders([learner.rows_of(batch) for learner in learners], self.config.epochs, self.dice)

    def _decay(self) -> float:
        """What is left of the step sizes."""
        span = self.config.decay_steps
        return max(0.0, 1.0 - self.steps.item() / span) if span else 1.0

    def _pace(self, batch: Batch, decay: float) -> dict[str, float]:
        """Count the steps where step sizes decay, and tell the step size where it changes."""
        c = self.config
        if c.decay_steps:
            self.steps += batch.rewards.numel() * self.together.size
        told = [actor.lr for actor in self.actor_learners if actor.optimizer and (c.decay_steps or c.kl_step)]
        return {"lr": torch.stack(told).mean().item() * decay} if told else {}

    @torch.no_grad()
    def _observe(self, batch: Batch) -> None:
        """Merge what actors and critics saw into the running statistics (Chan et al., 1979).

        What they make of it stays the same, but of numbers that nothing was known of before (`Trunk.renormalise`).
        """
        for learner, count in zip((*self.actor_learners, *self.critic_learners), self.observed, strict=True):
            trunk, (obs, valid) = learner.network.trunk, learner.seen(batch)
            part, _ = parts(valid, self.together)
            (n,), part = self.together.sum(valid.sum()), part[:, None]
            weight = n / (count + n).clamp(min=1)
            (mean,) = self.together.sum((obs * part).sum(0))
            gap, var = mean - trunk.observation_mean, trunk.observation_var
            (spread,) = self.together.sum(((obs - mean) ** 2 * part).sum(0))
            var = var + weight * (spread - var) + weight * (1 - weight) * gap**2
            trunk.renormalise(trunk.observation_mean + weight * gap, var, count > 0)
            trunk.observation_clip.masked_fill_(n > 0, OBSERVATION_CLIP)  # now there is something to normalise by
            count += n

    # Whether all is finite -------------------------------------------------------------------------------------------

    def _check_state(self) -> None:
        """Raise Diverged where weights, Adam's moments or normalisers are not finite."""
        checkpoint.check_finite(self._tensors())

    def _read(self, more: Mapping[str, float]) -> dict[str, float]:
        """The figures' means, fetched at once when all is done. Raises Diverged where they or the state are not finite.

        Reading them also keeps tensors that are views of JAX's buffers alive until torch has finished with them.
        """
        found = {**means(self._tallies()), **more}
        checkpoint.refuse([name for name, value in found.items() if not math.isfinite(value)])
        self._check_state()
        return found

    def _tallies(self) -> list[Tally]:
        critics = self.critic_learners
        return [*(a.tally for a in self.actor_learners), *(c.tally for c in critics), *(c.fit for c in critics)]

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
        tensors, state = self._tensors(), checkpoint.upgraded(state)
        fixed = [k for k in tensors if k.endswith((".activation", ".squash")) or k == "sharing"]
        checkpoint.read(tensors, fixed, self.rng, state)

    def inherit(
        self, actors: Sequence[tuple[State, int] | None], critic: State | None, elsewhere: bool = False
    ) -> None:
        """Begin with weights of other learners: for each agent `state()` and the number of an agent there, or None.

        An actor brings its deviation and what it knows of observations, and so do critics, with their value
        normalisers. What is None stays as it is, and so do optimisers, step counts and random numbers. Agents that
        share an actor go on from what is given for the first of them. Where they learnt `elsewhere`, inputs that never
        moved there say nothing here at first. Raises ValueError as `load` does.
        """
        state, given = self.state(), checkpoint.unmoved if elsewhere else checkpoint.upgraded
        for i, source in enumerate(actors):
            if source is not None and self.leaders[i] == i:
                state = checkpoint.with_actor(state, i, given(source[0]), source[1])
        self.load(checkpoint.with_critics(state, given(critic)) if critic is not None else state)

    def _tensors(self) -> dict[str, Tensor]:
        """Every tensor of the state by name. A setting that is off adds none."""
        alone = len(self.critic_learners) == 1
        named = {f"actor.{actor.agents[0]}": actor for actor in self.actor_learners}
        named |= {"critic" if alone else f"critic.{i}": critic for i, critic in enumerate(self.critic_learners)}
        tensors = {f"{m}.{k}": v for m, learner in named.items() for k, v in learner.network.state_dict().items()}
        for i, critic in enumerate(self.critic_learners):
            name = "value_norm" if alone else f"value_norm.{i}"
            tensors |= {f"{name}.{k}": v for k, v in critic.value_norm.state_dict().items()}
        for (name, learner), count in zip(named.items(), self.observed, strict=True):
            tensors[f"{name}.observed"] = count
            if learner.optimizer:
                tensors |= {f"adam.{name}.{k}": v for k, v in learner.optimizer.tensors().items()}
            if isinstance(learner, ActorLearner) and self.config.kl_step is not None:
                tensors[f"adam.{name}.lr"] = learner.lr
        if self.config.decay_steps:
            tensors["steps"] = self.steps
        if self.config.share_actors:
            tensors["sharing"] = torch.tensor(self.leaders)
        return tensors


@torch.no_grad()
def _cleaned(batch: Batch) -> tuple[Batch, Tensor]:
    """The clean batch, and (2 + 2·agents,) bool: whether anything is known, and what it holds that is not finite.

    That is rewards, and each agent's actions and log densities.
    """
    batch = clean(batch)
    held = [batch.rewards, *(x for each in zip(batch.actions, batch.log_probs, strict=True) for x in each)]
    return batch, torch.stack([~batch.void.all(), *(~x.isfinite().all() for x in held)])


def compare(learners: Mapping[str, Learner]) -> None:
    """Raise RuntimeError unless all ranks hold the same learners to the last byte; else they would average nonsense."""
    for name, learner in learners.items():
        if learner.together.size > 1:
            state = learner.state()
            marks = learner.together.gather(zlib.crc32(b"".join(state[part].tobytes() for part in sorted(state))))
            if len(set(marks)) > 1:
                raise RuntimeError(f"the ranks no longer hold the same {name}; nothing of this turn is written")


def draw_seed(rng: torch.Generator) -> int:
    """What an update's dice are seeded with: 63 bits."""
    return int(torch.randint(2**63 - 1, (), generator=rng))
