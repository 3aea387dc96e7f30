"""Many worlds of an arena as a vector environment of Stable-Baselines3, which has an interface of its own."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from arenas.contract.environments.vector_env import TeamVectorEnv
from arenas.errors import ArenaError


class StableBaselinesEnv(VecEnv):
    """A `TeamVectorEnv` with NumPy arrays as Stable-Baselines3 expects it; see `arenas.stable_baselines`.

    In the step that ends an episode its info has `terminal_observation`, `TimeLimit.truncated`, and `score` unless
    physics failed.
    """

    def __init__(self, worlds: TeamVectorEnv):
        """Wrap the worlds."""
        self.worlds = worlds
        self._actions: Any = None
        super().__init__(worlds.num_envs, worlds.single_observation_space, worlds.single_action_space)

    def reset(self) -> Any:
        """Begin new episodes in all worlds and return the observations (num_envs, obs).

        What `set_options` was given counts once, as of other vector environments. Raises ArenaError where it was a list
        of unlike options.
        """
        options = self._options[0] if self._options else {}
        if any(each != options for each in self._options):
            raise ArenaError("set_options: all rows move in one program, so give one dict for all of them")
        observations, _ = self.worlds.reset(seed=self._seeds[0], options=options)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (num_envs, act) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Take one decision in all worlds; return observations, rewards, ends, infos."""
        observations, rewards, terminated, truncated, found = self.worlds.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i] = {"terminal_observation": found["final_obs"][i], "TimeLimit.truncated": bool(truncated[i])}
            if found["_score"][i]:
                infos[i]["score"] = float(found["score"][i])
        return observations, rewards, done, infos

    def close(self) -> None:
        """Close the worlds."""
        self.worlds.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the worlds, once for each index; raise AttributeError if there is none."""
        return [getattr(self.worlds, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Raise ArenaError: rows are no environments of their own."""
        raise ArenaError(f"{attr_name} cannot be set: all rows move in one program; set it when the worlds are made")

    def env_method(
        self, method_name: str, *args: Any, indices: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Raise ArenaError: rows are no environments of their own."""
        raise ArenaError(f"{method_name} cannot be called for a row: all rows move in one program")

    def env_is_wrapped(self, wrapper_class: Any, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False for each index: rows have no wrappers."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return no pictures: an arena draws nothing."""
        return [None] * self.num_envs
