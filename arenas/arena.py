"""The contract of every arena: two verbs, `reset` and `step`, round the hooks that a game fills in.

One world at a time: callers batch with `jax.vmap` and write `jax.lax.scan` themselves. A step is one *decision*: the
actions are held for `hold` control steps, each of `substeps` physics timesteps, and the game is judged after every
control step. What a game decided first stays: later control steps of the same decision change nothing.
"""

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
from arenas.physics import Engine, Law, Moved, Physics, sound, stackable
from arenas.privileged import Bodies
from arenas.props import Prop
from arenas.robots.robot import Body, Robot, Script
from arenas.rosters import check_rosters
from arenas.scene import Scene, build
from arenas.starts import drawn
from arenas.state import AgentSpec, Frames, State, TeamSpec, Verdict, begun, counted, finite, merged, undecided

MODEL_FIELDS = 0x6D6F6465  # folded into an episode's key for its model fields, far from what games split off it


class Arena(ABC):
    """A game, with physics where its robots have bodies.

    A game fills in `observation_size`, `place`, `observe` and `judge`, and `decide`, `alive`, `randomise`, `exchange`,
    `game_scripts`, `markers` and `privileged` if it has such. The constructor calls none of them: what they need can be
    set after it.
    """

    def __init_subclass__(cls) -> None:
        """Raise ArenaError for a game that by chance has a function of the name of one of the contract's own."""
        own = {name for name in vars(Arena) if name.startswith("_") and not name.startswith(("__", "_abc_"))}
        for name in sorted(own & set(vars(cls))):
            raise ArenaError(f"{cls.__name__}.{name}: every arena has something of this name: choose another")

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
        self.law = self._compose_laws()

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
    def whole(self, state: State) -> Array:
        """What `privileged` says of a world (privileged_size,), with no number that a network must not see."""
        told = finite({"whole": self.privileged(state.physics, state.game, state.actions)})
        return stackable(told["whole"])[0]

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

    # The verbs -------------------------------------------------------------------------------------------------------

    @final
    def reset(self, key: Array) -> State:
        """A fresh world."""
        qpos, qvel, game, fields = self._draw(key)
        return self._begin(self.engine.make(qpos, qvel, fields), game)

    @final
    def restart(self, state: State, key: Array, where: Array) -> State:
        """The same world, begun anew where `where` () bool; elsewhere it stays as it is."""
        qpos, qvel, game, fields = drawn(self._draw, key, where)
        fresh = self._begin(self.engine.place(state.physics, qpos, qvel, where, fields), game)
        # place() already chose world by world; to compare engines' own buffers again would cost and gain nothing.
        chosen = jax.tree.map(
            lambda new, old: jnp.where(where, new, old), fresh._replace(physics=()), state._replace(physics=())
        )
        return chosen._replace(physics=fresh.physics)

    @final
    def step(self, state: State, actions: dict[str, Array]) -> State:
        """One decision. Stepping a world that is done goes on simulating but changes no verdict."""
        return self.step_with_frames(state, actions)[0]

    @final
    def step_with_frames(self, state: State, actions: dict[str, Array]) -> tuple[State, Frames]:
        """`step`, with what a recording keeps. An action that is not finite makes an undecided world void."""
        actions = self._of_the_living(actions, state.alive)
        whole = self.command(actions)
        wild = self._wild(actions)

        def control_step(carry: tuple[Physics, Any, Verdict, Array, Array], moved: Moved | None) -> tuple[Any, Frames]:
            before, game, verdict, void, culprits = carry
            command = self.command(self._of_the_living(actions, self.alive(before, game))) if self._mortal else whole
            physics = self.engine.step(before, command, self.timing.substeps, self.law, moved)
            decided = verdict.terminated | verdict.truncated | void
            game_after, news = self.judge(before, physics, game)
            broken = ~decided & (physics.unstable | wild.any())
            news = counted(news, ~(decided | broken))
            culprits = jnp.where(broken, self._culprits(physics, wild), culprits)
            game = jax.tree.map(lambda old, new: jnp.where(decided, old, new), game, game_after)
            (qpos,) = stackable(physics.qpos)
            frames = Frames(qpos, physics.time, self.markers(physics, game), news.rewards, news.shapings, news.events)
            return (physics, game, merged(verdict, news), void | broken, culprits), frames

        first = begun(state.verdict)
        game = jax.tree.map(
            lambda old, new: jnp.where(state.done, old, new), state.game, self.decide(state.game, actions)
        )
        carry = (state.physics, game, first, state.void, state.culprits)
        carry, frames = jax.lax.scan(control_step, carry, self._ahead(state.physics, whole), self.timing.hold)
        physics, game, verdict, void, culprits = carry
        alive, observations = self._look(physics, game, actions)
        return State(physics, game, observations, actions, verdict, void, culprits, alive), frames

    @final
    def save(self, state: State) -> dict[str, Array]:
        """All that decides how this world goes on, as named arrays; batch with `jax.vmap`."""
        leaves = jax.tree_util.tree_leaves_with_path(self._neutral(state))
        return {_path(path): _data(leaf) for path, leaf in leaves}

    @final
    def load(self, saved: Mapping[str, Array]) -> State:
        """The world of `save`: on the same engine it goes on bit for bit."""
        example = jax.eval_shape(lambda key: self._neutral(self.reset(key)), jax.random.key(0))
        leaves, structure = jax.tree_util.tree_flatten_with_path(example)
        missing = {_path(path) for path, _ in leaves} ^ set(saved)
        if missing:
            raise ArenaError(f"these are no worlds of {self.name}: {', '.join(sorted(missing))} missing or unknown")
        state = jax.tree.unflatten(structure, [_typed(saved[_path(path)], leaf) for path, leaf in leaves])
        return state._replace(physics=self.engine.load(state.physics))

    # Inside ----------------------------------------------------------------------------------------------------------

    def _spec(self, agent: str) -> AgentSpec:
        robot = self.robots[agent]
        return AgentSpec(agent, robot.kind, self.observation_size(agent), robot.action_size)

    def _draw(self, key: Array) -> tuple[Array, Array, Any, dict[str, Array]]:
        """The start of an episode, as `place` and `randomise` draw it."""
        return *self.place(key), self.randomise(jax.random.fold_in(key, MODEL_FIELDS))

    def _begin(self, physics: Physics, game: Any) -> State:
        actions = {a.name: jnp.zeros(a.action_size) for a in self.agents}
        alive, observations = self._look(physics, game, actions)
        bare = physics._replace(carry=())
        verdict = undecided(jax.eval_shape(self.judge, bare, bare, game)[1])
        teams = jnp.zeros(len(self.teams), bool)
        return State(physics, game, observations, actions, verdict, jnp.zeros((), bool), teams, alive)

    @cached_property
    def _bodies(self) -> Bodies:
        return Bodies(self.scene)

    @cached_property
    def _mortal(self) -> bool:
        """Whether the game ever says that somebody is out of it; the others pay nothing for the question."""
        return type(self).alive is not Arena.alive

    def _ahead(self, physics: Physics, command: Array) -> Moved | None:
        """All control steps of a decision, stacked, where the engine can make them before the game judges the first.

        Where somebody may drop out of the game between two of them, its command changes with that.
        """
        if self._mortal:
            return None
        return self.engine.ahead(physics, command, self.timing.substeps, self.law, self.timing.hold)

    def _of_the_living(self, actions: dict[str, Array], alive: Array) -> dict[str, Array]:
        """The actions (act,) that are carried out where `alive` (agents,) bool."""
        if not self._mortal:
            return actions
        limp = {a: jnp.array(robot.limp or [0.0] * robot.action_size) for a, robot in self.robots.items()}
        return {a: jnp.where(on, actions[a], limp[a]) for a, on in zip(self.robots, alive, strict=True)}

    def _look(self, physics: Physics, game: Any, actions: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Who is alive (agents,) bool, and what each agent sees of it: zeros for who is not."""
        alive, seen = self.alive(physics, game), finite(self.observe(physics, game, actions))
        if not self._mortal:
            return alive, seen
        return alive, {a: jnp.where(on, seen[a], 0.0) for a, on in zip(self.robots, alive, strict=True)}

    def _neutral(self, state: State) -> State:
        """The state with what its engine saves of it in place of the engine's own."""
        return state._replace(physics=self.engine.save(state.physics))

    def _compose_laws(self) -> Law | None:
        """The robots' laws, each over its own joints and actuators, as one; None if none has any."""
        laws = [(self.scene.agents[agent], robot.law) for agent, robot in self.robots.items() if robot.law]
        if not laws:
            return None
        driven = np.concatenate([at.ctrl for at, _ in laws])
        plain = np.setdiff1d(np.arange(self.scene.model.nu), driven)
        place = np.argsort(np.concatenate([driven, plain]))

        def law(qpos: Any, qvel: Any, command: Any) -> Any:
            ctrl = [own(qpos[..., at.joint_qpos], qvel[..., at.joint_qvel], command[..., at.ctrl]) for at, own in laws]
            arrays = command.__array_namespace__()  # jax.numpy, or numpy in the C engine
            return arrays.concat([*ctrl, command[..., plain]], axis=-1)[..., place]

        return law

    def _wild(self, actions: dict[str, Array]) -> Array:
        """(teams,) bool: who acts with numbers that are not finite."""
        return jnp.stack([
            jnp.stack([~jnp.all(jnp.isfinite(actions[agent])) for agent in agents]).any()
            for agents in self._rosters.values()
        ])  # fmt: skip

    def _culprits(self, physics: Physics, wild: Array) -> Array:
        """(teams,) bool: who brought bad numbers into a world that is void from now on.

        Wild actions tell it. Else the numbers of the robots do, as long as they spread to one team alone; a contact
        buffer that overflows tells nothing.
        """
        bad = jnp.stack([
            ~jnp.stack([self._sound(agent, physics) for agent in agents]).all() for agents in self._rosters.values()
        ])  # fmt: skip
        alone = bad if len(self._rosters) == 1 else bad & ~bad.all()
        return jnp.where(wild.any(), wild, alone)

    def _sound(self, agent: str, physics: Physics) -> Array:
        at = self.scene.agents.get(agent)
        return sound(physics.qpos[at.own_qpos], physics.qvel[at.own_qvel]) if at else jnp.ones((), bool)


def check_scripts(arena: Arena, name: str) -> Mapping[str, Script]:
    """A scripted opponent by name: robot kind -> script. An unknown one is an ArenaError that lists what exists."""
    scripts = arena.scripts()
    if name not in scripts:
        raise ArenaError(f"arena {arena.name} has no script {name!r}; it has {', '.join(sorted(scripts)) or 'none'}")
    return scripts[name]


def _hash(rules: Mapping[str, Any], timing: Timing, xml: str) -> str:
    """Sixteen hexadecimal digits that change with the rules, the timing, the bodies or MuJoCo's version."""
    text = json.dumps([dict(rules), vars(timing), xml, mujoco.__version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _path(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")


def _data(leaf: Array) -> Array:
    """A leaf as plain numbers: of a random key those that it is made of."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def _typed(values: Array, like: jax.ShapeDtypeStruct) -> Array:
    """Saved numbers as what they were."""
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(values)
    return jnp.asarray(values, like.dtype)
