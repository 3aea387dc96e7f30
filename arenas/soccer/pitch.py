"""The pitch: walls, goals, ball and robots as they are built, where they start, and what the ball does."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas import props
from arenas.colours import TEAM_COLOURS
from arenas.options import Solver
from arenas.physics import Physics
from arenas.props import Prop
from arenas.robots.anymal import anymal
from arenas.robots.leatherback import MAX_STEERING, leatherback
from arenas.robots.robot import Robot
from arenas.scene import Scene
from arenas.soccer.rules import WALL, WALL_HEIGHT, PitchRules
from arenas.soccer.sight import Ball
from arenas.starts import apart, bases
from arenas.sumo.settings import KINDS

STEERING_UNCLAMPED = 10.0  # rad
KICK = 0.15  # m/s: by more than that in a control step a ball is not slowed by the ground alone, which takes 0.1
NEAR = 0.05  # m beyond the circle in which a robot stands, where it may still be that which touched the ball
GOAL_ALPHA = 0.6
HORIZON = 2.0  # s within which a ball that rolls at a goal counts as a shot


def things(rules: PitchRules) -> list[Prop]:
    """The ball, four walls and two goals; a goal has the colour of those who defend it."""
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
    """A robot as it drives here."""
    if kind == "anymal":
        return anymal(rules.fall_height, rules.fall_up)
    defects = rules.defects
    return leatherback(
        rules.drive_scale, rules.steer_scale, limit=None,
        wheel_limit=None if defects.throttle_unclamped else rules.wheel_limit,
        steer_limit=STEERING_UNCLAMPED if defects.steering_unclamped else MAX_STEERING,
    )  # fmt: skip


def solver(kinds: Sequence[str]) -> Solver:
    """Contacts of all robots, the ball and the walls. The cone is elliptic: see `docs/arenas/soccer.md`.

    Chasers used at most 14 contacts and 45 rows in a game of two, 21 and 67 in one of four. A contact has three rows,
    one of the ball's six.
    """
    contacts = 6 + sum(KINDS[kind].contacts for kind in kinds)
    return Solver(ls_iterations=50, cone="elliptic", contacts=contacts, rows=12 + 3 * contacts)


class Pitch:
    """Ball and robots of one scene by their numbers: blue's, then red's, of these `sizes`."""

    def __init__(self, scene: Scene, robots: Mapping[str, Robot], rules: PitchRules, dropped: Mapping[str, float]):
        """`dropped` is how high in metres robots start, by kind; the others stand on the ground."""
        self.rules = rules
        kinds = [each.kind for each in robots.values()]
        at, place = scene.props["ball"].qpos, scene.props["ball"].qvel
        assert at is not None
        assert place is not None
        self.ball_qpos, self.ball_qvel = at, place
        self._bases = np.array([scene.agents[name].qpos for name in robots])
        self._rest = jnp.asarray(scene.rest, jnp.float32)
        self._speeds = scene.model.nv
        self._heights = jnp.array([dropped.get(each.kind, each.rest_height) for each in robots.values()])
        self._reach = jnp.array([KINDS[kind].hull / 2 for kind in kinds]) + rules.ball.radius + NEAR
        self.clear = rules.clear(kinds)

    # Start -----------------------------------------------------------------------------------------------------------

    def start(self, key: Array, place: Callable[[Array], Array] | None = None) -> tuple[Array, Array]:
        """All at rest, as qpos and qvel: , the robots and the ball on the lattice, or where `place` (key) puts them.

        `place` gives (robots + 1, 2) m, the ball last.
        """
        where, turn = jax.random.split(key)
        xy = self.lattice(where) if place is None else place(where)
        heading = jax.random.uniform(turn, (len(xy) - 1,), maxval=2 * jnp.pi)
        if self.rules.heading == "fixed":
            heading = jnp.full(len(xy) - 1, jnp.pi)
        qpos = self._rest.at[self._bases[:, None] + np.arange(7)].set(bases(xy[:-1], heading, self._heights))
        qpos = qpos.at[self.ball_qpos : self.ball_qpos + 2].set(xy[-1])
        return qpos, jnp.zeros(self._speeds)

    def lattice(self, key: Array) -> Array:
        """Places (robots + 1, 2) m on the lattice, the ball last, clear of each other whichever way they face."""
        points = jnp.array(self.rules.lattice)
        return apart(key, points, jnp.ones(len(points), bool), self.clear)

    # Facts -----------------------------------------------------------------------------------------------------------

    def ball(self, physics: Physics) -> Ball:
        """The ball as it is."""
        at, speed = self.ball_qpos, self.ball_qvel
        return Ball(physics.qpos[at : at + 3], physics.qvel[speed : speed + 3])

    def robots(self, physics: Physics) -> Array:
        """Where the bases are, (robots, 3) m."""
        return physics.qpos[self._bases[:, None] + np.arange(3)]

    def to_ball(self, physics: Physics) -> Array:
        """Metres from each robot's base to the ball, (robots,)."""
        return length(self.robots(physics) - self.ball(physics).position)

    def to_goal(self, physics: Physics, side: Array) -> Array:
        """Metres along the ground from the ball to the middle of the goal at +x where `side` is 1, at -x where -1."""
        goal = jnp.stack([side * self.rules.goal_at, jnp.zeros_like(side)], axis=-1)
        return length(goal - self.ball(physics).position[:2])

    def scored(self, physics: Physics, side: Array) -> Array:
        """Bool, shaped as `side`: the ball's middle is over the goal on that side (1 at +x, -1 at -x), however high."""
        x, y, _ = self.ball(physics).position
        return self._over(side * x, y)

    def over_goal(self, xy: Array) -> Array:
        """(n,) bool: whether points (n, 2) are over one of the two goals."""
        return self._over(jnp.abs(xy[:, 0]), xy[:, 1])

    def _over(self, x: Array, y: Array) -> Array:
        deep, wide = self.rules.goal
        return (jnp.abs(x - self.rules.goal_at) <= deep / 2) & (jnp.abs(y) <= wide / 2)

    def shot(self, physics: Physics, side: Array) -> Array:
        """Bool, shaped as `side`: left alone the ball would roll into the goal on that side within two seconds."""
        ball, (deep, wide) = self.ball(physics), self.rules.goal
        ahead = self.rules.goal_at - deep / 2 - side * ball.position[0]  # m to the goal's front
        speed = jnp.maximum(side * ball.velocity[0], 1e-3)
        time = ahead / speed
        y = ball.position[1] + time * ball.velocity[1]
        # It slows down on its way: v²/2a is as far as it gets.
        gets = length(ball.velocity[:2]) * speed / (2 * max(self.rules.ball.roll_loss, 1e-3))
        return (ahead > 0) & (time < HORIZON) & (ahead < gets) & (jnp.abs(y) < wide / 2)

    def touched(self, before: Physics, physics: Physics) -> Array:
        """(robots,) bool: who gave the ball a push in this control step.

        Its speed along the ground has changed by more than the ground's friction can, and the robot is as near as it
        must be to touch it. Of two robots as near both did; a wall beside a robot may pass for it.
        """
        was, now = self.ball(before), self.ball(physics)
        pushed = length(now.velocity[:2] - was.velocity[:2]) > KICK
        gap = length(self.robots(physics)[:, :2] - now.position[:2])
        return pushed & (gap < self._reach)

    def launched(self, physics: Physics) -> Array:
        """(robots,) bool: who is higher than any robot should be."""
        return self.robots(physics)[:, 2] > self.rules.ceiling


def length(vectors: Array) -> Array:
    """Lengths (...,) of vectors (..., n)."""
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
