"""The pitch: construction of walls, goals, ball and robots, start places, and facts about the ball."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena_settings import Solver
from arenas.games.soccer.observation import Ball
from arenas.games.soccer.rules import WALL, WALL_HEIGHT, PitchRules
from arenas.physics.engine import Physics
from arenas.robots.anymal import anymal
from arenas.robots.files.loading import file_robot
from arenas.robots.kinds import kind_of
from arenas.robots.leatherback import MAX_STEERING, leatherback
from arenas.robots.robot import Robot
from arenas.scene import props
from arenas.scene.colours import TEAM_COLOURS
from arenas.scene.props import Prop
from arenas.scene.scene import Scene
from arenas.scene.starts import place_apart, upright_poses

STEERING_UNCLAMPED = 10.0  # rad
KICK = 0.15  # m/s: a larger change of speed in a control step is a push, since the ground alone takes 0.1
NEAR = 0.05  # m beyond a robot's circle within which it may still have touched the ball
GOAL_ALPHA = 0.6
HORIZON = 2.0  # s within which a ball that rolls at a goal counts as a shot


def build_props(rules: PitchRules) -> list[Prop]:
    """Make the ball, four walls and two goals; a goal has the colour of its defenders."""
    (length, width), (deep, wide), thick = rules.pitch, rules.goal, WALL / 2
    tall = WALL_HEIGHT / 2
    walls = {
        "north": ((0.0, width / 2, tall), (length / 2, thick, tall)),
        "south": ((0.0, -width / 2, tall), (length / 2, thick, tall)),
        "east": ((length / 2, 0.0, tall), (thick, width / 2, tall)),
        "west": ((-length / 2, 0.0, tall), (thick, width / 2, tall)),
    }
    goals = {"goal-blue": (-rules.goal_at, TEAM_COLOURS[0]), "goal-red": (rules.goal_at, TEAM_COLOURS[1])}
    ball = rules.ball
    return [
        props.ball(
            radius=ball.radius, mass=ball.mass, friction=ball.friction, restitution=ball.restitution, hollow=True
        ),
        *(props.wall(f"wall-{side}", at=at, half=half) for side, (at, half) in walls.items()),
        *(
            props.goal(name, at=(x, 0.0, 0.005), half=(deep / 2, wide / 2, 0.005), colour=(*colour[:3], GOAL_ALPHA))
            for name, (x, colour) in goals.items()
        ),
    ]


def robot(kind: str, rules: PitchRules) -> Robot:
    """Make a robot with the drive of these rules."""
    if kind == "anymal":
        return anymal(rules.fall_height, rules.fall_up)
    if kind != "leatherback":
        return file_robot(kind)
    defects = rules.defects
    return leatherback(
        rules.drive_scale, rules.steer_scale, limit=None,
        wheel_limit=None if defects.throttle_unclamped else rules.wheel_limit,
        steer_limit=STEERING_UNCLAMPED if defects.steering_unclamped else MAX_STEERING,
    )  # fmt: skip


def solver(kinds: Sequence[str]) -> Solver:
    """Return a solver with contacts of all robots, the ball and the walls. The cone is elliptic: see
    `docs/arenas/soccer.md`.

    A contact has three rows, one of the ball's six. Two ANYmals and two rovers, untrained and crowded, need 39 slots
    for pairs of near geoms, and at most 21 contacts and 72 rows were seen in a world (`benchmarks/buffers.py`).
    """
    contacts, rows = 6 + sum(kind_of(kind).contacts for kind in kinds), 12 + 3 * (6 + 8 * len(kinds))
    return Solver(ls_iterations=50, cone="elliptic", contacts=contacts, rows=rows)


class Pitch:
    """Ball and robots of one scene by index: blue's robots, then red's."""

    def __init__(
        self, scene: Scene, robots: Mapping[str, Robot], kinds: Sequence[str], rules: PitchRules,
        dropped: Mapping[str, float],
    ):  # fmt: skip
        """Index the scene. `kinds` are the robots' names in the settings; `dropped` are start heights in metres by
        kind, other kinds stand on the ground.
        """
        self.rules = rules
        at, place = scene.props["ball"].qpos, scene.props["ball"].qvel
        assert at is not None
        assert place is not None
        self.ball_qpos, self.ball_qvel = at, place
        self._bases = np.array([scene.agents[name].qpos for name in robots])
        self._rest = jnp.asarray(scene.rest, jnp.float32)
        self._speeds = scene.model.nv
        self._heights = jnp.array([dropped.get(each.kind, each.rest_height) for each in robots.values()])
        self._reach = jnp.array([kind_of(kind).hull / 2 for kind in kinds]) + rules.ball.radius + NEAR
        self.clear = rules.clear(kinds)

    # Start -----------------------------------------------------------------------------------------------------------

    def start(self, key: Array, place: Callable[[Array], Array] | None = None) -> tuple[Array, Array]:
        """Return qpos and qvel with all at rest, robots and ball on the lattice or at the places `place` (key).

        `place` returns (robots + 1, 2) m, the ball last.
        """
        where, turn = jax.random.split(key)
        xy = self.lattice(where) if place is None else place(where)
        heading = jax.random.uniform(turn, (len(xy) - 1,), maxval=2 * jnp.pi)
        if self.rules.heading == "fixed":
            heading = jnp.full(len(xy) - 1, jnp.pi)
        qpos = self._rest.at[self._bases[:, None] + np.arange(7)].set(upright_poses(xy[:-1], heading, self._heights))
        qpos = qpos.at[self.ball_qpos : self.ball_qpos + 2].set(xy[-1])
        return qpos, jnp.zeros(self._speeds)

    def lattice(self, key: Array) -> Array:
        """Draw places (robots + 1, 2) m on the lattice, the ball last, without overlap in any heading."""
        points = jnp.array(self.rules.lattice)
        return place_apart(key, points, jnp.ones(len(points), bool), self.clear)

    # Facts -----------------------------------------------------------------------------------------------------------

    def ball(self, physics: Physics) -> Ball:
        """Return the ball's position and velocity."""
        at, speed = self.ball_qpos, self.ball_qvel
        return Ball(physics.qpos[at : at + 3], physics.qvel[speed : speed + 3])

    def robots(self, physics: Physics) -> Array:
        """Return the positions of the bases, (robots, 3) m."""
        return physics.qpos[self._bases[:, None] + np.arange(3)]

    def to_ball(self, physics: Physics) -> Array:
        """Return metres from each robot's base to the ball, (robots,)."""
        return length(self.robots(physics) - self.ball(physics).position)

    def to_goal(self, physics: Physics, side: Array) -> Array:
        """Return metres along the ground from the ball to the middle of the goal at +x (`side` 1) or -x (-1)."""
        goal = jnp.stack([side * self.rules.goal_at, jnp.zeros_like(side)], axis=-1)
        return length(goal - self.ball(physics).position[:2])

    def scored(self, physics: Physics, side: Array) -> Array:
        """Return bool, shaped as `side`: the ball's middle is over the goal on that side (1 at +x, -1 at -x), at any
        height.
        """
        x, y, _ = self.ball(physics).position
        return self._over(side * x, y)

    def over_goal(self, xy: Array) -> Array:
        """Return (n,) bool: points (n, 2) over one of the two goals."""
        return self._over(jnp.abs(xy[:, 0]), xy[:, 1])

    def _over(self, x: Array, y: Array) -> Array:
        deep, wide = self.rules.goal
        return (jnp.abs(x - self.rules.goal_at) <= deep / 2) & (jnp.abs(y) <= wide / 2)

    def shot(self, physics: Physics, side: Array) -> Array:
        """Return bool, shaped as `side`: the ball would roll into the goal on that side within two seconds, if left
        alone.
        """
        ball, (deep, wide) = self.ball(physics), self.rules.goal
        ahead = self.rules.goal_at - deep / 2 - side * ball.position[0]  # m to the goal's front
        speed = jnp.maximum(side * ball.velocity[0], 1e-3)
        time = ahead / speed
        y = ball.position[1] + time * ball.velocity[1]
        # A ball that slows down gets as far as v²/2a.
        gets = length(ball.velocity[:2]) * speed / (2 * max(self.rules.ball.roll_loss, 1e-3))
        return (ahead > 0) & (time < HORIZON) & (ahead < gets) & (jnp.abs(y) < wide / 2)

    def touched(self, before: Physics, physics: Physics) -> Array:
        """Return (robots,) bool: robots that pushed the ball in this control step.

        The ball's speed along the ground changed more than the ground's friction can change it, and the robot is near
        enough to touch it. If two robots are near enough, both count; a wall beside a robot may be mistaken for the
        robot.
        """
        was, now = self.ball(before), self.ball(physics)
        pushed = length(now.velocity[:2] - was.velocity[:2]) > KICK
        gap = length(self.robots(physics)[:, :2] - now.position[:2])
        return pushed & (gap < self._reach)

    def launched(self, physics: Physics) -> Array:
        """Return (robots,) bool: robots higher than the ceiling."""
        return self.robots(physics)[:, 2] > self.rules.ceiling


def length(vectors: Array) -> Array:
    """Return lengths (...,) of vectors (..., n)."""
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
