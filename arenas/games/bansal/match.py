"""The common part of Bansal et al.'s games: two equal bodies, two roles, the start, the dense terms.

Roles are places 0 and 1: place 0 starts at negative x and faces +x, place 1 starts at positive x and faces it. Each
episode draws which team has place 0, unless roles are fixed. Games compute by places, (2, ...) arrays whose first row
is place 0; `by_team` brings the results into the order of the teams. Exchanging the teams exchanges the bodies and the
places too, so that nothing of the situation changes but who is who.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Part
from arenas.errors import ArenaError
from arenas.games.bansal import scripts
from arenas.games.bansal.observation import ObservationBuilder
from arenas.games.bansal.settings import ContestSettings
from arenas.games.bansal.starts import facing_poses, noisy
from arenas.games.terms import weights_of
from arenas.physics.engine import Physics
from arenas.robots.anymal import anymal
from arenas.robots.files.loading import robot_of
from arenas.robots.kinds import kind_of
from arenas.robots.robot import Robot, Script
from arenas.scene.props import Prop
from arenas.state import Verdict

SPARE_CONTACTS, SPARE_ROWS = 8, 32  # of every world, besides those of the bodies' kind


class GameState(NamedTuple):
    """Numbers of an episode besides the physics, in the order of the teams; a game may have more."""

    second_first: Array  # () bool: the second team has place 0
    actions: Array  # (2, action_size) the present ones
    own: Any = ()  # the game's own, which exchanging the teams does not change


class Places(NamedTuple):
    """The bases by place."""

    xyz: Array  # (2, 3) m
    velocity: Array  # (2, 3) m/s


class Contest(Arena):
    """Two equal bodies, called `blue/0` and `red/0`, or by their roles where these are fixed."""

    def __init__(
        self,
        settings: ContestSettings,
        *,
        derived: tuple[str, ...] = (),
        props: tuple[Prop, ...] = (),
        marker_kinds: Mapping[str, str],
        more_rows: int = 0,
        **options: Unpack[EngineOptions],
    ):
        """Build the scene; `more_rows` are rows of Warp's buffers. Raises ArenaError for a body without legs."""
        file = settings.robot_file()
        robot = robot_of(file) if file else anymal()
        if not robot.feet:
            raise ArenaError(f"robot {settings.robot} has no feet: name them in its robot file, feet = [bodies]")
        kind = kind_of(settings.robot)
        solver = Solver(
            cone=settings.rules.cone,
            contacts=SPARE_CONTACTS + 2 * kind.contacts,
            rows=SPARE_ROWS + 2 * kind.rows + more_rows,
        )
        super().__init__(
            settings.name, {team: (robot,) for team in settings.teams}, settings.timing, asdict(settings.rules),
            solver=solver, derived=derived, props=props, marker_kinds=marker_kinds, **options,
        )  # fmt: skip
        self.drawn = getattr(settings.rules, "roles", "drawn") == "drawn"
        self.exchangeable = self.drawn
        self.robot: Robot = robot
        self._torque = file is not None and all(drive.control == "torque" for drive in file.drives.values())
        self.weights = weights_of(settings.reward)
        self._start_height, self._noise = settings.rules.start_height, settings.rules.noise
        self.names = tuple(self.robots)
        self.bodies_at = tuple(self.scene.agents[name] for name in self.names)
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)
        self.observation_builder = ObservationBuilder(robot, settings.sides, settings.extra)

    # Hooks of one of these games -------------------------------------------------------------------------------------

    @abstractmethod
    def draw(self, key: Array) -> tuple[Array, Any]:
        """Draw the bases' places (2, 2) m by place, and the game's own state."""

    @abstractmethod
    def extra_parts(self) -> tuple[Part, ...]:
        """Describe the numbers of the observation that only this game has."""

    @abstractmethod
    def extra(self, physics: Physics, game: GameState) -> Array:
        """Return these numbers, (2, n) by place."""

    def set_props(self, qpos: Array, own: Any) -> Array:
        """Return qpos with the game's props at their start."""
        return qpos

    # The contract ----------------------------------------------------------------------------------------------------

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation."""
        return self.observation_builder.size

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation."""
        return self.observation_builder.parts(self.extra_parts())

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Place the bodies by the game, facing each other, with noise; draw who has which place."""
        side_key, game_key, noise_key = jax.random.split(key, 3)
        second_first = jax.random.bernoulli(side_key) if self.drawn else jnp.zeros((), bool)
        xy, own = self.draw(game_key)
        poses = facing_poses(xy, self._start_height)  # (2, 7)
        joints = jnp.stack([self._rest[at.joint_qpos] for at in self.bodies_at])
        poses, joints, speeds = noisy(noise_key, poses, joints, self._noise)
        qpos, qvel = self._rest, jnp.zeros(self.scene.model.nv)
        rows = (self.by_team(each, second_first) for each in (poses, joints, speeds))
        for at, pose, angles, speed in zip(self.bodies_at, *rows, strict=True):
            qpos = qpos.at[at.qpos : at.qpos + 7].set(pose).at[at.joint_qpos].set(angles)
            qvel = qvel.at[at.qvel : at.qvel + 6].set(speed[:6]).at[at.joint_qvel].set(speed[6:])
        return self.set_props(qpos, own), qvel, GameState(second_first, jnp.zeros((2, self.robot.action_size)), own)

    def exchange(
        self, qpos: Array, qvel: Array, game: GameState, order: Sequence[int] = (1, 0)
    ) -> tuple[Array, Array, GameState]:
        """Exchange the bodies and the places of the teams."""
        qpos, qvel, _ = super().exchange(qpos, qvel, game, order)
        return qpos, qvel, game._replace(second_first=~game.second_first, actions=game.actions[::-1])

    def decide(self, game: GameState, actions: dict[str, Array]) -> GameState:
        """Store the new actions, whose size costs reward."""
        return game._replace(actions=jnp.stack([actions[name] for name in self.names]))

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observations of both."""
        left = 1.0 - physics.time / self.timing.episode
        extra = self.by_team(self.extra(physics, game), game.second_first)
        bodies = [self.body(name, physics, actions) for name in self.names]
        places = jnp.stack([game.second_first, ~game.second_first]).astype(jnp.float32)  # the place of each team
        return {
            name: self.observation_builder.observe(bodies[i], bodies[1 - i], places[i], extra[i], left)
            for i, name in enumerate(self.names)
        }

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return scripts of the body, if there are simple ones."""
        return scripts.of_body(self.robot, self._torque, self.observation_builder, self.timing.episode)

    # For judging -----------------------------------------------------------------------------------------------------

    @staticmethod
    def by_team(rows: Array, second_first: Array) -> Array:
        """Bring rows (2, ...) from the order of places into that of teams, or back."""
        return jnp.where(second_first, rows[::-1], rows)

    def places(self, physics: Physics, game: GameState) -> Places:
        """Return the bases by place."""
        xyz = jnp.stack([physics.qpos[at.qpos : at.qpos + 3] for at in self.bodies_at])
        velocity = jnp.stack([physics.qvel[at.qvel : at.qvel + 3] for at in self.bodies_at])
        return Places(self.by_team(xyz, game.second_first), self.by_team(velocity, game.second_first))

    def late(self, physics: Physics) -> Array:
        """Return () bool: time is up."""
        return physics.time > self.timing.episode - self.timing.control_interval / 2

    def common_terms(self, game: GameState, heights: Array) -> dict[str, Array]:
        """Return control and alive of a control step, (2,) by place, without their weights; `heights` (2,) m."""
        dt, actions = self.timing.control_interval, self.by_team(game.actions, game.second_first)
        return {
            "control": dt * jnp.sum(actions**2, axis=1),
            "alive": dt * jnp.where(heights > self.weights["alive_height"], 1.0, -1.0),
        }

    def verdict(
        self, game: GameState, rewards: dict[str, Array], shapings: dict[str, Array], score: Array, over: Array,
        events: dict[str, Array],
    ) -> Verdict:  # fmt: skip
        """Return the verdict from numbers (2,) by place; shapings are without their weights. An end is terminal,
        because the clock is observed.
        """
        weighted = {name: self.weights[name] * term for name, term in shapings.items()}
        terms = (rewards, weighted, {"score": score}, events)
        rewards, weighted, scores, events = jax.tree.map(lambda x: self.by_team(x, game.second_first), terms)
        return Verdict(rewards, weighted, scores["score"], over, jnp.zeros((), bool), events)
