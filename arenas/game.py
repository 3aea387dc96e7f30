"""Base class of games: robots in a scene, the hooks to implement, and queries about the robots."""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Unpack, final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.arena_settings import EngineOptions, Solver, Timing
from arenas.description import Entities, Legend, Part, total_size
from arenas.errors import ArenaError
from arenas.physics.engine import Engine, Physics
from arenas.physics.registry import make_engine
from arenas.robots.robot import Body, Robot, Script
from arenas.rosters import check_rosters
from arenas.scene.laws import compose_laws
from arenas.scene.privileged import PrivilegedState
from arenas.scene.props import Prop
from arenas.scene.pushes import Pushes
from arenas.scene.scene import Scene, build
from arenas.state import AgentSpec, TeamSpec, Verdict


class Game(ABC):
    """A scene with teams, and the hooks of the game: all of an arena except `reset` and `step`.

    A game implements `observation_size`, `place`, `observe` and `judge`, and optionally `decide`, `alive`, `randomise`,
    `design`, `ground_height`, `exchange`, `game_scripts`, `markers` and `privileged`. The constructor calls none of
    them, so a subclass can set the attributes that they need after it.
    """

    exchangeable: bool = False
    """True if teams of equal agents can change places without changing the game. A game declares it for its class or in
    its constructor, and `league check` tests it. Otherwise equal teams count as unlike: sides are not swapped, and each
    team has a ladder of its own."""

    by_turns: bool = False
    """True if an agent that is not `alive` has not left the game, but waits for its turn."""

    def __init__(
        self,
        name: str,
        robots: Mapping[str, Sequence[Robot]],
        timing: Timing,
        rules: Mapping[str, Any],
        *,
        props: Sequence[Prop] = (),
        solver: Solver | None = None,
        derived: tuple[str, ...] = (),
        marker_kinds: Mapping[str, str] | None = None,
        **options: Unpack[EngineOptions],
    ):
        """Build the game's scene and engine.

        `robots` are the teams' rosters, one to eight. `rules` holds everything except the model that the outcome of
        a game depends on. `derived` names the fields of Physics beyond qpos and qvel that the hooks read.
        `marker_kinds` declares what is drawn with the robots: name -> "circle" (x, y, radius) on the ground, "segment"
        (x, y, z of both ends), wire "sphere" or solid "ball" (x, y, z, radius). Forces on bodies are drawn without it.
        Raises ArenaError for invalid rosters.
        """
        check_rosters(robots)
        self.name = name
        self.timing = timing
        self.robots: dict[str, Robot] = {f"{team}/{i}": r for team, rs in robots.items() for i, r in enumerate(rs)}
        self.marker_kinds: Mapping[str, str] = dict(marker_kinds or {})
        self.scene: Scene = build(robots, props, solver=solver, timestep=timing.timestep)
        identities = {agent: robot.identity for agent, robot in self.robots.items() if robot.identity}
        settings = {**rules, "robot files": identities} if identities else rules
        self.config_hash = _hash(settings, timing, self.scene.xml)
        buffers = (solver or Solver()).with_buffers(options.get("contacts"), options.get("rows"))
        self._pushes = Pushes(self.scene.model, self.robots)
        self.engine: Engine = make_engine(
            options.get("engine", "auto"), self.scene.model, derived, self._pushes.bodies,
            worlds=options.get("worlds", 1), buffers=buffers, threads=options.get("threads", 0),
        )  # fmt: skip
        self._rosters = {team: tuple(f"{team}/{i}" for i in range(len(rs))) for team, rs in robots.items()}
        self.law = compose_laws(self.scene, self.robots)

    @cached_property
    def teams(self) -> tuple[TeamSpec, ...]:
        """The teams, in the order of scores and rewards."""
        plain = [TeamSpec(team, tuple(map(self._spec, agents))) for team, agents in self._rosters.items()]
        rosters = [team.roster for team in plain]
        side_specific = [not self.exchangeable and rosters.count(roster) > 1 for roster in rosters]
        return tuple(replace(team, side_specific=unlike) for team, unlike in zip(plain, side_specific, strict=True))

    @final
    def exchange_teams(self) -> None:
        """Treat teams of equal agents as exchangeable, for leagues that were created with such an arena."""
        self.exchangeable = True
        vars(self).pop("teams", None)

    @property
    def agents(self) -> tuple[AgentSpec, ...]:
        """All agents, team by team."""
        return tuple(agent for team in self.teams for agent in team.agents)

    # Hooks of a game -------------------------------------------------------------------------------------------------

    @abstractmethod
    def observation_size(self, agent: str) -> int:
        """Return the size of the agent's observation."""

    @abstractmethod
    def place(self, key: Array) -> tuple[Array, Array, Any]:
        """Draw the start of an episode: qpos (nq,), qvel (nv,), the game's own pytree."""

    @abstractmethod
    def observe(self, physics: Physics, game: Any, actions: dict[str, Array]) -> dict[str, Array]:
        """Return each agent's observation: agent name -> (observation_size,)."""

    @abstractmethod
    def judge(self, before: Physics, physics: Physics, game: Any) -> tuple[Any, Verdict]:
        """Judge one control step, from `before` to `physics`. Return the game's pytree after it and the verdict."""

    def decide(self, game: Any, actions: dict[str, Array]) -> Any:
        """Record the agents' decisions in the game's pytree before they are executed, for games that judge actions."""
        return game

    def alive(self, physics: Physics, game: Any) -> Array:
        """Return (agents,) bool: the agents that take part in the game.

        The others neither act nor observe, and no learner learns from them. Their robots execute the `limp` action.
        `judge` must stop their rewards.
        """
        return jnp.ones(len(self.robots), bool)

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw this episode's own model fields, each shaped as the model's.

        Only fields in `arenas.physics.engine.VARIABLE` may differ between worlds.
        """
        return {}

    def design(self, physics: Physics, game: Any) -> tuple[Array, Array, dict[str, Array]] | None:
        """Return the start of the episode as the agents' first decisions set it: qpos, qvel and model fields.

        It is asked after `decide`, and counts in the first decision alone, before physics moves. The fields are those
        that `randomise` draws, or some of them; others stay as drawn. None: agents set nothing, which costs nothing.
        """
        return None

    def ground_height(self, physics: Physics, at: Array) -> Array | None:
        """Return the height () in metres of the ground at x and y (2,), from which falls of robots are measured.

        None: it is flat, at z = 0, which costs nothing.
        """
        return None

    def exchange(self, qpos: Array, qvel: Array, game: Any, order: Sequence[int] = (1, 0)) -> tuple[Array, Array, Any]:
        """Return the same situation with exchangeable teams in other places: team i in that of team `order[i]`.

        `order` is a permutation of the teams that moves only teams of equal rosters; of two teams it is always (1, 0).
        Team i then observes what team `order[i]` observed. Robots take the places of those of the same index. A game in
        which a team owns more (a block, a goal, a count) moves that too: an array by team becomes `array[order]`.
        """
        changed, moved, rosters = qpos, qvel, list(self._rosters.values())
        for mine, yours in zip(rosters, (rosters[team] for team in order), strict=True):
            for agent, other in zip(mine, yours, strict=True):
                if agent != other and agent in self.scene.agents:
                    a, b = self.scene.agents[agent], self.scene.agents[other]
                    changed = changed.at[a.own_qpos].set(qpos[b.own_qpos])
                    moved = moved.at[a.own_qvel].set(qvel[b.own_qvel])
        return changed, moved, game

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return scripted opponents that know this game: name -> robot kind -> script."""
        return {}

    def markers(self, physics: Physics, game: Any) -> dict[str, Array]:
        """Return the current markers, by the names of `marker_kinds`."""
        return {}

    @property
    def drawn_kinds(self) -> dict[str, str]:
        """Kinds of all markers in recordings: those of the game, and a "force" for each body that agents push."""
        return {**self.marker_kinds, **dict.fromkeys(self._pushes.names, "force")}

    @final
    def drawn_markers(self, physics: Physics, game: Any) -> dict[str, Array]:
        """Return the current markers, by the names of `drawn_kinds`."""
        return {**self.markers(physics, game), **self._pushes.markers(physics.push)}

    def privileged(self, physics: Physics, game: Any, actions: dict[str, Array]) -> Array:
        """Return the whole state as one vector (privileged_size,), for critics that may see more than robots do.

        It contains every body's place, attitude and velocity in the world, the agents that are in the game, the game's
        own numbers, the last actions and the remaining share of the time. A game without bodies has none, unless it
        overrides this method together with `privileged_parts`.
        """
        alive = self.alive(physics, game) if self._agents_can_leave else None
        left = 1.0 - physics.time / self.timing.episode
        return self._privileged_reader.read(physics, alive, game, actions, left)

    def privileged_parts(self) -> tuple[Part, ...]:
        """Describe the numbers of `privileged`, in their order. Empty if the arena has no privileged state."""
        if not self._privileged_reader.parts:
            return ()
        game = jax.eval_shape(lambda key: self.place(key)[2], jax.random.key(0))
        return self._privileged_reader.parts_of(
            self._agents_can_leave, game, {name: r.action_size for name, r in self.robots.items()}
        )

    # Descriptions, which `league check` compares with the game --------------------------------------------------------

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the numbers of an agent's observation, in their order. Empty if they have no names."""
        return ()

    def observation_entities(self, agent: str) -> tuple[Entities, ...]:
        """Name the sets of like things in an agent's observation, for networks that encode them as sets."""
        return ()

    def legend(self) -> Legend:
        """Describe the verdicts' terms, events and score."""
        return Legend()

    # Queries about robots ---------------------------------------------------------------------------------------------

    @final
    def body(self, agent: str, physics: Physics, actions: Mapping[str, Array]) -> Body:
        """Return an agent's robot as it senses itself."""
        at, (qpos, qvel) = self.scene.agents[agent], (physics.qpos, physics.qvel)
        base = at.pose(qpos), at.velocity(qvel)
        return Body(*base, qpos[at.joint_qpos], qvel[at.joint_qvel], actions[agent])

    @final
    def command(self, actions: Mapping[str, Array]) -> Array:
        """Combine the agents' actions into one command (nu,) to all actuators."""
        command = jnp.zeros(self.scene.model.nu)
        for agent, at in self.scene.agents.items():
            command = command.at[at.ctrl].set(self.robots[agent].command(actions[agent]))
        return command

    @final
    def push(self, actions: Mapping[str, Array]) -> Array | None:
        """Add up the forces and torques (pushed, 6) of all agents that push bodies; None if no agent does."""
        return self._pushes.total(actions)

    @final
    def fallen(self, physics: Physics) -> Array:
        """Return (agents,) bool: the agents that have fallen by the rule of their robot, above the ground below them.
        Agents without a body cannot fall.
        """
        rules = []
        for agent, robot in self.robots.items():
            if (place := self.scene.agents.get(agent)) is None:
                rules.append(jnp.zeros((), bool))
                continue
            pose = place.pose(physics.qpos)
            ground = self.ground_height(physics, pose[:2])
            rules.append(robot.fallen(pose if ground is None else pose.at[2].add(-ground)))
        return jnp.stack(rules)

    @final
    def describe_design(self, actions: Mapping[str, np.ndarray]) -> str:
        """Say what the agents' first actions (act,) set, for recordings; empty if no agent sets anything."""
        said = []
        for agent, robot in self.robots.items():
            if robot.sets:
                found = robot.name_designed(np.asarray(robot.designed(jnp.asarray(actions[agent]))))
                texts = (f"{name} {x if isinstance(x, str) else format(x, '.3g')}" for name, x in found.items())
                said.append(f"{agent} sets {', '.join(texts)}")
        return "; ".join(said)

    @cached_property
    def privileged_size(self) -> int:
        """The size of the privileged state; 0 if there is none."""
        return total_size(self.privileged_parts())

    @final
    def scripts(self) -> dict[str, dict[str, Script]]:
        """Return scripted opponents of the kinds that play here: name -> robot kind -> script. A game's replace the
        robots'.
        """
        found: dict[str, dict[str, Script]] = {}
        of_robots = [{n: {robot.kind: s} for n, s in robot.scripts.items()} for robot in self.robots.values()]
        here = {robot.kind for robot in self.robots.values()}
        for source in (*of_robots, self.game_scripts()):
            for name, kinds in source.items():
                known = {kind: script for kind, script in kinds.items() if kind in here}
                if known:
                    found.setdefault(name, {}).update(known)
        return found

    @final
    def playable_scripts(self, team: TeamSpec) -> tuple[str, ...]:
        """Return the scripts that a team can play: those that exist for every kind of robot in it."""
        return tuple(n for n, kinds in self.scripts().items() if all(a.kind in kinds for a in team.agents))

    # Inside ----------------------------------------------------------------------------------------------------------

    def _spec(self, agent: str) -> AgentSpec:
        robot = self.robots[agent]
        size = self.observation_size(agent)
        return AgentSpec(agent, robot.kind, size, robot.action_size, self.observation_entities(agent))

    @cached_property
    def _privileged_reader(self) -> PrivilegedState:
        return PrivilegedState(self.scene)

    @cached_property
    def _agents_can_leave(self) -> bool:
        """True if the game can remove agents. Other games skip the computation."""
        return type(self).alive is not Game.alive


def check_scripts(arena: Game, name: str) -> Mapping[str, Script]:
    """Return a script by name: robot kind -> script. Raises ArenaError, which lists the scripts, if unknown."""
    scripts = arena.scripts()
    if name not in scripts:
        raise ArenaError(f"arena {arena.name} has no script {name!r}; it has {', '.join(sorted(scripts)) or 'none'}")
    return scripts[name]


def _hash(rules: Mapping[str, Any], timing: Timing, xml: str) -> str:
    """Return sixteen hexadecimal digits that change with the rules, the timing, the bodies or MuJoCo's version."""
    text = json.dumps([dict(rules), vars(timing), xml, mujoco.__version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
