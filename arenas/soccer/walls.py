"""How a rover plays a ball by a wall, where it cannot get behind it on the line to the goal.

It rams the ball against the wall, and that rolls along it, up to 2 m at full speed, to the other side of the nose's
middle: the nose may point into the wall by 60 degrees, but not by 90. Dribbled along a side wall a ball ends in the
corner, out of which nothing that was tried brings it. So a rover hugs the wall behind it, slowly while it rolls, and
turns its nose away from the wall just before it touches: such a kick sends the ball off the wall by up to 14 degrees.
All this was seen on the C engine, and the numbers below are those that worked there.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.robots.leatherback import drive_towards
from arenas.soccer.situation import LEAD, Scene, angle, clear, left, unit
from arenas.sumo.scripts import SPEED

BAND = 1.1  # m from a wall in which a ball is played so
MOUTH = 1.4  # m from the axis in which a ball at the far end is before the goal, and is not
RUN = 1.2  # m of the way on which it rams
ROOM, NO_ROOM = 0.6, -0.3  # m from a wall at which who rams comes parallel to it, and who kicks would
OWN_END = 0.3  # share of a heading that leads away from the wall at its own end, at least
STEEPEST = 0.95  # share of a heading that leads to or from a wall, at most
ASIDE = 0.1  # m by which it aims beside the middle of a ball at a wall
CLOSE = 0.19  # m from a wall that its middle keeps when it drives along
WIDE = 0.14  # m nearer to the wall than the ball that it then drives, at most: its nose is 0.155 m wide to either side
BESIDE = 0.6  # m from a side wall in which the ball is followed along it
SLACK, SLACK_BY_WALL = 0.35, 0.6  # rad that it may be off the heading to ram; half as much again once it is at it
ROUND = 2.0  # rad off the heading from which on it first passes the ball, on the pitch's side
PASS = 1.2  # m of ball and wall that it then leaves
KICK = 0.55  # m from its middle to the ball's at which it turns to kick
BACKWARDS = 1.7  # m to where it wants to be, within which it may go there in reverse
SLOW, ROLLING = 0.45, 0.8  # share of full throttle behind a ball that rolls along the wall, and from which m/s on


class Ram(NamedTuple):
    """What a rover does about the ball."""

    way: Array  # (2,) m, from where it is to where it wants to be
    strikes: Array  # () bool: it is at ramming or kicking and not still on its way to where that begins
    speed: Array  # () share of full throttle


def beside(scene: Scene) -> Array:
    """() bool: the ball is by a wall, and not before the goal that is played at."""
    off_wall = scene.inside - jnp.abs(scene.ball)
    mouth = (scene.ball[0] > 0) & (off_wall[1] > BAND) & (jnp.abs(scene.ball[1]) < MOUTH)
    return (off_wall < BAND).any() & ~mouth


def drive(scene: Scene, speed: Array) -> Array:
    """A rover's shares (2,) of full throttle and steering that get the ball along; it drives at `speed` in m/s."""
    ram = _ram(scene, speed)
    seen = ram.way[0] * scene.x + ram.way[1] * scene.y
    backwards = ~ram.strikes & (jnp.linalg.norm(ram.way) < BACKWARDS)
    return drive_towards(seen, ram.speed, speed, backwards)


def _ram(scene: Scene, speed: Array) -> Ram:
    heading, nose = _heading(scene, ROOM), jnp.stack([scene.x[0], scene.y[0]])
    to_ball, gap = scene.ball - scene.me, scene.now - scene.me
    far, near, side = jnp.linalg.norm(to_ball), jnp.linalg.norm(gap), _side(scene)
    off_wall, own_end = scene.inside - jnp.abs(scene.ball), _own_end(scene)
    off = jnp.abs(angle(heading, to_ball))
    slack = jnp.where((off_wall < 0.35).any() & ~own_end, SLACK_BY_WALL, SLACK)
    slack = jnp.where(speed * jnp.sum(nose * to_ball) > 0.2 * far, 1.5 * slack, slack)
    kicks = (speed > 0.5) & (near < KICK) & (jnp.abs(angle(nose, gap)) < 0.5) & (jnp.abs(angle(nose, heading)) < 1.0)
    kicks &= side * jnp.sum(left(nose) * gap) < ASIDE  # a ball on the wall's side of the nose would only be scuffed
    most = scene.inside - 0.25
    stage = jnp.clip(scene.ball - RUN * heading, -most, most)
    past = scene.ball - PASS * jnp.sign(scene.ball) * (off_wall < BAND)
    place = jnp.where(off < slack, _aim(scene), jnp.where(off < ROUND, stage, past))
    way = jnp.where(kicks, 2 * _heading(scene, NO_ROOM), place - scene.me)
    rolls = (scene.ball[0] - scene.now[0]) / LEAD
    follows = (off_wall[1] < BESIDE) & (near < 1.5) & (gap[0] > 0) & (rolls > ROLLING) & ~kicks
    clear_way = jnp.linalg.norm(way) * clear(scene, unit(way), far)
    return Ram(clear_way, (off < slack) | kicks, jnp.where(follows, SLOW, SPEED))


def _heading(scene: Scene, room: float) -> Array:
    """The heading (2,) to ram the ball with: to the goal, but the less away from a wall the nearer the ball is to it.

    `room` is how far in m from a wall the ball must be to be rammed parallel to it; nearer ones are into the wall.
    By its own end it is outwards along the wall, and never into it: that way lies its goal.
    """
    side, goal = _side(scene), unit(scene.goal - scene.ball)
    away = (scene.inside - jnp.abs(scene.ball) - room) / RUN
    x = jnp.where(scene.ball[0] > 0, jnp.maximum(goal[0], -away[0]), goal[0])
    inwards = jnp.minimum(-side * goal[1], jnp.minimum(away[1], jnp.sqrt(jnp.maximum(0.0, 1.0 - x**2))))
    inwards = jnp.clip(inwards, -STEEPEST, STEEPEST)
    ahead = jnp.stack([jnp.sqrt(1.0 - inwards**2), -side * inwards])
    off_end = jnp.clip(away[0], OWN_END, STEEPEST)
    outwards = jnp.stack([off_end, side * jnp.sqrt(1.0 - off_end**2)])
    return jnp.where((scene.ball[0] < 0) & (goal[0] > away[0]), outwards, ahead)


def _aim(scene: Scene) -> Array:
    """The place (2,) to drive at: beside the ball's middle, so that it rolls to the other side."""
    ball, side = scene.ball, _side(scene)
    off_wall, gap = scene.inside - jnp.abs(ball), scene.now - scene.me
    at_wall = jnp.clip((0.5 - off_wall) / 0.2, 0.0, 1.0)
    to_goal = jnp.stack([at_wall[1], jnp.where(ball[0] > 0, -side * at_wall[0], 0.0)])
    aim = ball - ASIDE * jnp.where(_own_end(scene), jnp.array([1.5, 0.0]), to_goal)
    most = scene.inside - 0.2
    follows = (off_wall[1] < BESIDE) & ~_own_end(scene) & (gap[0] > 0.0) & (side * gap[1] < 0.6 * gap[0])
    hug = jnp.stack([ball[0] - 0.2, side * jnp.minimum(scene.inside[1] - CLOSE, jnp.abs(ball[1]) + WIDE)])
    return jnp.where(follows, hug, jnp.clip(aim, -most, most))


def _own_end(scene: Scene) -> Array:
    return (scene.ball[0] < 0) & (scene.inside[0] + scene.ball[0] < BAND)


def _side(scene: Scene) -> Array:
    """() the sign of the half, along y, in which the ball is."""
    return jnp.where(scene.ball[1] < 0, -1.0, 1.0)
