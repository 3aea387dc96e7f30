"""One world of an arena as a PettingZoo `ParallelEnv`: every agent of every team acts at once."""

from collections.abc import Mapping
from typing import Any, Unpack

import jax
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from arenas.arena import Settings
from arenas.arena_settings import EngineOptions
from arenas.contract.environments import arguments
from arenas.contract.environments.shared_arenas import shared_arena
from arenas.errors import ArenaError
from arenas.physics.void_causes import causes_in
from arenas.state import State, mean_pairwise_score

Floats = NDArray[np.float32]


class WorldEnv(ParallelEnv[str, Any, Any]):
    """One world. Agents are named as in the arena, e.g. `blue/0`; rewards are those of their teams.

    An agent that leaves the game is terminated in the decision in which it leaves, and is in `agents` no more. Where
    agents act by turns (`Game.by_turns`) all stay in `agents` to the end: who is not on turn sees zeros, its action
    does nothing, and `alive` in its info is False. A game's end terminates all that are left, its time limit truncates
    them. If physics fails, no result is known: all agents are truncated with reward 0 and see once more what they saw
    before. The agents of a team whose own robots caused the failure are terminated instead, with the reward
    `-void_penalty`.
    """

    metadata = {"name": "robot_league", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012
    render_mode: str | None = None

    def __init__(
        self, name: str | Settings, shaping: float = 1.0, void_penalty: float = 1.0, action_limit: float = 1.0,
        render_mode: str | None = None, **options: Unpack[EngineOptions],
    ):  # fmt: skip
        """Build the arena; its programs are compiled by the first reset and step. See `arenas.pettingzoo`."""
        arguments.no_rendering(render_mode)
        self._shaping = arguments.number("shaping", shaping)
        self._void_penalty = arguments.number("void_penalty", void_penalty)
        limit = arguments.number("action_limit", action_limit, above=0.0)
        self._shared = shared_arena(name, **options)
        self.arena = arena = self._shared.arena
        self.metadata = {**type(self).metadata, "name": arena.name}
        self.possible_agents = [agent.name for agent in arena.agents]
        self.agents: list[str] = []
        self._team = {a.name: i for i, team in enumerate(arena.teams) for a in team.agents}
        self._boxes = {a.name: arguments.observation_box(a.observation_size) for a in arena.agents}
        self._action_boxes = {a.name: arguments.action_box(a.action_size, limit) for a in arena.agents}
        self.observation_spaces, self.action_spaces = {**self._boxes}, {**self._action_boxes}
        size = arena.privileged_size or sum(a.observation_size for a in arena.agents)
        self.state_space: spaces.Box = arguments.observation_box(size)
        self._state: State | None = None
        self._seen: State | None = None  # the same on the host, without physics and game
        self._random: np.random.Generator | None = None

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the space of an agent's observations."""
        return self._boxes[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Return the space of an agent's actions."""
        return self._action_boxes[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Floats], dict[str, dict[str, Any]]]:
        """Begin an episode. Without a seed the episodes that follow a seeded one are drawn from its seed."""
        if self._random is None or seed is not None:
            self._random = np.random.default_rng(arguments.seed_of(seed))
        key = jax.random.key(int(self._random.integers(arguments.SEEDS)))
        self._state = state = self._shared.world("reset")(key)
        self._seen = seen = _on_host(state)
        self.agents = [name for name in self.possible_agents if self._is_in_the_game(seen, name)]
        return self._observations(seen), {name: self._turn(seen, name) for name in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Floats], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Take one decision, with an action of every agent in `agents`."""
        if self._state is None or self._seen is None or not self.agents:
            raise ArenaError(f"no episode of {self.arena.name} is under way: call reset() first")
        before, acting = self._seen, list(self.agents)
        self._state = state = self._shared.world("step")(self._state, self._checked(actions))
        self._seen = seen = _on_host(state)
        left = {name: not self._is_in_the_game(seen, name) for name in acting}
        self.agents = [] if seen.done else [name for name in acting if not left[name]]
        infos = {name: self._info(seen, name) for name in acting}
        terminated = {
            name: self._is_guilty(seen, name) or bool(not seen.void and (seen.verdict.terminated or left[name]))
            for name in acting
        }
        truncated = {name: bool(seen.done) and not terminated[name] for name in acting}
        rewards = {name: info["outcome"] + self._shaping * info["shaping"] for name, info in infos.items()}
        return self._observations(before if seen.void else seen, acting), rewards, terminated, truncated, infos

    def state(self) -> Floats:
        """Return the whole state of the world (state_space): `Arena.privileged`, or if there is none, what all see."""
        if self._state is None or self._seen is None:
            raise ArenaError(f"no episode of {self.arena.name} is under way: call reset() first")
        if self.arena.privileged_size:
            return np.array(self._shared.world("privileged_state")(self._state))
        return np.concatenate([self._seen.observations[name] for name in self.possible_agents])

    def _observations(self, seen: State, agents: list[str] | None = None) -> dict[str, Floats]:
        return {name: np.array(seen.observations[name]) for name in (self.agents if agents is None else agents)}

    def _checked(self, actions: Mapping[str, Any]) -> dict[str, Floats]:
        """Return an action of every agent, zeros of those that have left. Raises ArenaError for others than `agents`.

        An agent's NaN is no such error: it makes the world void, and its team answers for it.
        """
        given = actions if isinstance(actions, Mapping) else {}
        if missing := [name for name in self.agents if name not in given]:
            raise ArenaError(f"no action of {', '.join(missing)}: give one of each of {', '.join(self.agents)}")
        if unknown := [str(name) for name in given if name not in self.agents]:
            raise ArenaError(f"{', '.join(unknown)} cannot act; those in the game are {', '.join(self.agents)}")
        shapes = {name: box.shape for name, box in self._action_boxes.items()}
        return {
            name: _action(name, given[name], shape) if name in self.agents else np.zeros(shape, np.float32)
            for name, shape in shapes.items()
        }

    def _is_in_the_game(self, seen: State, name: str) -> bool:
        return self.arena.by_turns or bool(seen.alive[self.possible_agents.index(name)])

    def _turn(self, seen: State, name: str) -> dict[str, Any]:
        """Return whether an agent is on turn, in a game of turns."""
        return {"alive": bool(seen.alive[self.possible_agents.index(name)])} if self.arena.by_turns else {}

    def _is_guilty(self, seen: State, name: str) -> bool:
        """Return whether physics failed in the world because of the agent's team."""
        return bool(seen.void and seen.at_fault[self._team[name]])

    def _info(self, seen: State, name: str) -> dict[str, Any]:
        """Return the agent's part of the verdict; at the end of an episode also its score, or why there is none."""
        if seen.void:
            lost = -self._void_penalty if self._is_guilty(seen, name) else 0.0
            return {"outcome": lost, "shaping": 0.0, "void": [cause.key for cause in causes_in(int(seen.causes))]}
        team, verdict = self._team[name], seen.verdict
        rewards = {term: float(values[team]) for term, values in verdict.rewards.items()}
        shapings = {term: float(values[team]) for term, values in verdict.shapings.items()}
        info: dict[str, Any] = self._turn(seen, name) | {
            "outcome": sum(rewards.values(), 0.0),
            "shaping": sum(shapings.values(), 0.0),
            "rewards": rewards,
            "shapings": shapings,
            "events": [event for event, happened in verdict.events.items() if happened[team]],
        }
        return info | ({"score": float(mean_pairwise_score(verdict.score)[team])} if seen.done else {})


def _action(name: str, given: Any, shape: tuple[int, ...]) -> Floats:
    try:
        action = np.asarray(given, np.float32)
    except (ValueError, TypeError):
        action = None
    if action is None or action.shape != shape:
        what = f"has the shape {action.shape}" if action is not None else "is no array of numbers"
        raise ArenaError(f"the action of {name} {what}, and its space has {shape}")
    return action


def _on_host(state: State) -> State:
    """Return the reported arrays of a state, in host memory."""
    return jax.device_get(state._replace(physics=(), game=(), actions={}))
