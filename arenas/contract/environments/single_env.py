"""One world of an arena as a Gymnasium `Env`, in which a team learns against an opponent."""

from typing import Any

import gymnasium
import numpy as np

from arenas.arena import Arena
from arenas.contract.environments import arguments
from arenas.contract.environments.vector_env import TeamVectorEnv
from arenas.errors import ArenaError


class TeamEnv(gymnasium.Env[Any, Any]):
    """The only world of a `TeamVectorEnv` with the team as one row. It waits for `reset` when an episode has ended."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, *args: Any, **kwargs: Any):
        """Build the environment with the arguments of `TeamVectorEnv` but for `num_envs`, `agents` and `arrays`."""
        self._row = TeamVectorEnv(*args, **kwargs, num_envs=1)
        self.observation_space = self._row.single_observation_space
        self.action_space = self._row.single_action_space
        self._running = False

    @property
    def arena(self) -> Arena:
        """The arena."""
        return self._row.arena

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; `options` as in `TeamVectorEnv.reset`."""
        super().reset(seed=None if seed is None else arguments.seed_of(seed))
        observations, infos = self._row.reset(seed=int(self.np_random.integers(arguments.SEEDS)), options=options)
        self._running = True
        return observations[0], {"alive": infos["alive"][0]}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one decision with an action (act,)."""
        if not self._running:
            raise ArenaError(f"no episode of {self.arena.name} is under way: call reset() first")
        try:
            given = np.asarray(action, np.float32)
        except (ValueError, TypeError):
            raise ArenaError(f"the action {action!r:.40} is no array of numbers") from None
        _check_shape(given, self.action_space.shape)
        observations, reward, terminated, truncated, infos = self._row.step(given[None])
        done = bool(infos["_final_obs"][0])
        self._running = not done
        names = ["outcome", "shaping", *(["score"] if infos["_score"][0] else []), *(["void"] if done else [])]
        info = {name: infos[name][0].item() for name in names} | {"alive": infos["alive"][0]}
        observation = (infos["final_obs"] if done else observations)[0]
        return observation, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


def _check_shape(given: np.ndarray, shape: tuple[int, ...] | None) -> None:
    if given.shape != shape:
        raise ArenaError(f"the action has the shape {given.shape}, and the action space has {shape}")
