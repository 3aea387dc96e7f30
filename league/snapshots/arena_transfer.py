"""Policies that play in another arena than the one in which they learnt.

They play as a warm start from them would begin (`league.snapshots.warm_start`): inputs that were constant where they
learnt are ignored (`agents.policy.constant_inputs`). Else each such input, divided by a deviation of zero, would be at
its limit.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from agents.policy.constant_inputs import is_constant
from league.queries.query import Open
from league.snapshots.policy_file import Policy, arena_name
from storage.records import Snapshot

if TYPE_CHECKING:
    from arenas.arena import Arena


def elsewhere(snapshot: Snapshot, arena: "Arena") -> bool:
    """Return whether a policy learnt in an arena with other rules or bodies; False if its arena is not known."""
    return snapshot.arena is not None and snapshot.arena.config_hash != arena.config_hash


def describe_transfer(league: Open, policy: Policy) -> str:
    """Return a note about an imported policy that learnt in another arena than the league's, else an empty text.

    This compares names of arenas only, because the rules are not known before the arena is built.
    """
    learnt, here = (policy.about["arena"] or {}).get("arena"), arena_name(league)
    if learnt is None or here in ("", learnt):
        return ""
    still, every = np.sum([_inputs(policy.arrays, f"{i}/") for i in range(len(policy.about["agents"]))], axis=0)
    if not still:
        return f"It learnt in {learnt}, where all its inputs moved."
    return f"It learnt in {learnt}: {still} of its {every} inputs never moved there, and say nothing to it here."


def _inputs(found: Mapping[str, np.ndarray], agent: str) -> tuple[int, int]:
    """Return the number of constant inputs of an agent, and the number of all its inputs."""
    rests = is_constant(found, agent)
    return int(rests.sum()), rests.size
