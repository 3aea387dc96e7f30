"""A frozen policy on a grid of worlds that nobody trained on: every corner of what a designer may set, and between.

The designer of the arena (`Robot.sets`) is played by the grid: each of its numbers takes equally spaced values from
its lowest to its highest, and each of its choices all of its names. RRLS (2406.08406) measures the mean and the worst
cell of such a grid, ten values for each number; here also the worst tenth of the cells. Other agents of the other team
do nothing.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas import rosters
from arenas.arena import Arena
from arenas.contract.environments.opponent import Opponent, scripted
from arenas.errors import ArenaError
from arenas.robots.robot import Bounds, is_choice
from arenas.state import State, TeamSpec
from league.snapshots.codec import thaw
from league.snapshots.frozen_opponent import seated
from storage.records import Snapshot
from storage.store import Store


class Grid(NamedTuple):
    """Results by cell; the last axis of the designer's numbers changes fastest."""

    names: tuple[str, ...]  # of what the designer sets
    values: np.ndarray  # (cells, names), of a choice the place of a name
    labels: tuple[dict[str, float | str], ...]  # (cells,) the same by name, of a choice the name
    scores: np.ndarray  # (cells,) mean score, 1 for a win; episodes whose physics failed are left out
    returns: np.ndarray  # (cells,) mean sum of the team's reward over an episode
    voids: int  # episodes whose physics failed


class Worst(NamedTuple):
    """Summary of the cells: a policy is as robust as its worst ones."""

    mean: float
    tenth: float  # mean of the worst tenth of the cells, at least one
    least: float
    where: Any  # the worst cell


def grid_points(sets: Mapping[str, Bounds], points: int) -> np.ndarray:
    """Return the cells' actions (cells, sets): each number from -1 to 1 in so many points, one in the middle; each
    choice in the middle of the part of every name.
    """
    axis = np.linspace(-1.0, 1.0, points) if points > 1 else np.zeros(1)
    axes = [(2 * np.arange(len(each)) + 1) / len(each) - 1 if is_choice(each) else axis for each in sets.values()]
    return np.array(list(itertools.product(*axes)), np.float32)


def designer_of(arena: Arena) -> str:
    """Return the agent whose first action sets the world. Raises ArenaError, one line, if there is not one."""
    found = [agent for agent, robot in arena.robots.items() if robot.sets]
    if len(found) != 1:
        raise ArenaError(
            f"arena {arena.name} has {len(found)} agents that set its worlds, and a grid needs one; disturbance has it"
            " with --arena.design '{friction = [0.5, 2], base = [0.5, 2]}'"
        )
    return found[0]


def play_grid(arena: Arena, store: Store, snapshot: Snapshot, points: int, episodes: int, seed: int) -> Grid:
    """Play `episodes` in each cell, the same seeds in all cells; the policy plays the first team that it fits.

    The arena must be built for cells × episodes worlds. Raises ArenaError, one line, if it cannot be played.
    """
    author = designer_of(arena)
    robot = arena.robots[author]
    teams = [team for team in arena.teams if author not in {agent.name for agent in team.agents}]
    team = next((team for team in teams if rosters.matching_roster(snapshot.roster, [team.roster])), None)
    if team is None:
        raise ArenaError(
            f"{snapshot.name} is a policy of {snapshot.roster}, and arena {arena.name} has a designer against"
            f" {', '.join(team.roster for team in teams) or 'nobody'}"
        )
    cells = grid_points(robot.sets, points)
    player = scripted(arena, team, snapshot.script) if snapshot.script else None
    player = player or seated(team, thaw(store, snapshot, arena))
    score, total, void = _played(arena, player, team, author, np.repeat(cells, episodes, axis=0), episodes, seed)
    valid = ~void.reshape(-1, episodes)
    sums = [np.where(valid, each.reshape(-1, episodes), 0.0).sum(axis=1) for each in (score, total)]
    counts = np.where(valid.any(axis=1), valid.sum(axis=1), np.nan)
    values = np.asarray(robot.designed(jnp.asarray(cells)))
    labels = tuple(map(robot.name_designed, values))
    return Grid(tuple(robot.sets), values, labels, sums[0] / counts, sums[1] / counts, int(void.sum()))


def _played(
    arena: Arena, player: Opponent, team: TeamSpec, author: str, designs: np.ndarray, episodes: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return score, return and void of the team in every world (N,); `designs` are (N, numbers)."""
    index, worlds = arena.teams.index(team), len(designs)
    one = jax.random.split(jax.random.key(seed), (episodes, 2))
    start, own = (jnp.tile(one[:, i], worlds // episodes) for i in range(2))
    still = {agent.name: jnp.zeros((worlds, agent.action_size)) for agent in arena.agents}

    def decision(carry: tuple[State, Any, Array], t: Array) -> tuple[tuple[State, Any, Array], None]:
        state, memory, total = carry
        keys = jax.vmap(lambda key: jax.random.fold_in(key, t))(own)
        seen = {agent.name: state.observations[agent.name] for agent in team.agents}
        acts, memory = player.act(player.params, seen, keys, memory, jnp.broadcast_to(t == 0, (worlds,)))
        after = jax.vmap(arena.step)(state, {**still, author: jnp.asarray(designs), **acts})
        gained = (after.verdict.reward + after.verdict.shaping)[:, index]
        return (after, memory, total + jnp.where(state.done, 0.0, gained)), None

    @jax.jit
    def play() -> tuple[Array, Array, Array]:
        begin = jax.vmap(arena.reset)(start), player.memory(worlds), jnp.zeros(worlds)
        (state, _, total), _ = jax.lax.scan(decision, begin, jnp.arange(arena.timing.decisions))
        return state.verdict.score[:, index], total, state.void

    score, total, void = map(np.asarray, play())
    return score, total, void


def summarise(values: np.ndarray, cells: Sequence[Any]) -> Worst:
    """Return mean, worst tenth and worst of the cells' values (cells,), without cells that have none.

    `cells` say what each cell is: its `values` or its `labels`.
    """
    known = np.flatnonzero(~np.isnan(values))
    if not len(known):
        return Worst(np.nan, np.nan, np.nan, cells[0])
    order = known[np.argsort(values[known], kind="stable")]
    tenth = order[: max(1, len(order) // 10)]
    return Worst(float(values[known].mean()), float(values[tenth].mean()), float(values[order[0]]), cells[order[0]])
