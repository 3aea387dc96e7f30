"""Conversion of learnt policies to bytes of a snapshot, and of these bytes to policies that can play."""

import json
from collections.abc import Mapping, Sequence

import numpy as np

from agents.policy.constant_inputs import silence_constant_inputs
from agents.policy.host_policy import HostPolicy
from agents.policy.jax_policy import Params, PolicyStack, policy_params, stack_policies
from agents.rollout.rollout import scripts_for
from arenas.arena import Arena
from arenas.errors import ArenaError
from arenas.game import check_scripts
from arenas.rosters import roster_agents
from arenas.state import TeamSpec
from league.snapshots.programs.stored import host_policies
from league.snapshots.transfer.arena_transfer import elsewhere
from storage.blobs import arrays, programs
from storage.errors import StorageError
from storage.records import Snapshot
from storage.store import Store

Policy = Params | HostPolicy | int  # a learned actor, a program on the host, or the number of the agent's script


def freeze(policies: Sequence[Mapping[str, np.ndarray]]) -> bytes:
    """Return the bytes of a snapshot from a roster's actors, given as one state dict per agent."""
    return arrays.to_bytes(
        {f"{i}/{name}": array for i, policy in enumerate(policies) for name, array in policy.items()}
    )


def thaw(store: Store, snapshot: Snapshot, arena: Arena) -> list[Policy]:
    """Return a snapshot's policies, one per agent of its roster.

    If it learnt in another arena, it plays as a warm start from it would begin: inputs that were constant there are
    ignored (`agents.policy.constant_inputs`). Raises DamagedBlob for bytes that do not verify, StorageError for a
    thinned snapshot or a program that cannot be loaded here, and ArenaError for a script that the arena lacks.
    """
    if snapshot.thinned is not None:
        raise StorageError(f"{snapshot.name} has been thinned: its policy is gone")
    data = store.blobs.get(snapshot.digest)
    if snapshot.script:
        able = check_scripts(arena, snapshot.script)
        kinds = [agent.partition(":")[0] for agent in roster_agents(snapshot.roster)]
        if missing := set(kinds) - set(able):
            raise ArenaError(f"arena {arena.name} has no script {snapshot.script!r} for {', '.join(sorted(missing))}")
        return [list(scripts_for(arena, kind)).index(snapshot.script) for kind in kinds]
    if programs.is_program(data):
        return list(host_policies(data, snapshot.name))
    tensors = arrays.from_bytes(data)
    return [*learnt_policies(tensors, snapshot, arena)]


def learnt_policies(tensors: Mapping[str, np.ndarray], snapshot: Snapshot, arena: Arena | None) -> list[Params]:
    """Return the learnt policies in a snapshot's arrays, one per agent of its roster. See `thaw`.

    Without an `arena` they stay as they are.
    """
    moved = arena is not None and elsewhere(snapshot, arena)
    prefixes = [f"{i}/" for i in range(len(roster_agents(snapshot.roster)))]
    own = [{k.removeprefix(p): v for k, v in tensors.items() if k.startswith(p)} for p in prefixes]
    return [policy_params(silence_constant_inputs(policy) if moved else policy) for policy in own]


def add_scripts(store: Store, league: str, arena: Arena, names: Sequence[str] | None) -> None:
    """Add scripted opponents to the pool, once for every roster that can play them; None: all scripts of the arena.

    Raises ArenaError for a script that no team of the arena can play.
    """
    snapshots = []
    for title, (name, roster) in script_titles(arena, names).items():
        digest = store.blobs.put(json.dumps({"script": name, "roster": roster}, sort_keys=True).encode())
        snapshots.append(Snapshot(league, title, digest, roster, script=name, origin="scripted"))
    store.add_snapshots(snapshots)


def script_titles(arena: Arena, names: Sequence[str] | None) -> dict[str, tuple[str, str]]:
    """Return the names of scripted opponents in a league: title -> (script, roster). See `add_scripts`."""
    rosters, titles = {team.roster: team for team in arena.teams}, {}
    for name in arena.scripts() if names is None else names:
        check_scripts(arena, name)
        able = {roster: team for roster, team in rosters.items() if name in arena.playable_scripts(team)}
        if not able and names is not None:
            raise ArenaError(f"no team of arena {arena.name} has a script {name!r} for all its robots")
        for roster, team in able.items():
            titles[name if len(rosters) == 1 else f"{name}:{team.name}"] = name, roster
    return titles


def seat(
    teams: Sequence[TeamSpec],
    seats: Sequence[Sequence[Sequence[Policy]]],
    also: Mapping[str, Sequence[Policy]] | None = None,
) -> dict[str, PolicyStack]:
    """Return stacks of policies by agent name for K groups of worlds: `seats[team][k]` plays that team in group k.

    `also` has, by agent, policies that do not play now but whose architectures get a place in the stack: later seats
    with them need no second compilation.
    """
    return {
        agent.name: stack_policies([policies[i] for policies in seats[t]], (also or {}).get(agent.name, ()))
        for t, team in enumerate(teams)
        for i, agent in enumerate(team.agents)
    }
