"""Opponents of a team whose learner is somebody else's: they act for the other teams inside the compiled step."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
from jax import Array

from arenas.arena import Arena
from arenas.errors import ArenaError
from arenas.state import TeamSpec

Actions = dict[str, Array]  # agent name -> action
Policy = Callable[[dict[str, Array], Array], Mapping[str, Array]]
"""One world, in JAX: (observations (obs,) by agent name, key) -> actions (act,) by agent name, all of one team."""


def no_memory(worlds: int) -> tuple[()]:
    """Return the memory of an opponent that remembers nothing."""
    return ()


class Opponent(NamedTuple):
    """The players of a team, or of several, in all worlds N.

    Programs are compiled once for each `act` and each shape of `params`.
    """

    # (params, observations (N, obs) by agent name, keys (N,), memory, first (N,) bool: an episode begins)
    # -> actions (N, act) by agent name, memory
    act: Callable[[Any, dict[str, Array], Array, Any, Array], tuple[Actions, Any]]
    params: Any = ()
    memory: Callable[[int], Any] = no_memory  # worlds -> memory before the first decision
    kept: Any = ()  # what must live as long as the opponent


@runtime_checkable
class OpponentSource(Protocol):
    """Something that can play a team of an arena once both are known, as `league.opponent` returns it."""

    def for_team(self, arena: Arena, team: TeamSpec) -> Opponent:
        """Return the opponent. Raises ArenaError, one line, if it cannot play that team."""
        ...


def opponent_for(arena: Arena, team: TeamSpec, choice: "str | Policy | OpponentSource") -> Opponent:
    """Return the opponent that plays `team`: a script's name, a function in JAX, or a source such as a snapshot.

    Raises ArenaError, one line, for anything else.
    """
    if isinstance(choice, str):
        return scripted(arena, team, choice)
    if isinstance(choice, OpponentSource):
        return choice.for_team(arena, team)
    if callable(choice):
        return _from_function(team, choice)
    raise ArenaError(f"opponent {choice!r:.80} cannot play: give a script's name, league.opponent(...) or a function")


def opponent_of_all(arena: Arena, teams: Sequence[TeamSpec], choice: Any) -> Opponent:
    """Return the opponent that plays all of these `teams`, by one choice for each of them or a mapping of team names.

    Raises ArenaError, one line, if one is missing or cannot play.
    """
    chosen = choice if isinstance(choice, Mapping) else {team.name: choice for team in teams}
    names = [team.name for team in teams]
    if unknown := [str(name) for name in chosen if name not in names]:
        raise ArenaError(f"opponent: {', '.join(unknown)} is none of the other teams, {', '.join(names)}")
    found = []
    for team in teams:
        if (own := chosen.get(team.name)) is None:
            scripts = ", ".join(arena.playable_scripts(team))
            raise ArenaError(
                f"who plays {team.name}? Give opponent=: a script ({scripts}) or league.opponent('store#snapshot')"
            )
        found.append(opponent_for(arena, team, own))
    if len(found) == 1:
        return found[0]
    act = _joint_actor(tuple(each.act for each in found), tuple(tuple(a.name for a in team.agents) for team in teams))

    def memory(worlds: int) -> Any:
        return tuple(each.memory(worlds) for each in found)

    return Opponent(act, tuple(each.params for each in found), memory, tuple(each.kept for each in found))


@lru_cache(maxsize=16)
def _joint_actor(acts: tuple[Any, ...], agents: tuple[tuple[str, ...], ...]) -> Any:
    """Return `Opponent.act` of several teams, each of which sees its own agents' observations only."""

    def act(params: Any, observations: dict[str, Array], keys: Array, memory: Any, first: Array) -> tuple[Actions, Any]:
        actions, memories = {}, []
        for i, (own, names) in enumerate(zip(acts, agents, strict=True)):
            seen = {name: observations[name] for name in names}
            theirs, kept = own(params[i], seen, agent_keys(keys, i), memory[i], first)
            actions |= theirs
            memories.append(kept)
        return actions, tuple(memories)

    return act


def scripted(arena: Arena, team: TeamSpec, name: str) -> Opponent:
    """Return the opponent that plays a script of the arena. Raises ArenaError, which lists the team's scripts."""
    able = arena.playable_scripts(team)
    if name not in able:
        raise ArenaError(
            f"team {team.name} of arena {arena.name} has no script {name!r}; it has {', '.join(able) or 'none'}."
            f" For a snapshot or a policy's file give opponent=league.opponent({name!r})"
        )
    return Opponent(_script_actor(arena, team, name))


@lru_cache(maxsize=16)  # a cached function keeps its arena in memory
def _script_actor(arena: Arena, team: TeamSpec, name: str) -> Any:
    """Return `Opponent.act` of a script: one function, so that environments of an arena share their programs."""
    kinds = arena.scripts()[name]
    scripts = {agent.name: kinds[agent.kind] for agent in team.agents}

    def act(params: Any, observations: dict[str, Array], keys: Array, memory: Any, first: Array) -> tuple[Actions, Any]:
        return {
            agent: jax.vmap(script)(observations[agent], agent_keys(keys, i))
            for i, (agent, script) in enumerate(scripts.items())
        }, memory

    return act


def agent_keys(keys: Array, agent: int) -> Array:
    """Return keys (N,) for the agent of this number in its team, from the worlds' keys (N,)."""
    return jax.vmap(lambda key: jax.random.fold_in(key, agent))(keys)


def _from_function(team: TeamSpec, policy: Policy) -> Opponent:
    names = [agent.name for agent in team.agents]

    def act(params: Any, observations: dict[str, Array], keys: Array, memory: Any, first: Array) -> tuple[Actions, Any]:
        actions = jax.vmap(policy)(observations, keys)
        for agent in team.agents:
            wanted = (keys.shape[0], agent.action_size)
            found = getattr(actions.get(agent.name), "shape", None) if isinstance(actions, Mapping) else None
            if found != wanted:
                raise ArenaError(
                    f"the opponent's function must return a dict with an action ({agent.action_size},) of each of"
                    f" {', '.join(names)}; for {agent.name} it gave {'none' if found is None else found[1:]}"
                )
        return {name: actions[name] for name in names}, memory

    return Opponent(act)
