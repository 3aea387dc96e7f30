"""Check of the sets of entities that an arena names in its observations (`Game.observation_entities`)."""

from collections.abc import Sequence

import jax
import numpy as np

from arenas.contract.check_run import CLOSE, WORLDS, CheckRun
from arenas.description import Entities
from arenas.state import AgentSpec


def problem(run: CheckRun) -> str:
    """Describe the first error in the sets of any agent; empty if there is none.

    Places must lie in the observation, each in one entity at most, and entities of a set must have equal numbers. A
    script of the game must not act otherwise if the entities of each set change places: it knows what they mean.
    """
    return next(filter(None, (of_agent(run, agent) for agent in run.arena.agents)), "")


def of_agent(run: CheckRun, agent: AgentSpec) -> str:
    """Describe the first error in the sets of one agent."""
    if not agent.entities:
        return ""
    if fault := shape_fault(agent.entities, agent.observation_size):
        return f"{agent.name}: {fault}"
    states = run.episode.states.observations[agent.name]
    for decision in (1, len(states) // 2):
        seen = np.asarray(states[decision][:WORLDS])
        moved = rotated(seen, agent.entities)
        for name, kinds in run.arena.scripts().items():
            if agent.kind in kinds:
                script = jax.jit(jax.vmap(kinds[agent.kind]))
                gap = float(np.abs(np.asarray(script(seen, run.keys)) - np.asarray(script(moved, run.keys))).max())
                if gap > CLOSE:
                    return f"{agent.name}: script {name} acts otherwise, by {gap:.2g}, if entities change places"
    return ""


def shape_fault(sets: Sequence[Entities], size: int) -> str:
    """Describe what is wrong with places in an observation of `size` numbers; empty if nothing is."""
    places = [place for each in sets for entity in each.places for place in entity]
    for each in sets:
        sizes = {len(entity) for entity in each.places}
        if len(sizes) != 1 or 0 in sizes:
            return f"entities of the set {each.name} have {sorted(sizes)} numbers; they need equally many, 1 or more"
    if outside := [place for place in places if not 0 <= place < size]:
        return f"entities name the place {outside[0]}, and the observation has {size} numbers"
    if twice := [place for place in places if places.count(place) > 1]:
        return f"the place {twice[0]} is in two entities"
    return ""


def rotated(seen: np.ndarray, sets: Sequence[Entities]) -> np.ndarray:
    """Return observations (N, obs) in which each entity of a set is in the place of the next one."""
    moved = np.array(seen)
    for each in sets:
        index = np.array(each.places)
        moved[:, index] = seen[:, np.roll(index, 1, axis=0)]
    return moved
