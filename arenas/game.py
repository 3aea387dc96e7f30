"""What a game is made of: its robots in a scene, the hooks that it fills in, and what it may ask about its robots."""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Unpack, final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.about import Legend, Part, numbers
from arenas.engines import make_engine
from arenas.errors import ArenaError
from arenas.options import Solver, Timing, Where
from arenas.physics import Engine, Law, Physics
from arenas.privileged import Bodies
from arenas.props import Prop
from arenas.robots.robot import Body, Robot, Script
from arenas.rosters import check_rosters
from arenas.scene import Scene, build
from arenas.state import AgentSpec, TeamSpec, Verdict


class Game(ABC):
    """A scene with teams, and the hooks of what is played there: all of an arena but its verbs.

    A game fills in `observation_size`, `place`, `observe` and `judge`, and `decide`, `alive`, `randomise`, `exchange`,
    `game_scripts`, `markers` and `privileged` if it has such. The constructor calls none of them: what they need can be
    set after it.
    """

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
        **where: Unpack[Where],
    ):
        """A game in a scene of its own.

        `robots` are the teams' rosters, one team or more. `rules` is all that the outcome of a game depends on beside
        the model. `derived` are the fields of Physics beyond qpos and qvel that the hooks read, `marker_kinds` what
        is drawn with the robots: name -> "circle" (x, y, radius) on the ground, "segment" (x, y, z of both ends),
        "sphere" of wire or solid "ball" (x, y, z, radius). Raises ArenaError for rosters that cannot be.
        """
        check_rosters(robots)
        self.name = name
        self.timing = timing
        self.robots: dict[str, Robot] = {f"{team}/{i}": r for team, rs in robots.items() for i, r in enumerate(rs)}
        self.marker_kinds: Mapping[str, str] = dict(marker_kinds or {})
        self.scene: Scene = build(robots, props, solver=solver, timestep=timing.timestep)
        self.config_hash = _hash(rules, timing, self.scene.xml)
        buffers = solver or Solver()
        self.engine: Engine = make_engine(
            where.get("engine", "auto"), self.scene.model, derived, worlds=where.get("worlds", 1),
            contacts=buffers.contacts, rows=buffers.rows, threads=where.get("threads", 0),
        )  # fmt: skip
        self._rosters = {team: tuple(f"{team}/{i}" for i in range(len(rs))) for team, rs in robots.items()}
        self.law = _composed(self.scene, self.robots)

    @cached_property
    def teams(self) -> tuple[TeamSpec, ...]:
        """The sides, in the order of scores and rewards."""
        return tuple(TeamSpec(team, tuple(map(self._spec, agents))) for team, agents in self._rosters.items())

    @property
    def agents(self) -> tuple[AgentSpec, ...]:
        """All agents, team by team."""
        return tuple(agent for team in self.teams for agent in team.agents)

    # Hooks of a game -------------------------------------------------------------------------------------------------

    @abstractmethod
    def observation_size(self, agent: str) -> int:
        """Numbers in the agent's observation."""

    @abstractmethod
    def place(self, key: Array) -> tuple[Array, Array, Any]:
        """Draw the start of an episode: qpos (nq,), qvel (nv,), the game's own pytree."""

    @abstractmethod
    def observe(self, physics: Physics, game: Any, actions: dict[str, Array]) -> dict[str, Array]:
        """What each agent sees: agent name -> (observation_size,)."""

    @abstractmethod
    def judge(self, before: Physics, physics: Physics, game: Any) -> tuple[Any, Verdict]:
        """Judge one control step, from `before` to `physics`: the game's pytree after it, and the verdict."""

    def decide(self, game: Any, actions: dict[str, Array]) -> Any:
        """Note in the game's pytree what the agents decided, before it is carried out; for games that judge actions."""
        return game

    def alive(self, physics: Physics, game: Any) -> Array:
        """(agents,) bool: who takes part in the game. Who is out of it neither acts nor sees, and teaches no learner.

        Its robot goes on as its `limp` action has it. That it earns nothing any more is for `judge` to see to.
        """
        return jnp.ones(len(self.robots), bool)

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw this episode's own model fields, of those in `arenas.physics.VARIABLE`, each shaped as the model's."""
        return {}

    def exchange(self, qpos: Array, qvel: Array, game: Any) -> tuple[Array, Array, Any]:
        """The same situation with two equal teams in each other's places: what one saw the other sees now.

        Robots change places with those of their number; a game in which a team has more of its own (a block, a goal)
        exchanges that too.
        """
        changed, moved = qpos, qvel
        for mine, yours in zip(*self._rosters.values(), strict=True):
            if mine in self.scene.agents:
                one, other = self.scene.agents[mine], self.scene.agents[yours]
                for a, b in ((one, other), (other, one)):
                    changed = changed.at[a.own_qpos].set(qpos[b.own_qpos])
                    moved = moved.at[a.own_qvel].set(qvel[b.own_qvel])
        return changed, moved, game

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Scripted opponents that know this game: name -> robot kind -> script."""
        return {}

    def markers(self, physics: Physics, game: Any) -> dict[str, Array]:
        """What to draw beside the robots now, by the names of `marker_kinds`."""
        return {}

    def privileged(self, physics: Physics, game: Any, actions: dict[str, Array]) -> Array:
        """The whole state as one vector (privileged_size,), for critics that may see what no robot sees.

        Every body's place, attitude and velocity in the world, who is in the game, the game's own numbers, the last
        actions and the share of the time that is left. A game without bodies has none, unless it overrides this
        together with `privileged_parts`.
        """
        alive = self.alive(physics, game) if self._mortal else None
        left = 1.0 - physics.time / self.timing.episode
        return self._bodies.everything(physics, alive, game, actions, left)

    def privileged_parts(self) -> tuple[Part, ...]:
        """What the numbers of `privileged` are, in their order: so many there are. Nothing: the arena has no such."""
        if not self._bodies.parts:
            return ()
        game = jax.eval_shape(lambda key: self.place(key)[2], jax.random.key(0))
        return self._bodies.everything_told(
            self._mortal, game, {name: r.action_size for name, r in self.robots.items()}
        )

    # What a game says about itself; `league check` holds it against what it does --------------------------------------

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """What the numbers of an agent's observation are, in their order; nothing: they have no names."""
        return ()

    def legend(self) -> Legend:
        """What the verdicts' terms, events and score mean."""
        return Legend()

    # What games ask about their robots -------------------------------------------------------------------------------

    @final
    def body(self, agent: str, physics: Physics, actions: Mapping[str, Array]) -> Body:
        """An agent's robot as it feels itself."""
        at, (qpos, qvel) = self.scene.agents[agent], (physics.qpos, physics.qvel)
        base = qpos[at.qpos : at.qpos + 7], qvel[at.qvel : at.qvel + 6]
        return Body(*base, qpos[at.joint_qpos], qvel[at.joint_qvel], actions[agent])

    @final
    def command(self, actions: Mapping[str, Array]) -> Array:
        """The agents' actions as one command (nu,) to all actuators."""
        command = jnp.zeros(self.scene.model.nu)
        for agent, at in self.scene.agents.items():
            command = command.at[at.ctrl].set(self.robots[agent].command(actions[agent]))
        return command

    @final
    def fallen(self, physics: Physics) -> Array:
        """(agents,) bool: who has fallen, by the rule of its robot; who has no body cannot."""
        rules = [
            self.robots[agent].fallen(physics.qpos[at.qpos : at.qpos + 7]) if at else jnp.zeros((), bool)
            for agent, at in ((agent, self.scene.agents.get(agent)) for agent in self.robots)
        ]
        return jnp.stack(rules)

    @cached_property
    def privileged_size(self) -> int:
        """Numbers in the whole state as critics may see it; 0: there is none to see."""
        return numbers(self.privileged_parts())

    @final
    def scripts(self) -> dict[str, dict[str, Script]]:
        """Scripted opponents: name -> robot kind -> script, of kinds that play here; the robots' before the game's."""
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
    def playable(self, team: TeamSpec) -> tuple[str, ...]:
        """The scripts that a team can play: those known to every kind of robot in it."""
        return tuple(n for n, kinds in self.scripts().items() if all(a.kind in kinds for a in team.agents))

    # Inside ----------------------------------------------------------------------------------------------------------

    def _spec(self, agent: str) -> AgentSpec:
        robot = self.robots[agent]
        return AgentSpec(agent, robot.kind, self.observation_size(agent), robot.action_size)

    @cached_property
    def _bodies(self) -> Bodies:
        return Bodies(self.scene)

    @cached_property
    def _mortal(self) -> bool:
        """Whether the game ever says that somebody is out of it; the others pay nothing for the question."""
        return type(self).alive is not Game.alive


def check_scripts(arena: Game, name: str) -> Mapping[str, Script]:
    """A scripted opponent by name: robot kind -> script. An unknown one is an ArenaError that lists what exists."""
    scripts = arena.scripts()
    if name not in scripts:
        raise ArenaError(f"arena {arena.name} has no script {name!r}; it has {', '.join(sorted(scripts)) or 'none'}")
    return scripts[name]


def _hash(rules: Mapping[str, Any], timing: Timing, xml: str) -> str:
    """Sixteen hexadecimal digits that change with the rules, the timing, the bodies or MuJoCo's version."""
    text = json.dumps([dict(rules), vars(timing), xml, mujoco.__version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _composed(scene: Scene, robots: Mapping[str, Robot]) -> Law | None:
    """The robots' laws, each over its own joints and actuators, as one; None if none has any."""
    laws = [(scene.agents[agent], robot.law) for agent, robot in robots.items() if robot.law]
    if not laws:
        return None
    driven = np.concatenate([at.ctrl for at, _ in laws])
    plain = np.setdiff1d(np.arange(scene.model.nu), driven)
    place = np.argsort(np.concatenate([driven, plain]))

    def law(qpos: Any, qvel: Any, command: Any) -> Any:
        ctrl = [own(qpos[..., at.joint_qpos], qvel[..., at.joint_qvel], command[..., at.ctrl]) for at, own in laws]
        arrays = command.__array_namespace__()  # jax.numpy, or numpy in the C engine
        return arrays.concat([*ctrl, command[..., plain]], axis=-1)[..., place]

    return law
