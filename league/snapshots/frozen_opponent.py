"""Frozen policies as opponents in the environments of `arenas.vector`: snapshots, policies' files and programs."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.policy.jax_policy import PolicyStack, decide, memory_size, stack_policies
from arenas import rosters
from arenas.contract.environments.opponent import Actions, Opponent, agent_keys, scripted
from arenas.errors import ArenaError
from league.queries.query import Open
from league.snapshots import policy_file
from league.snapshots.codec import Policy, learnt_policies, thaw
from league.snapshots.programs import stored
from league.snapshots.programs.kinds import kind_of
from storage.blobs import arrays
from storage.records import ArenaKey, Snapshot
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena
    from arenas.state import TeamSpec


@dataclass(frozen=True)
class FrozenOpponent:
    """A snapshot of a league, or the policy in a file. It acts as in a match: learnt policies draw their actions."""

    named: str  # as the user named it
    snapshot: Snapshot
    store: str | None = None  # where the snapshot's policy is, unless it is in `tensors`
    tensors: Mapping[str, np.ndarray] | None = None  # of a file

    def for_team(self, arena: "Arena", team: "TeamSpec") -> Opponent:
        """Return the opponent. Raises ArenaError for a team of another roster, StorageError for a damaged policy."""
        if rosters.matching_roster(self.snapshot.roster, [team.roster]) is None:
            raise ArenaError(
                f"{self.named} is a policy of {self.snapshot.roster}, and team {team.name} of arena {arena.name} is"
                f" {team.roster}"
            )
        if self.snapshot.script:
            return scripted(arena, team, self.snapshot.script)
        return seated(team, self._policies(arena))

    def _policies(self, arena: "Arena") -> Sequence[Policy]:
        if self.store is not None:
            store = Store.open(self.store)
            try:
                return thaw(store, self.snapshot, arena)
            finally:
                store.close()
        return learnt_policies(self.tensors or {}, self.snapshot, arena)


@dataclass(frozen=True)
class ProgramOpponent:
    """A program of one's own, as `league import` takes it. It acts on the CPU, called back in each decision."""

    named: str
    kind: str

    def for_team(self, arena: "Arena", team: "TeamSpec") -> Opponent:
        """Return the opponent. Raises ProgramError, one line, for a program that cannot play for the team."""
        program = stored.read(self.kind, self.named.split(","), team.roster)
        return seated(team, stored.host_policies(program.to_bytes(), self.named))


def opponent(named: str, league: str | None = None) -> FrozenOpponent | ProgramOpponent:
    """Return the opponent `named`: see `league.opponent`."""
    where, found, name = named.rpartition("#")
    if found:
        with Open(Store.open(where), league) as opened:
            return FrozenOpponent(named, opened.snapshot(name), store=where)
    if kind := kind_of(named):
        return ProgramOpponent(named, kind)
    policy = policy_file.read(policy_file.find(named))
    about = policy.about
    arena = None if about["arena"] is None else ArenaKey(**about["arena"])
    digest = hashlib.sha256(arrays.to_bytes(policy.arrays)).hexdigest()
    snapshot = Snapshot(about["league"], about["name"], digest, about["roster"], arena=arena)
    return FrozenOpponent(named, snapshot, tensors=policy.arrays)


def seated(team: "TeamSpec", policies: Sequence[Policy]) -> Opponent:
    """Return the opponent with these policies of the team's agents."""
    stacks = {agent.name: stack_policies([policy]) for agent, policy in zip(team.agents, policies, strict=True)}
    return Opponent(_actor(tuple(stacks)), stacks, lambda worlds: _new_memory(stacks, worlds), kept=policies)


def _new_memory(stacks: dict[str, PolicyStack], worlds: int) -> dict[str, Array]:
    """Return hidden states (worlds, units) of the agents with a recurrent policy, by agent name."""
    sizes = {agent: memory_size(stack) for agent, stack in stacks.items()}
    return {agent: jnp.zeros((worlds, size)) for agent, size in sizes.items() if size}


@cache
def _actor(agents: tuple[str, ...]) -> Any:
    """Return the function by which policies act for these agents (`Opponent.act`).

    It is one function for all policies of a team: with networks of equal shapes, opponents change without a new
    compilation.
    """

    def let_act(
        stacks: dict[str, PolicyStack], observations: dict[str, Array], keys: Array, memory: Any, first: Array
    ) -> tuple[Actions, Any]:
        actions, after = {}, dict(memory)
        for i, agent in enumerate(agents):
            own, memory_before = agent_keys(keys, i), after.get(agent)
            found = decide(stacks[agent], observations[agent], own, memory=memory_before, agent=agent, first=first)
            actions[agent] = found.actions
            if found.memory is not None:
                after[agent] = found.memory
        return actions, after

    return let_act
