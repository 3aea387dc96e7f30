"""Snapshots as bytes, and bytes as policies that act: what the learner freezes and the referee plays."""

import json
from collections.abc import Mapping, Sequence

import numpy as np

from agents.policy import Crew, Params, crew, learned
from agents.rollout import scripts_of
from arenas.arena import Arena
from arenas.errors import ArenaError
from arenas.game import check_scripts
from arenas.state import TeamSpec
from storage import arrays
from storage.errors import StorageError
from storage.records import Snapshot
from storage.store import Store

Policy = Params | int  # a learned actor, or the number of the agent's script


def freeze(policies: Sequence[Mapping[str, np.ndarray]]) -> bytes:
    """A roster's actors, one state dict per agent, as a snapshot's bytes."""
    return arrays.to_bytes(
        {f"{i}/{name}": array for i, policy in enumerate(policies) for name, array in policy.items()}
    )


def thaw(store: Store, snapshot: Snapshot, arena: Arena) -> list[Policy]:
    """A snapshot's policies, one per agent of its roster; bytes that do not verify raise DamagedBlob."""
    if snapshot.thinned is not None:
        raise StorageError(f"{snapshot.name} has been thinned: its policy is gone")
    data = store.blobs.get(snapshot.digest)
    if snapshot.script:
        able = check_scripts(arena, snapshot.script)
        kinds = [agent.partition(":")[0] for agent in snapshot.roster.split("+")]
        if missing := set(kinds) - set(able):
            raise ArenaError(f"arena {arena.name} has no script {snapshot.script!r} for {', '.join(sorted(missing))}")
        return [list(scripts_of(arena, kind)).index(snapshot.script) for kind in kinds]
    tensors = arrays.from_bytes(data)
    prefixes = [f"{i}/" for i in range(snapshot.roster.count("+") + 1)]
    return [learned({k.removeprefix(p): v for k, v in tensors.items() if k.startswith(p)}) for p in prefixes]


def add_scripts(store: Store, league: str, arena: Arena, names: Sequence[str] | None) -> None:
    """Put scripted opponents into the pool, once for every roster that can play them; None: all that there are.

    Raises ArenaError for a script that no team of the arena can play.
    """
    snapshots = []
    for title, (name, roster) in script_titles(arena, names).items():
        digest = store.blobs.put(json.dumps({"script": name, "roster": roster}, sort_keys=True).encode())
        snapshots.append(Snapshot(league, title, digest, roster, script=name, origin="scripted"))
    store.add_snapshots(snapshots)


def script_titles(arena: Arena, names: Sequence[str] | None) -> dict[str, tuple[str, str]]:
    """How those scripted opponents are called in a league: title -> the script and the roster. See `add_scripts`."""
    rosters, titles = {team.roster: team for team in arena.teams}, {}
    for name in arena.scripts() if names is None else names:
        check_scripts(arena, name)
        able = {roster: team for roster, team in rosters.items() if name in arena.playable(team)}
        if not able and names is not None:
            raise ArenaError(f"no team of arena {arena.name} has a script {name!r} for all its robots")
        for roster, team in able.items():
            titles[name if len(rosters) == 1 else f"{name}:{team.name}"] = name, roster
    return titles


def seat(
    teams: Sequence[TeamSpec],
    seats: Sequence[Sequence[Sequence[Policy]]],
    also: Mapping[str, Sequence[Policy]] | None = None,
) -> dict[str, Crew]:
    """Crews by agent name for K groups of worlds: `seats[team][k]` is who plays that team in group k.

    `also` names, by agent, policies whose architectures shall have a place although they sit nowhere now: then the
    next lineup, in which they do sit, needs no second compile.
    """
    return {
        agent.name: crew([policies[i] for policies in seats[t]], (also or {}).get(agent.name, ()))
        for t, team in enumerate(teams)
        for i, agent in enumerate(team.agents)
    }
