"""From a played episode to its recording: what a viewer needs, frame by frame to the episode's end."""

from collections.abc import Mapping, Sequence

import jax
import mujoco
import numpy as np

from agents.rollout import Games
from arenas.arena import Arena
from league.versions import versions
from storage.recording import Recording, RecordingHeader
from storage.records import ArenaKey, Snapshot


def episode(
    arena: Arena, games: Games, i: int, sides: Sequence[Snapshot], league: str, seed: int, world: int,
    values: Mapping[str, np.ndarray] | None = None,
) -> Recording:  # fmt: skip
    """The i-th recorded episode of a batch, which was played in `world`, with `sides` in the arena's team order.

    `values` are what critics made of its decisions, (decisions,) by who is judged.
    """
    hold, decisions = arena.timing.hold, int(games.decisions[world])
    frames = jax.tree.map(lambda x: x[:decisions, :, i].reshape(decisions * hold, *x.shape[3:]), games.frames)
    teams = [team.name for team in arena.teams]
    outcome = _outcome(np.asarray(games.score[world]), bool(games.void[world]), sides, teams)
    header = RecordingHeader(
        league, 0, seed, world, ArenaKey(arena.name, arena.config_hash, arena.engine.name),
        tuple(s.name for s in sides), tuple(s.digest for s in sides), tuple(teams),
        tuple(tuple(a.name for a in team.agents) for team in arena.teams),
        tuple(float(s) for s in games.score[world]), outcome, arena.timing.control_interval, arena.marker_kinds,
        versions(),
    )  # fmt: skip
    rewards = np.zeros((decisions * hold, len(teams)))
    rewards[hold - 1 :: hold] = games.reward[:decisions, i]
    scores = np.zeros_like(rewards)
    scores[-1] = games.score[world]
    actions = {name: np.repeat(a[:decisions, i], hold, axis=0) for name, a in games.actions.items()}
    last, happened = decisions * hold - 1, sorted(_events(frames.events, teams) + _contact(arena, frames.qpos))
    late = frames.time[-1] > arena.timing.episode - arena.timing.control_interval / 2
    if late and last not in dict(happened):
        happened.append((last, "timeout"))
    events = [*happened, (last, outcome)]
    return Recording(
        header, arena.scene.xml, frames.time, frames.qpos, actions, rewards, scores, frames.markers, events,
        terms={**frames.rewards, **frames.shapings},
        values={who: np.repeat(told, hold) for who, told in (values or {}).items()},
    )  # fmt: skip


def _outcome(score: np.ndarray, void: bool, sides: Sequence[Snapshot], teams: Sequence[str]) -> str:
    if void:
        return "void"
    if len(sides) == 1:
        return f"{sides[0].name} {'succeeds' if score[0] > 0.5 else 'fails'}"
    if score[0] == score[1]:
        return "draw"
    first = int(np.argmax(score))
    return f"{sides[first].name} wins as {teams[first]}"


def _events(happened: dict[str, np.ndarray], teams: Sequence[str]) -> list[tuple[int, str]]:
    """(step, "name: team") where an event (T, teams) begins, in the order in which they happened."""
    found = []
    for name, by_team in happened.items():
        begins = by_team & ~np.vstack([np.zeros_like(by_team[:1]), by_team[:-1]])
        found += [(int(step), f"{name}: {teams[team]}") for step, team in zip(*np.nonzero(begins), strict=True)]
    return found


def _contact(arena: Arena, qpos: np.ndarray) -> list[tuple[int, str]]:
    """(step, "contact") where robots of two teams first touch each other, by MuJoCo's collisions of qpos (T, nq)."""
    model = arena.scene.model
    team = np.full(model.nbody, -1)
    for number, side in enumerate(arena.teams):
        for agent in side.agents:
            team[[b for b in range(model.nbody) if model.body(b).name.startswith(f"{agent.name}/")]] = number
    if len(set(team[team >= 0])) < 2:
        return []
    data = mujoco.MjData(model)
    for step, row in enumerate(qpos[np.isfinite(qpos).all(axis=1)]):  # numbers of a void episode's end are none
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs = team[model.geom_bodyid[data.contact.geom]]
        if ((pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])).any():
            return [(step, "contact")]
    return []
