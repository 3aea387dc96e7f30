"""The contract of every arena: two verbs, `reset` and `step`, round the hooks that a game fills in.

One world at a time: callers batch with `jax.vmap` and write `jax.lax.scan` themselves. A step is one *decision*: the
actions are held for `hold` control steps, each of `substeps` physics timesteps, and the game is judged after every
control step. What a game decided first stays: later control steps of the same decision change nothing.
"""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, TypedDict, Unpack

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.engines import Engine, EngineName, Law, Physics, make_engine
from arenas.robots.robot import Robot
from arenas.scene import Scene, build

Script = Callable[[Array, Array], Array]  # (observation (obs,), key) -> action (act,)


class ArenaError(Exception):
    """A wrong arena name, setting or contract; the message is one line for the user."""


@dataclass(frozen=True)
class AgentSpec:
    """One robot of a team: its name is its MJCF prefix, the key of its observation and its path in the viewer."""

    name: str  # e.g. blue/0
    kind: str
    observation_size: int
    action_size: int


@dataclass(frozen=True)
class TeamSpec:
    """One side of an arena: a fixed roster of agents."""

    name: str
    agents: tuple[AgentSpec, ...]

    @property
    def roster(self) -> str:
        """What a policy must fit to play this side, e.g. `leatherback:38:2+leatherback:38:2`."""
        return "+".join(f"{a.kind}:{a.observation_size}:{a.action_size}" for a in self.agents)


class Verdict(NamedTuple):
    """What a game says after a control step. *Reward* is for learning; *score* decides matches.

    `terminated`: the game is over and the future is worth nothing. `truncated`: it was cut and the future still has
    value. Where neither holds, `score` is ignored.
    """

    reward: Array  # (teams,) the outcome as a reward, summed over a decision's control steps
    shaping: Array  # (teams,) dense hints, which a learner may anneal away
    score: Array  # (teams,) 1 win, ½ draw, 0 loss
    terminated: Array  # () bool
    truncated: Array  # () bool


class State(NamedTuple):
    """One world between two decisions."""

    physics: Physics
    game: Any  # the game's own pytree
    observations: dict[str, Array]  # agent name -> (observation_size,)
    actions: dict[str, Array]  # the last ones, agent name -> (action_size,)
    verdict: Verdict
    void: Array  # () bool: physics became unstable before the game was decided; counts for nobody

    @property
    def done(self) -> Array:
        """() bool: the episode is over, for whatever reason."""
        return self.verdict.terminated | self.verdict.truncated | self.void


class Frames(NamedTuple):
    """What a recording keeps of a decision: one row per control step."""

    qpos: Array  # (hold, nq)
    time: Array  # (hold,) seconds since the start of the episode
    markers: dict[str, Array]  # name -> (hold, m), see Arena.marker_kinds


@dataclass(frozen=True)
class Timing:
    """Seconds and counts: physics timestep, timesteps per control step, control steps per decision, episode length."""

    timestep: float = 0.005
    substeps: int = 4
    hold: int = 1
    episode: float = 30.0

    @property
    def control_interval(self) -> float:
        """Seconds between two judgements of the game, and between two frames of a recording."""
        return self.timestep * self.substeps

    @property
    def decisions(self) -> int:
        """The most decisions an episode can take."""
        return int(np.ceil(self.episode / (self.control_interval * self.hold) - 1e-9))


class Where(TypedDict, total=False):
    """Where an arena runs: an engine's name, the most worlds stepped together, threads of the C engine (0: all)."""

    engine: EngineName
    worlds: int
    threads: int


class Settings(Protocol):
    """An arena's settings: a frozen dataclass of plain values that can build it."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str:
        """The arena's name, e.g. `sumo-2v2`."""
        ...

    def build(self, **where: Unpack[Where]) -> "Arena":
        """The arena itself."""
        ...


class Arena(ABC):
    """A game with physics. Subclasses fill `place`, `observe` and `judge`; `reset` and `step` are final."""

    derived: ClassVar[tuple[str, ...]] = ()  # fields of Physics beyond qpos and qvel that the hooks read
    law: Law | None = None  # actuation law, run before every substep
    marker_kinds: ClassVar[Mapping[str, str]] = {}  # drawn with the robots: name -> "circle" (x, y, radius)
    contacts: int = 24  # Warp's contact slots per world
    rows: int = 128  # Warp's constraint rows per world

    def __init__(
        self,
        name: str,
        robots: Mapping[str, tuple[Robot, ...]],
        timing: Timing,
        rules: Mapping[str, Any],
        **where: Unpack[Where],
    ):
        """`robots` are the teams' rosters; `rules` is all that the outcome of a game depends on beside the model."""
        self.name = name
        self.timing = timing
        self.robots = {f"{team}/{i}": r for team, rs in robots.items() for i, r in enumerate(rs)}
        self.scene: Scene = build(robots, timestep=timing.timestep)
        self.teams = tuple(
            TeamSpec(
                team,
                tuple(
                    AgentSpec(f"{team}/{i}", r.kind, self.observation_size(f"{team}/{i}"), r.action_size)
                    for i, r in enumerate(rs)
                ),
            )
            for team, rs in robots.items()
        )
        self.config_hash = _hash(rules, timing, self.scene.xml)
        self.engine: Engine = make_engine(
            where.get("engine", "auto"), self.scene.model, self.derived, worlds=where.get("worlds", 1),
            contacts=self.contacts, rows=self.rows, threads=where.get("threads", 0),
        )  # fmt: skip

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

    def scripts(self) -> dict[str, Script]:
        """Scripted opponents that any agent can play, by name."""
        return {}

    def markers(self, physics: Physics, game: Any) -> dict[str, Array]:
        """What to draw beside the robots now, by the names of `marker_kinds`."""
        return {}

    # The two verbs ---------------------------------------------------------------------------------------------------

    def reset(self, key: Array) -> State:
        """A fresh world."""
        qpos, qvel, game = self.place(key)
        return self._begin(self.engine.make(qpos, qvel), game)

    def restart(self, state: State, key: Array, where: Array) -> State:
        """The same world, begun anew where `where` () bool; elsewhere it stays as it is."""
        qpos, qvel, game = self.place(key)
        fresh = self._begin(self.engine.place(state.physics, qpos, qvel, where), game)
        # place() already chose world by world; to compare engines' own buffers again would cost and gain nothing.
        chosen = jax.tree.map(
            lambda new, old: jnp.where(where, new, old), fresh._replace(physics=()), state._replace(physics=())
        )
        return chosen._replace(physics=fresh.physics)

    def step(self, state: State, actions: dict[str, Array]) -> State:
        """One decision. Stepping a world that is done goes on simulating but changes no verdict."""
        return self.step_with_frames(state, actions)[0]

    def step_with_frames(self, state: State, actions: dict[str, Array]) -> tuple[State, Frames]:
        """`step`, with what a recording keeps."""
        command = self._command(actions)
        none = self._undecided()
        first = state.verdict._replace(reward=none.reward, shaping=none.shaping)

        def control_step(carry: tuple[Physics, Any, Verdict, Array], _: None) -> tuple[Any, Frames]:
            before, game, verdict, void = carry
            physics = self.engine.step(before, command, self.timing.substeps, self.law)
            decided = verdict.terminated | verdict.truncated | void
            game_after, news = self.judge(before, physics, game)
            verdict = _merge(verdict, news, decided | physics.unstable)
            void = void | (physics.unstable & ~decided)
            game = jax.tree.map(lambda old, new: jnp.where(decided, old, new), game, game_after)
            frames = Frames(physics.qpos, physics.time, self.markers(physics, game))
            return (physics, game, verdict, void), frames

        carry = (state.physics, state.game, first, state.void)
        (physics, game, verdict, void), frames = jax.lax.scan(control_step, carry, length=self.timing.hold)
        observations = _finite(self.observe(physics, game, actions))
        return State(physics, game, observations, actions, verdict, void), frames

    # Inside ----------------------------------------------------------------------------------------------------------

    def _begin(self, physics: Physics, game: Any) -> State:
        actions = {a.name: jnp.zeros(a.action_size) for a in self.agents}
        observations = _finite(self.observe(physics, game, actions))
        return State(physics, game, observations, actions, self._undecided(), jnp.zeros((), bool))

    def _undecided(self) -> Verdict:
        zeros, no = jnp.zeros(len(self.teams)), jnp.zeros((), bool)
        return Verdict(zeros, zeros, zeros, no, no)

    def _command(self, actions: dict[str, Array]) -> Array:
        command = jnp.zeros(self.scene.model.nu)
        for agent, robot in self.robots.items():
            command = command.at[self.scene.agents[agent].ctrl].set(robot.command(actions[agent]))
        return command


def check_scripts(arena: Arena, name: str) -> Script:
    """A scripted opponent by name; an unknown one is an ArenaError that lists what exists."""
    scripts = arena.scripts()
    if name not in scripts:
        raise ArenaError(f"arena {arena.name} has no script {name!r}; it has {', '.join(sorted(scripts)) or 'none'}")
    return scripts[name]


def up_z(quat: Array) -> Array:
    """World z of the body's up axis from its quaternion (4,) w first: 1 upright, -1 on its back."""
    return 1.0 - 2.0 * (quat[1] ** 2 + quat[2] ** 2)


def yaw(quat: Array) -> Array:
    """Heading in radians from a quaternion (4,), w first."""
    w, x, y, z = quat
    return jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _merge(verdict: Verdict, news: Verdict, frozen: Array) -> Verdict:
    """Add rewards and take the outcome of a control step, unless the game was `frozen` before it."""
    over = news.terminated | news.truncated
    return Verdict(
        reward=verdict.reward + jnp.where(frozen, 0.0, news.reward),
        shaping=verdict.shaping + jnp.where(frozen, 0.0, news.shaping),
        score=jnp.where(frozen | ~over, verdict.score, news.score),
        terminated=verdict.terminated | (news.terminated & ~frozen),
        truncated=verdict.truncated | (news.truncated & ~frozen),
    )


def _finite(observations: dict[str, Array]) -> dict[str, Array]:
    """Bad numbers of an unstable world must not reach a network: NaN and infinities become 0, the rest is bounded."""
    return {k: jnp.clip(jnp.nan_to_num(v, nan=0.0, posinf=0.0, neginf=0.0), -1e6, 1e6) for k, v in observations.items()}


def _hash(rules: Mapping[str, Any], timing: Timing, xml: str) -> str:
    """Sixteen hexadecimal digits that change with the rules, the timing, the bodies or MuJoCo's version."""
    text = json.dumps([dict(rules), vars(timing), xml, mujoco.__version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
