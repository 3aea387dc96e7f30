"""Snapshots as bytes, and bytes as policies that act: what the learner freezes and the referee plays."""

import json
from collections.abc import Mapping, Sequence

import numpy as np

from agents.policy import Params, learned, scripted, stack
from arenas.arena import Arena, TeamSpec, check_scripts
from storage import arrays
from storage.records import Snapshot
from storage.store import Store


def freeze(policies: Sequence[Mapping[str, np.ndarray]]) -> bytes:
    """A roster's actors, one state dict per agent, as a snapshot's bytes."""
    return arrays.to_bytes(
        {f"{i}/{name}": array for i, policy in enumerate(policies) for name, array in policy.items()}
    )


def thaw(store: Store, snapshot: Snapshot, arena: Arena) -> list[Params]:
    """A snapshot's policies, one per agent of its roster."""
    agents = snapshot.roster.count("+") + 1
    data = store.blobs.get(snapshot.digest)
    if snapshot.script:
        check_scripts(arena, snapshot.script)
        return [scripted(list(arena.scripts()).index(snapshot.script))] * agents
    tensors = arrays.from_bytes(data)
    prefixes = [f"{i}/" for i in range(agents)]
    return [learned({k.removeprefix(p): v for k, v in tensors.items() if k.startswith(p)}) for p in prefixes]


def add_scripts(store: Store, league: str, arena: Arena, names: Sequence[str]) -> None:
    """Put scripted opponents into the pool, once for every roster that can play them."""
    rosters = {team.roster: team.name for team in arena.teams}
    snapshots = []
    for name in names:
        check_scripts(arena, name)
        for roster, team in rosters.items():
            digest = store.blobs.put(json.dumps({"script": name, "roster": roster}, sort_keys=True).encode())
            title = name if len(rosters) == 1 else f"{name}:{team}"
            snapshots.append(Snapshot(digest, league, title, roster, script=name))
    store.add_snapshots(snapshots)


def seat(teams: Sequence[TeamSpec], seats: Sequence[Sequence[list[Params]]]) -> dict[str, Params]:
    """Stacked policies by agent name for K groups of worlds: `seats[team][k]` is who plays that team in group k."""
    return {
        agent.name: stack([policies[i] for policies in seats[t]])
        for t, team in enumerate(teams)
        for i, agent in enumerate(team.agents)
    }
