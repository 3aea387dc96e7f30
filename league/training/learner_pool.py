"""Learner pool: the learners of a league's players in one process, their counters, checkpoints and restoration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from agents.bridge import to_jax
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner.happo import HappoLearner
from agents.policy.host_policy import HostPolicy
from agents.policy.jax_policy import Params, policy_params
from arenas.arena import Arena
from league.config.experiment import Config
from league.config.sections import Training
from league.scheduling import player_resets, population
from league.snapshots.codec import Policy, freeze
from league.state.jobs import TrainingTurn
from league.state.league_state import AT_ONCE
from league.training import reward_shaping
from league.training.learner_factory import new_learner, reset_learner, settings_of, skills_of
from league.training.own_learner import OwnLearner
from league.training.setback import PlayerDiverged
from league.training.update_pool import UpdatePool
from matchmaking.pbt import explore
from matchmaking.roles import Role
from storage.blobs import arrays
from storage.records import ArenaKey, Checkpoint, Meeting, Player, Snapshot
from storage.store import Store

ITERATION = "iteration"  # in the checkpoint of a learner of another class


@dataclass(frozen=True)
class Counters:
    """Progress of a player, as in the row of its newest checkpoint."""

    iteration: int = 0
    steps: int = 0  # decisions × worlds from which it learnt
    seconds: float = 0.0  # of training


class LearnerPool:
    """Learners of all players of a league. The store's checkpoints are authoritative for their state."""

    def __init__(self, config: Config, arena: Arena, players: Sequence[Player], comm: Communicator = SINGLE_PROCESS):
        self.config, self.arena, self.comm = config, arena, comm
        self.league = players[0].league
        self.players = {player.name: player for player in players}
        self.learners = {player.name: new_learner(config, arena, player, comm) for player in players}
        self.skills = {player.name: skills_of(config, arena, player) for player in players}
        self._skill_params = {name: self._params_of_skills(name) for name in self.skills}
        self.counters = {player.name: Counters() for player in players}
        self.histories: Mapping[str, list[Snapshot]] = {}  # of the players of the turn, oldest first
        self.updates = UpdatePool(list(self.learners.values()), one_here=config.deterministic)
        self._annealing = {name: self._new_annealing(name) for name in self.players}
        self._at = dict.fromkeys(self.players, "")  # digests of the checkpoints that the learners' states equal
        self._games: list[Meeting] = []  # training games of the present generations
        self._games_read = 0  # the last training game of the store that was read

    def role(self, name: str) -> Role:
        """Return a player's role, with all fields set."""
        return self.config.role(self.players[name].role)

    def resting(self, turn: TrainingTurn) -> list[str]:
        """Return the players of the turn that play without learning and whose critics may learn.

        Paused players, and players whose role never learns, are left out: their critics do not change.
        """
        rest = [name for name in turn.present if name and name not in turn.learners and self.role(name).learns]
        return [name for name in rest if self.players[name].paused is None]

    def judges(self, name: str) -> bool:
        """Return whether a player has a critic of our own, which can learn apart from its policy and judge episodes."""
        return isinstance(self.learners[name], HappoLearner)

    def gamma(self, name: str) -> float:
        """Return a player's discount factor per decision of the arena."""
        learner = self.learners[name]
        return learner.config.gamma if isinstance(learner, HappoLearner) else self.config.learner.gamma

    def trained(self, turn: TrainingTurn) -> tuple[float, int]:
        """Return the group's seconds and environment steps of training, as `LeagueState.spent` does for the store."""
        total = sum if self.config.training.schedule.sums_counts else max
        at = [self.counters[name] for name in turn.present if name]
        return total([c.seconds for c in at]), total([c.steps for c in at])

    def spent(self, turn: TrainingTurn) -> bool:
        """Return whether the group has used up its budget."""
        seconds, steps = self.trained(turn)
        return self.config.budget.spent(0.0 if self.config.deterministic else seconds, steps)

    def meetings(self, store: Store, begun: Mapping[str, int]) -> list[Meeting]:
        """Return the results of the games in the store that players have learnt from in their generation.

        `begun` has the iteration at which each player's generation began. Games of earlier ones are not kept, since no
        later generation begins before.
        """
        while True:
            new = store.meetings(self.league, self._games_read, limit=AT_ONCE)
            self._games_read = new[-1].id if new else self._games_read
            self._games = [m for m in (*self._games, *new) if m.iteration > begun.get(m.player, m.iteration)]
            if len(new) < AT_ONCE:
                return self._games

    # The weight of the dense reward ----------------------------------------------------------------------------------

    def shaping(self, name: str) -> float:
        """Return the present weight of a player's reward shaping."""
        if annealing := self._annealing[name]:
            return annealing.weight
        start = player_resets.initial_policy_since(self.role(name), self.config.seed, name, self.histories[name])
        return reward_shaping.by_steps(self._shaping_settings(name), self.counters[name].steps - start)

    def note(self, name: str, figures: Mapping[str, float]) -> None:
        """Update the shaping weight with the metrics of an iteration, if it follows success."""
        if annealing := self._annealing[name]:
            annealing.note(figures)

    def _shaping_settings(self, name: str) -> Training:
        """Return the settings of training with the player's fading: that of its role, if the role has one."""
        training, steps = self.config.training, self.role(name).shaping_steps
        return training if steps is None else replace(training, shaping_steps=steps, shaping_until=None)

    def _new_annealing(self, name: str) -> reward_shaping.SuccessAnnealing | None:
        return reward_shaping.make_annealing(self._shaping_settings(name), len(self.arena.teams))

    # Saved and brought back ------------------------------------------------------------------------------------------

    def restore(self, store: Store, turn: TrainingTurn) -> bool:
        """Load the checkpoints from which the turn starts; return whether the state of any player has changed."""
        self._at = self.comm.broadcast(self._at)
        self.players = {player.name: player for player in store.players(self.league)}  # one may have been paused
        self.histories = {name: store.snapshots(self.league, name) for name in turn.present if name}
        moved = False
        for name, digest in turn.bases.items():
            if digest and (digest != self._at[name] or turn.retry):
                self._load(store, name, digest, turn.retry)
                moved = True
            self._at[name] = digest
            kept = store.checkpoint(self.league, name)
            self.counters[name] = Counters(kept.iteration, kept.step, kept.seconds) if kept else Counters()
        return moved

    def _load(self, store: Store, name: str, digest: str, retry: int) -> None:
        state = arrays.from_bytes(store.blobs.get(digest))
        self._move(name, self._initial_values(name) | population.read(state, self._movable))
        self.learners[name].load(state)
        if (skills := self.skills[name]) is not None:
            skills.load(state)
            self._skill_params[name] = self._params_of_skills(name)
        if annealing := self._annealing[name]:
            annealing.load(state)
        if retry:
            self.learners[name].reseed(crc32(f"{self.config.seed}/{name}/{retry}".encode()))

    def checkpoint(self, store: Store, name: str, key: ArenaKey) -> Checkpoint:
        """Return the row of a player's present checkpoint; its bytes are stored, and the row is still to be written."""
        at, annealing = self.counters[name], self._annealing[name]
        moved = population.written(self.moved(name))
        state = self.learners[name].save() | moved | (annealing.state() if annealing else {})
        if (skills := self.skills[name]) is not None:
            state |= skills.state()
        if isinstance(self.learners[name], OwnLearner):  # it may have learnt nothing, and each checkpoint has a digest
            state |= {ITERATION: np.array(at.iteration)}
        digest = store.blobs.put(arrays.to_bytes(state))
        return Checkpoint(self.league, name, digest, at.steps, at.iteration, at.seconds, key)

    def written(self, checkpoints: Sequence[Checkpoint]) -> None:
        """Note that these checkpoints are in the store now, and equal the learners' states."""
        self._at |= {checkpoint.player: checkpoint.digest for checkpoint in checkpoints}

    def freeze(self, name: str) -> bytes:
        """Encode a player's present policies as bytes, which later updates cannot change."""
        learner, skills = self.learners[name], self.skills[name]
        found = learner.export()
        if isinstance(found, bytes):
            if skills is not None:
                raise self._no_strategy(name)
            return found
        policies = [{k: v if isinstance(v, np.ndarray) else v.cpu().numpy() for k, v in each.items()} for each in found]
        return freeze(policies if skills is None else skills.joined(policies))

    def ways(self, name: str) -> list[list[Policy]]:
        """Return all forms of policies by which a player's agents may act, now or as a snapshot."""
        own = isinstance(self.learners[name], OwnLearner)
        return [self.acting(name, learns) for learns in ((True, False) if own else (True,))]

    def acting(self, name: str, learns: bool = True) -> list[Policy]:
        """Return the policies by which a player's agents act in the next rollout, in which it learns or only plays."""
        learner = self.learners[name]
        if isinstance(learner, HappoLearner):
            found: list[Policy] = [*to_jax(learner.act())]
        else:
            given = learner.act() if learns else learner.play()
            found = [each if isinstance(each, HostPolicy) else policy_params(each) for each in given]
        if (own := self._skill_params[name]) is None:
            return found
        return [self._joined(name, policy, params) for policy, params in zip(found, own, strict=True)]

    def _joined(self, name: str, strategy: Policy, skills: Params) -> Params:
        if not isinstance(strategy, dict) or "gru.weight_hh" in strategy:
            raise self._no_strategy(name)
        return strategy | skills

    def _no_strategy(self, name: str) -> PlayerDiverged:
        what = "commands skills (learner.skill), which state dicts of an Actor without memory can alone"
        return PlayerDiverged(name, f"its learner {what}", "failed")

    def _params_of_skills(self, name: str) -> list[Params] | None:
        """Return the arrays of a player's skills on the device, by agent."""
        skills = self.skills[name]
        return None if skills is None else [policy_params(own) for own in skills.arrays]

    # Going on from others --------------------------------------------------------------------------------------------

    def take_over(self, name: str, source: str) -> None:
        """Copy another player's actors to a player, and its shaping weight if it follows success and is lower.

        The player keeps its critic, optimisers and random numbers. A learner of another class, which must be that of
        both, takes over the whole state.
        """
        learner, state = self.learners[name], self.learners[source].save()
        if isinstance(learner, OwnLearner):
            learner.load(state)
        else:
            learner.warm_start([(state, i) for i in range(len(learner.actors))], None)
        mine, other = self._annealing[name], self._annealing[source]
        if mine and other:
            mine.follow(other)

    def copy(self, store: Store, turn: TrainingTurn) -> bool:
        """Make the turn's copies of population based training; return whether there are any.

        A player that copies continues from the whole state of the other one, with hyperparameters and random numbers of
        its own, which follow from the seed, its name and its iteration.
        """
        for name, (source, digest, _) in turn.copies.items():
            state, at = arrays.from_bytes(store.blobs.get(digest)), self.counters[name].iteration
            other_values = self._initial_values(source) | population.read(state, self._movable)
            rng = population.decision_rng(self.config.seed, name, at, "explore")
            pbt = self.config.training.pbt
            self._move(name, explore(self.moved(name), other_values, self._initial_values(name), pbt, rng))
            self.learners[name].load(state)
            self.learners[name].reseed(crc32(f"{self.config.seed}/{name}/{at}/copy".encode()))
            other = self._new_annealing(name)
            if (mine := self._annealing[name]) and other:
                other.load(state)
                mine.follow(other)
        return bool(turn.copies)

    def moved(self, name: str) -> dict[str, float]:
        """Return the present values of a player's movable hyperparameters."""
        learner = self.learners[name]
        return {} if isinstance(learner, OwnLearner) else population.hyperparameters(learner.config, self._movable)

    def _initial_values(self, name: str) -> dict[str, float]:
        """Return the values of the movable hyperparameters in the player's settings."""
        return population.hyperparameters(settings_of(self.config, self.players[name]), self._movable)

    @property
    def _movable(self) -> tuple[str, ...]:
        pbt = self.config.training.pbt
        return () if pbt.ready is None else pbt.hyperparameters

    def _move(self, name: str, moved: Mapping[str, float]) -> None:
        """Set a player's hyperparameters; its learner is replaced, because they are part of compiled programs."""
        if moved.items() - self.moved(name).items():
            self.learners[name] = new_learner(self.config, self.arena, self.players[name], self.comm, moved)

    def reset_learner(self, store: Store, name: str, source: Snapshot) -> None:
        """Reset a player at the end of its generation to a snapshot's actors and an otherwise initial state."""
        learner, player, at = self.learners[name], self.players[name], self.counters[name].iteration
        reset_learner(learner, self.config, self.arena, player, store, source, at, self.comm)
        if self.role(name).reset == "initial":
            self._annealing[name] = self._new_annealing(name)
