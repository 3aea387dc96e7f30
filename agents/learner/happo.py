"""HAPPO (Kuba et al., 2022; Zhong et al., 2024) and its variants for one team: actors, critics, value normalisers.

The team's agents are updated one after the other. Each maximises the clipped surrogate of PPO on an advantage that is
multiplied by M, the product of the probability ratios of the agents before it, so that every step improves the joint
policy that those before it have already made. HATRPO does the same by trust region; MAPPO and IPPO leave M out, and in
IPPO each agent has a critic of its own. Equal robots may share an actor, which is then updated once, from the data of
all of them. `agents.learner` tells how an update runs.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, wraps

import torch
from torch import Tensor

from agents.batch import Batch, CriticBatch, clean, rows
from agents.devices.cuda_graphs import Runner
from agents.learner import checkpoint
from agents.learner.actor_learner import ActorLearner
from agents.learner.critic_learner import CriticLearner
from agents.learner.learner_state import LearnerState
from agents.learner.metric_means import MetricSums, read_means
from agents.learner.minibatches import mean_weights, minibatch_orders
from agents.learner.optimizer import matmul_precision, maybe_compiled
from agents.settings import OBSERVATION_CLIP

Update = Callable[["HappoLearner", Batch], dict[str, float]]


def _with_precision(update: Update) -> Update:
    """Run an update with the precision of matrix products that its learner's settings say."""

    @wraps(update)
    def with_precision(learner: "HappoLearner", batch: Batch) -> dict[str, float]:
        with matmul_precision(learner.config.precision):
            return update(learner, batch)

    return with_precision


class HappoLearner(LearnerState):
    """A team that learns; `LearnerState` has its arguments, networks and state."""

    final_memories: Sequence[Tensor] = ()  # of each critic (N, units), after the newest update

    @cached_property
    def standardised_advantages(self) -> Callable[[Sequence[CriticBatch], Sequence[Tensor]], list[Tensor]]:
        """`_standardise_advantages`, compiled if the settings want that."""
        return maybe_compiled(self._standardise_advantages, self.config.compiled and self.comm.size == 1)

    @_with_precision
    def learn(self, batch: Batch) -> dict[str, float]:
        """Update every actor and critic once; return losses and diagnostics, means over the update.

        The update does not depend on the contents of void decisions; if all are void there is no update and the result
        is empty. Nor does it depend on the numbers of an agent that was not alive: its rows have no weight for its
        actor and leave M unchanged, a decision without any living agent has no weight in the mean and deviation of Â,
        and the critic receives zeros for the agent. For recurrent networks `final_memories` then holds each critic's
        hidden state (N, units) after the last decision, for the batch that follows; after a batch in which all is void
        it is empty.

        Raises Diverged if rewards, actions, log densities, losses, gradients or the resulting state are not finite; the
        state is then useless, and `load` restores an earlier one.
        """
        run, steps = self.graphs.for_shape(batch.rewards.shape), self._environment_steps(batch)
        batch, any_valid = self._prepare(batch, run)
        if not any_valid:
            return {}
        critics, actors = self.critic_learners, self._draw_agent_order()
        with run.concurrently():  # a GPU sorts them while it evaluates the critics
            row_orders = self._draw_row_orders([*critics, *actors], batch)
        critic_orders, actor_orders = row_orders[: len(critics)], row_orders[len(critics) :]

        critic_batches = self._evaluate_critics(batch, run)
        A_hat = run(self.standardised_advantages, critic_batches, batch.alive)
        run.wait()
        lr_factor = self._lr_factor()
        with run.concurrently() as other:  # from here on critics and actors are independent of each other
            for critic, critic_batch, orders in zip(critics, critic_batches, critic_orders, strict=True):
                critic.update(critic_batch, lr_factor, orders, other)

        M = torch.ones_like(critic_batches[0].advantages)  # product of the ratios of all agents updated so far, as rows
        for actor, orders in zip(actors, actor_orders, strict=True):
            actor_batch = run(actor.actor_batch, batch, M, A_hat)
            if self.config.method in ("happo", "hatrpo") and actor is not actors[-1]:  # M is not used after the last
                before = run(actor.log_probs, actor_batch)
                actor.update(actor_batch, lr_factor, orders, run)
                M *= run(actor.ratios, actor_batch, before)
            else:
                actor.update(actor_batch, lr_factor, orders, run)
        run.wait()
        if self.config.normalise_observations:
            run(self._update_observation_statistics, batch)
        return self._read_metrics(self._count_steps(steps, lr_factor))

    @_with_precision
    def update_critic_only(self, batch: Batch) -> dict[str, float]:
        """Update the critics only, for a team that does not learn: its values follow the other teams' learning.

        Actors and observation statistics, which are part of the policy, stay unchanged. Returns and raises as `learn`
        does.
        """
        run = self.graphs.for_shape(batch.rewards.shape)
        batch, any_valid = self._prepare(batch, run)
        if not any_valid:
            return {}
        critics = self.critic_learners
        critic_batches, row_orders = self._evaluate_critics(batch, run), self._draw_row_orders(critics, batch)
        for critic, critic_batch, orders in zip(critics, critic_batches, row_orders, strict=True):
            critic.update(critic_batch, self._lr_factor(), orders, run)
        return self._read_metrics({})

    def values(self, batch: Batch) -> list[Tensor]:
        """Return each critic's values (T, N) of the states of a batch, in units of reward.

        Nothing is learnt, and no random number is drawn.
        """
        with matmul_precision(self.config.precision):
            batch = clean(self._with_memories(batch))
            return [critic.values(batch) for critic in self.critic_learners]

    def _with_memories(self, batch: Batch) -> Batch:
        """Return the batch with zeros as critics' hidden states if they are recurrent and the batch has none."""
        if self.config.sequence is None or batch.critic_memories:
            return batch
        fresh = batch.rewards.new_zeros(batch.rewards.shape[1], self.config.architecture.recurrent)
        return batch._replace(critic_memories=[fresh] * len(self.critic_learners))

    def _prepare(self, batch: Batch, run: Runner) -> tuple[Batch, bool]:
        """Return the clean batch, and True if any decision is valid; seed this update's random numbers.

        Raises Diverged if the batch holds numbers that no update can learn from; nothing has changed by then.
        """
        self.final_memories, agents = (), range(len(batch.actions))
        batch = self._with_memories(batch)._replace(steps=())  # on the host: it is none of a CUDA graph's inputs
        names = ["rewards", *(f"agent {i}'s {what}" for i in agents for what in ("actions", "log densities"))]
        batch, found = run(_cleaned, batch)
        any_valid, *bad = self.comm.any(found).tolist()
        checkpoint.raise_diverged([name for name, here in zip(names, bad, strict=True) if here])
        if not any_valid:
            self._check_state()  # a policy that is not finite makes every world void
            return batch, False
        self.device_rng.manual_seed((draw_seed(self.rng) + self.comm.rank) % 2**63)  # each rank permutes its own rows
        for metric_sums in self._metric_sums():
            metric_sums.sums.zero_()
        return batch, True

    def _evaluate_critics(self, batch: Batch, run: Runner) -> list[CriticBatch]:
        """Return each critic's batch, and note its last hidden state."""
        critic_batches = [run(critic.evaluate, batch) for critic in self.critic_learners]
        self.final_memories = [last for critic_batch in critic_batches for last in critic_batch.last]
        return critic_batches

    @torch.no_grad()
    def _standardise_advantages(self, critic_batches: Sequence[CriticBatch], alive: Sequence[Tensor]) -> list[Tensor]:
        """Return each agent's Â as rows: (A − mean A) / (std A + 1e-5), over decisions in which an agent took part.

        A is the team's advantage; in IPPO it is that of the agent's own critic, over decisions in which the agent took
        part.
        """

        def standardise(A: Tensor, acted: Tensor) -> Tensor:
            weights, _ = mean_weights(rows(acted, self.config.sequence), self.comm)
            (mean,) = self.comm.sum((A * weights).sum())
            gap = A - mean
            (variance,) = self.comm.sum((gap**2 * weights).sum())
            return gap / (torch.sqrt(variance) + 1e-5)

        if self.config.method == "ippo":
            return [standardise(own.advantages, acted) for own, acted in zip(critic_batches, alive, strict=True)]
        return [standardise(critic_batches[0].advantages, torch.stack(list(alive)).any(0))] * len(alive)

    def _draw_agent_order(self) -> list[ActorLearner]:
        """Return the actor learners in the order in which they are updated."""
        if self.config.fixed_order:
            return list(self.actor_learners)
        order = torch.randperm(len(self.actor_learners), generator=self.rng)
        return [self.actor_learners[k] for k in order.tolist()]

    def _draw_row_orders(
        self, learners: Sequence[ActorLearner | CriticLearner], batch: Batch
    ) -> list[Sequence[Tensor]]:
        """Return for each learner the orders in which it goes through its rows of the batch, one per pass."""
        return minibatch_orders([learner.num_rows(batch) for learner in learners], self.config.epochs, self.device_rng)

    def _lr_factor(self) -> float:
        """Return the remaining share of the learning rates."""
        span = self.config.lr_decay_steps
        return max(0.0, 1.0 - self.steps.item() / span) if span else 1.0

    def _environment_steps(self, batch: Batch) -> int:
        """Return the environment steps of the iteration from which a batch is."""
        return int(batch.steps[0].item()) if batch.steps else batch.rewards.numel() * self.comm.size

    def _count_steps(self, steps: int, lr_factor: float) -> dict[str, float]:
        """Count environment steps if learning rates decay; return the learning rate if it varies."""
        c = self.config
        if c.lr_decay_steps:
            self.steps += steps
        rates = [actor.lr for actor in self.actor_learners if actor.optimizer and (c.lr_decay_steps or c.desired_kl)]
        return {"lr": torch.stack(rates).mean().item() * lr_factor} if rates else {}

    @torch.no_grad()
    def _update_observation_statistics(self, batch: Batch) -> None:
        """Merge the inputs of actors and critics into their running statistics (Chan et al., 1979).

        The networks' outputs stay the same, except for inputs of which nothing was known before (`Trunk.renormalise`).
        """
        for learner, count in zip((*self.actor_learners, *self.critic_learners), self.observed, strict=True):
            trunk, (obs, valid) = learner.network.trunk, learner.seen(batch)
            weights, _ = mean_weights(valid, self.comm)
            (n,), weights = self.comm.sum(valid.sum()), weights[:, None]
            weight = n / (count + n).clamp(min=1)
            (mean,) = self.comm.sum((obs * weights).sum(0))
            gap, var = mean - trunk.observation_mean, trunk.observation_var
            (batch_var,) = self.comm.sum(((obs - mean) ** 2 * weights).sum(0))
            var = var + weight * (batch_var - var) + weight * (1 - weight) * gap**2
            trunk.renormalise(trunk.observation_mean + weight * gap, var, count > 0)
            trunk.observation_clip.masked_fill_(n > 0, OBSERVATION_CLIP)  # from the first statistics on
            count += n

    # Metrics ---------------------------------------------------------------------------------------------------------

    def _read_metrics(self, more: Mapping[str, float]) -> dict[str, float]:
        """Return the metrics' means, read at once at the end. Raises Diverged if they or the state are not finite.

        Reading them also keeps tensors that are views of JAX's buffers alive until torch has finished with them.
        """
        found = {**read_means(self._metric_sums()), **more}
        checkpoint.raise_diverged([name for name, value in found.items() if not math.isfinite(value)])
        self._check_state()
        return found

    def _metric_sums(self) -> list[MetricSums]:
        """Return the sums of all actors and critics."""
        learners = (*self.actor_learners, *self.critic_learners)
        return [*(each.metric_sums for each in learners), *(each.fit_sums for each in self.critic_learners)]


@torch.no_grad()
def _cleaned(batch: Batch) -> tuple[Batch, Tensor]:
    """Return the clean batch, and flags (2 + 2·agents,) bool.

    The first flag: any decision is valid. The others: rewards, and each agent's actions and log densities, are not
    finite.
    """
    batch = clean(batch)
    arrays = [batch.rewards, *(x for each in zip(batch.actions, batch.log_probs, strict=True) for x in each)]
    return batch, torch.stack([~batch.void.all(), *(~x.isfinite().all() for x in arrays)])


def draw_seed(rng: torch.Generator) -> int:
    """Return a random seed of 63 bits for an update."""
    return int(torch.randint(2**63 - 1, (), generator=rng))
