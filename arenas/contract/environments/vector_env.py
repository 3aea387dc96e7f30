"""Many worlds of an arena as a Gymnasium `VectorEnv`, in which a team learns against an opponent."""

from collections.abc import Mapping
from typing import Any, Literal, Unpack

import jax
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from arenas.arena import Settings
from arenas.arena_settings import EngineOptions
from arenas.contract.environments import arguments
from arenas.contract.environments.array_exchange import Library, actions_in_jax, exporter
from arenas.contract.environments.opponent import Opponent, OpponentSource, Policy, no_memory, opponent_of_all
from arenas.contract.environments.shared_arenas import shared_arena
from arenas.contract.environments.team_programs import Carry, TeamRows, TeamStep, Weights
from arenas.errors import ArenaError
from arenas.state import TeamSpec

Agents = Literal["joint", "shared"]
Choice = str | Policy | OpponentSource | Mapping[str, "str | Policy | OpponentSource"] | None
"""The player of each other team, or a mapping of their names to the player of each."""


class TeamVectorEnv(VectorEnv[Any, Any, Any]):
    """Worlds of an arena as one team sees them; one compiled program per step moves them all, with the opponent.

    Worlds restart in the step in which their episode ends (`AutoresetMode.SAME_STEP`): observations are then those of
    the new episode, and `infos["final_obs"]` has the last ones of the old. See `arenas.vector`.
    """

    def __init__(
        self, name: str | Settings, team: str, opponent: Choice = None, num_envs: int = 1, agents: Agents = "joint",
        arrays: Library = "numpy", shaping: float = 1.0, void_penalty: float = 1.0, action_limit: float = 1.0,
        render_mode: str | None = None, **options: Unpack[EngineOptions],
    ):  # fmt: skip
        """Build the arena; its programs are compiled by the first reset and step. See `arenas.vector`."""
        arguments.no_rendering(render_mode)
        self.num_envs = arguments.whole("num_envs", num_envs)
        limit = arguments.number("action_limit", action_limit, above=0.0)
        self._weights = Weights(arguments.number("shaping", shaping), arguments.number("void_penalty", void_penalty))
        export = exporter(arrays)
        alone: EngineOptions = {"threads": 1} if self.num_envs == 1 else {}
        self._shared = shared_arena(name, **(alone | options | {"worlds": self.num_envs}))
        self._export = export  # after `_shared`, which says why nothing here can be pickled
        self.arena = arena = self._shared.arena
        self._rows = rows = TeamRows(arena, arguments.team_index(arena, team), _is_shared(agents))
        self.team: TeamSpec = rows.team
        self.worlds = _worlds(self.num_envs, rows)
        self._opponent = self._chosen(opponent)
        sizes = [(a.observation_size, a.action_size) for a in (rows.team.agents[: 1 if rows.shared else None])]
        self.single_observation_space = arguments.observation_box(sum(seen for seen, _ in sizes))
        self._act = sum(acts for _, acts in sizes)
        self.single_action_space = arguments.action_box(self._act, limit)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.metadata = {
            "render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP, "jax": arrays == "jax",
            "torch": arrays == "torch",
        }  # fmt: skip
        self._carry: Carry | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes in all worlds. `options={"opponent": ...}` changes the opponent.

        A seed decides all that follows. Without one, the episodes after a seeded reset are drawn from its seed.
        Raises ArenaError for any other option, since a misspelt one would leave the opponent as it was.
        """
        if options and options.get("reset_mask") is not None:
            raise ArenaError("reset_mask: worlds restart by themselves when their episode ends; reset() restarts all")
        if unknown := [key for key in options or {} if key not in ("opponent", "reset_mask")]:
            raise ArenaError(f"options: unknown {', '.join(map(repr, unknown))}; reset takes 'opponent' alone")
        if options and "opponent" in options:
            self._opponent = self._chosen(options["opponent"])
        super().reset(seed=None if seed is None else arguments.seed_of(seed))
        key = jax.random.key(int(self.np_random.integers(arguments.SEEDS)))
        program = self._shared.team_reset(self._rows)
        self._carry, observations, alive = program(key, self._opponent.memory(self.worlds), self.worlds)
        observations, alive = self._export((observations, alive))
        return observations, {"alive": alive}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one decision in all worlds. `actions` (num_envs, act) are arrays of any library, or lists.

        Infos are arrays of all rows: `alive`, the agents that take part in the next decision; `outcome` and `shaping`,
        the parts of the reward; `score` where `_score`, the result of an episode that ended: 1 win, ½ draw,
        0 loss, and against several teams the mean of these;
        `void`, where physics failed and there is none; `final_obs` where `_final_obs`.
        """
        if self._carry is None:
            raise ArenaError(f"no episodes of {self.arena.name} are under way: call reset() first")
        given = actions_in_jax(actions, (self.num_envs, self._act))
        program = self._shared.team_step(self._rows, self._opponent)
        carry, self._carry = self._carry, None  # its buffers are donated, whatever happens
        self._carry, found = program(carry, given, self._opponent.params, self._weights)
        step: TeamStep = self._export(found)
        infos = {
            "alive": step.alive, "outcome": step.outcome, "shaping": step.shaping, "score": step.score,
            "_score": step.scored, "void": step.void, "final_obs": step.final_observations, "_final_obs": step.done,
        }  # fmt: skip
        return step.observations, step.reward, step.terminated, step.truncated, infos

    def _chosen(self, choice: Choice) -> Opponent:
        """Return the opponent. Raises ArenaError where one is missing or nobody could play it."""
        others = [team for i, team in enumerate(self.arena.teams) if i != self._rows.index]
        if not others and choice is not None:
            raise ArenaError(f"arena {self.arena.name} has one team: it takes no opponent")
        if not others:
            return Opponent(_nobody)
        return opponent_of_all(self.arena, others, choice)


def _nobody(*_: Any) -> tuple[dict[str, Any], tuple[()]]:
    """Return no actions, where there is no other team."""
    return {}, no_memory(0)


def _is_shared(agents: str) -> bool:
    if agents not in ("joint", "shared"):
        raise ArenaError(
            f"agents={agents!r:.40}: choose joint (a row is a team) or shared (a row is one of its agents)"
        )
    return agents == "shared"


def _worlds(num_envs: int, rows: TeamRows) -> int:
    """Return the number of worlds. Raises ArenaError where the team's agents cannot share a row's spaces."""
    agents = rows.team.agents
    if rows.shared and len({(a.kind, a.observation_size, a.action_size) for a in agents}) > 1:
        kinds = ", ".join(f"{a.name} is {a.kind}:{a.observation_size}:{a.action_size}" for a in agents)
        raise ArenaError(f"agents='shared' needs agents of one kind and size, and {kinds}: take agents='joint'")
    if num_envs % rows.per_world:
        raise ArenaError(
            f"num_envs={num_envs}: with agents='shared' each world of {rows.team.name} has {rows.per_world} rows, so"
            f" give a multiple of {rows.per_world}"
        )
    return num_envs // rows.per_world
