"""The state of a team that learns: its networks, optimizers, normalisers and random numbers, and how these are kept."""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from agents.devices.cuda_graphs import GraphCache
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner import checkpoint
from agents.learner.actor_learner import ActorLearner
from agents.learner.checkpoint import State
from agents.learner.critic_learner import CriticLearner
from agents.learner.trust_region import TrustRegionLearner
from agents.policy.entity_places import Index
from agents.policy.networks import Actor, Critic
from agents.settings import HappoConfig


class LearnerSpec(NamedTuple):
    """Arguments of a learner in one process: `HappoLearner(*spec)` has its shape, and `load` gives it its state."""

    observation_sizes: tuple[int, ...]
    action_sizes: tuple[int, ...]
    config: HappoConfig
    seed: int
    device: str
    kinds: tuple[str, ...]
    others: tuple[int, ...]
    critic_size: int
    entities: tuple[tuple[Index, ...], ...] = ()


class LearnerState:
    """The state of a team that learns, on `device` auto, cpu or cuda. `save()` is all of it, which `load` restores.

    `kinds` are the agents' robots; agents of one kind and equal sizes are equal. Without `kinds` all are of one kind.
    `others` are the observation sizes of the other teams' agents, in the order of batches. `critic_size` is the size of
    the critic's input where that is not observations in this order (critic_input privileged, same). `entities` are the
    sets of entities of each agent's observation, which networks encode if the architecture says so. `comm` connects the
    ranks that hold this learner; each updates it from batches of its own, all of one shape.
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
        critic_size: int = 0,
        entities: Sequence[Sequence[Index]] = (),
        comm: Communicator = SINGLE_PROCESS,
    ):
        self.config = c = config
        self.comm = comm
        sizes = tuple(observation_sizes), tuple(action_sizes)
        sets = [tuple(each) for each in entities] or [()] * len(observation_sizes)
        self._spec = LearnerSpec(*sizes, config, seed, device, tuple(kinds), tuple(others), critic_size, tuple(sets))
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(device)
        self.rng = torch.Generator().manual_seed(seed)  # part of the state
        self.device_rng = torch.Generator(self.device)  # each update seeds it from `rng`
        self.graphs = GraphCache(self.device, c.cuda_graphs and comm.capturable)
        n, arch = len(observation_sizes), c.architecture
        equal = list(zip(kinds or [""] * n, observation_sizes, action_sizes, strict=True))
        self.actor_owners = [equal.index(e) if c.share_actors else i for i, e in enumerate(equal)]
        owners = sorted({*self.actor_owners})
        critic_agents = [[i] for i in range(n)] if c.method == "ippo" else [list(range(n))]
        own_sizes = [sum(observation_sizes[i] for i in agents) for agents in critic_agents]
        with torch.random.fork_rng(devices=[]):  # nn.init draws from the global generator, which must not change
            torch.manual_seed(seed)
            actors = [Actor(*equal[owner][1:], arch, c.initial_std, sets[owner]).to(self.device) for owner in owners]
            more = others if c.critic_input == "all" else ()
            of_observations = c.critic_input in ("own", "all")
            inputs = [[size, *more] if of_observations else [critic_size] for size in own_sizes]
            of_team = [_entities_of_team(observation_sizes, sets, agents) for agents in critic_agents]
            own_only = c.critic_input == "own"  # other inputs may hold an entity twice
            critics = [
                Critic(sizes, arch, found if own_only else ()).to(self.device)
                for sizes, found in zip(inputs, of_team, strict=True)
            ]
        kind = TrustRegionLearner if c.method == "hatrpo" else ActorLearner
        self.actor_learners = [
            kind(actor, [i for i in range(n) if self.actor_owners[i] == owner], c, comm)
            for actor, owner in zip(actors, owners, strict=True)
        ]
        self.critic_learners = [
            CriticLearner(critic, agents, c, k, comm.second_channel())
            for k, (critic, agents) in enumerate(zip(critics, critic_agents, strict=True))
        ]
        # For each actor, then for each critic: the number of decisions in the statistics of each of its inputs.
        trunks = [network.trunk for network in (*actors, *critics)]
        self.observed = [torch.zeros_like(trunk.observation_mean) for trunk in trunks]
        self.steps: Tensor = torch.zeros(
            (), dtype=torch.int64
        )  # decisions × worlds learnt from, if learning rates decay

    @property
    def spec(self) -> LearnerSpec:
        """Arguments for another learner of this shape, in this process or another."""
        return self._spec._replace(config=self.config)

    @property
    def actors(self) -> list[Actor]:
        """Actor of each agent; agents that share one have the same object."""
        by_owner = {learner.agents[0]: learner.network for learner in self.actor_learners}
        return [by_owner[owner] for owner in self.actor_owners]

    def export(self) -> list[dict[str, Tensor]]:
        """Return each agent's actor's state dict, which is its policy; the tensors are live."""
        return [{k: v.detach() for k, v in actor.state_dict().items()} for actor in self.actors]

    def act(self) -> list[dict[str, Tensor]]:
        """Return the policies by which its agents act in the next rollout: those that `export` gives."""
        return self.export()

    def save(self) -> dict[str, np.ndarray]:
        """Return everything that `load` needs to continue: weights, optimizers, normalisers, random numbers."""
        return checkpoint.write(self._tensors(), self.rng)

    def reseed(self, seed: int) -> None:
        """Give the learner other random numbers."""
        self.rng.manual_seed(seed)

    def load(self, state: State) -> None:
        """Restore a `save()`.

        Policies of a state without magnets become their own. Raises ValueError naming arrays that are missing, of
        another shape, activation or kind of policy, or not finite; then nothing has changed.
        """
        tensors, state = self._tensors(), checkpoint.with_magnets(checkpoint.upgrade_state(state))
        fixed = [k for k in tensors if k.endswith((".activation", ".squash", ".index", ".own")) or k == "sharing"]
        checkpoint.read(tensors, fixed, self.rng, state)

    def warm_start(
        self, actors: Sequence[tuple[State, int] | None], critic: State | None, from_other_arena: bool = False
    ) -> None:
        """Take over weights of other learners: for each agent a `save()` and the number of an agent in it, or None.

        An actor brings its standard deviation and observation statistics, and becomes its own magnet; critics bring
        theirs and their value normalisers. None leaves an actor or the critics unchanged, and optimizers, step counts
        and random numbers stay too. Agents that share an actor take over the one given for the first of them. If the
        states are `from_other_arena`, inputs that were constant there have no effect here at first. Raises ValueError
        as `load` does.
        """
        state = checkpoint.without_magnets(self.save())
        given = checkpoint.with_constant_inputs_silenced if from_other_arena else checkpoint.upgrade_state
        for i, source in enumerate(actors):
            if source is not None and self.actor_owners[i] == i:
                state = checkpoint.with_actor(state, i, given(source[0]), source[1])
        self.load(checkpoint.with_critics(state, given(critic)) if critic is not None else state)

    def _tensors(self) -> dict[str, Tensor]:
        """Return all tensors of the state by name. A setting that is off adds none."""
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
            if isinstance(learner, ActorLearner) and self.config.desired_kl is not None:
                tensors[f"adam.{name}.lr"] = learner.lr
            if isinstance(learner, ActorLearner) and learner.magnet is not None:
                tensors |= {f"magnet.{name}.{k}": v for k, v in learner.magnet.state_dict().items()}
                tensors[f"magnet.{name}.age"] = learner.magnet_age
        if self.config.lr_decay_steps:
            tensors["steps"] = self.steps
        if self.config.share_actors:
            tensors["sharing"] = torch.tensor(self.actor_owners)
        return tensors

    def _check_state(self) -> None:
        """Raise Diverged if weights, Adam's moments or normalisers are not finite."""
        checkpoint.check_finite(self._tensors())


def _entities_of_team(
    sizes: Sequence[int], sets: Sequence[Sequence[Index]], agents: Sequence[int]
) -> list[list[list[int]]]:
    """Return the sets of entities in the observations of these agents, one agent's after the other's."""
    found, first = [], 0
    for agent in agents:
        found += [[[first + place for place in entity] for entity in index] for index in sets[agent]]
        first += sizes[agent]
    return found


def check_ranks_agree(learners: Mapping[str, Any]) -> None:
    """Raise RuntimeError unless all ranks hold the same bytes of all learners; averages would be meaningless."""
    for player, learner in learners.items():
        if learner.comm.size > 1:
            state = learner.save()
            checksums = learner.comm.gather(zlib.crc32(b"".join(state[name].tobytes() for name in sorted(state))))
            if len(set(checksums)) > 1:
                raise RuntimeError(f"the ranks no longer hold the same {player}; nothing of this turn is written")
