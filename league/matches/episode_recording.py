"""Conversion of a played episode to its recording: all that a viewer needs, frame by frame to the episode's end."""

from collections.abc import Mapping, Sequence

import jax
import mujoco
import numpy as np

from agents.rollout.rollout import PlayedEpisodes
from arenas.arena import Arena
from arenas.state import Frames
from league.system.packages.versions import versions
from league.system.provenance import code
from storage.recordings.recording import Recording, RecordingHeader
from storage.records import ArenaKey, Snapshot


def episode(
    arena: Arena, games: PlayedEpisodes, i: int, sides: Sequence[Snapshot], league: str, seed: int, world: int,
    values: Mapping[str, np.ndarray] | None = None,
) -> Recording:  # fmt: skip
    """Convert the i-th recorded episode of a batch, which was played in `world`.

    `sides` are the snapshots in the arena's team order. `values` are critics' values of the decisions, (decisions,) by
    the name of the team or agent that they are of.
    """
    hold, decisions = arena.timing.hold, int(games.decisions[world])
    frames = jax.tree.map(lambda x: x[:decisions, :, i].reshape(decisions * hold, *x.shape[3:]), games.frames)
    teams = [team.name for team in arena.teams]
    outcome = _outcome(np.asarray(games.score[world]), bool(games.void[world]), sides, teams)
    header = RecordingHeader(
        league, 0, seed, world, ArenaKey(arena.name, arena.config_hash, arena.engine.name),
        tuple(s.name for s in sides), tuple(s.digest for s in sides), tuple(teams),
        tuple(tuple(a.name for a in team.agents) for team in arena.teams),
        tuple(float(s) for s in games.score[world]), outcome, arena.timing.control_interval, arena.drawn_kinds,
        {**versions(), **code()},
    )  # fmt: skip
    rewards = np.zeros((decisions * hold, len(teams)))
    rewards[hold - 1 :: hold] = games.reward[:decisions, i]
    scores = np.zeros_like(rewards)
    scores[-1] = games.score[world]
    actions = {name: np.repeat(a[:decisions, i], hold, axis=0) for name, a in games.actions.items()}
    last, happened = decisions * hold - 1, sorted(_events(frames.events, teams) + _contact(arena, frames.qpos))
    if not games.void[world] and (late := _timeout(arena, frames, np.asarray(games.score[world]))) is not None:
        happened = sorted([*happened, (late, "timeout")], key=lambda event: event[0])
    design = arena.describe_design({name: each[0] for name, each in actions.items()})
    events = [*([(0, design)] if design else []), *happened, (last, outcome)]
    return Recording(
        header, arena.scene.xml, frames.time, frames.qpos, actions, rewards, scores, frames.markers, events,
        terms={**frames.rewards, **frames.shapings},
        values={name: np.repeat(each, hold) for name, each in (values or {}).items()},
    )  # fmt: skip


def _outcome(score: np.ndarray, void: bool, sides: Sequence[Snapshot], teams: Sequence[str]) -> str:
    if void:
        return "void"
    if len(sides) == 1:
        return f"{sides[0].name} {'succeeds' if score[0] > 0.5 else 'fails'}"
    if score.min() == score.max():
        return "draw"
    first = np.flatnonzero(score == score.max()).tolist()
    if len(first) > 1:
        return f"{' and '.join(f'{sides[i].name} as {teams[i]}' for i in first)} tie ahead of the others"
    return f"{sides[first[0]].name} wins as {teams[first[0]]}"


def _timeout(arena: Arena, frames: Frames, score: np.ndarray) -> int | None:
    """Return the step in which the game ended because time was up; None if it ended otherwise.

    A game that is won in its last control step, together with an event, was won by that event. Steps after the end do
    not count: the last decision is executed for all its control steps.
    """
    end = int(np.argmax(frames.over))
    if frames.time[end] <= arena.timing.episode - arena.timing.control_interval / 2:
        return None
    won = score[0] > 0.5 if len(score) == 1 else score.min() != score.max()
    return None if won and any(event[end].any() for event in frames.events.values()) else end


def _events(happened: dict[str, np.ndarray], teams: Sequence[str]) -> list[tuple[int, str]]:
    """Return (step, "name: team") for each beginning of an event (T, teams), event by event."""
    found = []
    for name, by_team in happened.items():
        begins = by_team & ~np.vstack([np.zeros_like(by_team[:1]), by_team[:-1]])
        found += [(int(step), f"{name}: {teams[team]}") for step, team in zip(*np.nonzero(begins), strict=True)]
    return found


def _contact(arena: Arena, qpos: np.ndarray) -> list[tuple[int, str]]:
    """Return (step, "contact") of the first contact of robots of two teams, by MuJoCo's collisions of qpos (T, nq)."""
    model = arena.scene.model
    team = np.full(model.nbody, -1)
    for number, side in enumerate(arena.teams):
        for agent in side.agents:
            team[[b for b in range(model.nbody) if model.body(b).name.startswith(f"{agent.name}/")]] = number
    if len(set(team[team >= 0])) < 2:
        return []
    data = mujoco.MjData(model)
    for step, row in enumerate(qpos[np.isfinite(qpos).all(axis=1)]):  # a void episode may end in non-finite numbers
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs = team[model.geom_bodyid[data.contact.geom]]
        if ((pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])).any():
            return [(step, "contact")]
    return []
