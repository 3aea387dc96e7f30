"""Play of a rover for a ball near a wall, where it cannot get behind the ball on the line to the goal.

The rover rams the ball against the wall. The ball then rolls along the wall, up to 2 m at full speed, to the side
opposite to the hitting side of the nose; the nose may point into the wall by 60 degrees, but not by 90. A ball that is
dribbled along a side wall ends in the corner, and no method that was tried brings it out of there. So a rover follows
the wall behind the ball, slowly while it rolls, and turns its nose away from the wall just before the touch: such a
kick sends the ball off the wall by up to 14 degrees. All this was observed on the C engine, and the numbers below are
those that worked there.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.games.soccer.situation import LEAD, Situation, angle, clear, left, unit
from arenas.games.sumo.scripts import SPEED
from arenas.robots.leatherback import drive_towards

BAND = 1.1  # m from a wall within which a ball is played in this way
BEFORE_GOAL = 1.4  # m from the axis within which a ball at the far end is in front of the goal, and is not
RUN = 1.2  # m, length of the run-up
ROOM, NO_ROOM = 0.6, -0.3  # m from a wall at which ramming, and kicking, becomes parallel to it
OWN_END = 0.3  # minimum share of a heading that leads away from the wall at the own end
STEEPEST = 0.95  # maximum share of a heading that leads to or from a wall
ASIDE = 0.1  # m, offset of its aim from the middle of a ball at a wall
CLOSE = 0.19  # m between a wall and the rover's middle while it drives along
WIDE = 0.14  # m, how much nearer to the wall than the ball it drives at most: half its nose is 0.155 m wide
BESIDE = 0.6  # m from a side wall within which the rover follows the ball along it
SLACK, SLACK_BY_WALL = 0.35, 0.6  # rad off the heading at which it may ram; half as much again while ramming
ROUND = 2.0  # rad off the heading above which it first passes the ball, on the pitch's side
PASS = 1.2  # m from ball and wall while passing
KICK = 0.55  # m from its middle to the ball's at which it turns to kick
BACKWARDS = 1.7  # m to the desired place within which it may reverse
SLOW, ROLLING = 0.45, 0.8  # share of full throttle behind a rolling ball, and m/s above which a ball rolls


class Ram(NamedTuple):
    """A rover's plan for the ball."""

    way: Array  # (2,) m, from its place to the desired one
    strikes: Array  # () bool: it is ramming or kicking, and not on its way to the start of the run-up
    speed: Array  # () share of full throttle


def ball_at_wall(situation: Situation) -> Array:
    """Return () bool: the ball is by a wall, and not in front of the goal that is attacked."""
    off_wall = situation.inside - jnp.abs(situation.ball)
    mouth = (situation.ball[0] > 0) & (off_wall[1] > BAND) & (jnp.abs(situation.ball[1]) < BEFORE_GOAL)
    return (off_wall < BAND).any() & ~mouth


def drive(situation: Situation, speed: Array) -> Array:
    """Return a rover's shares (2,) of full throttle and steering that move the ball; it drives at `speed` in m/s."""
    ram = _ram(situation, speed)
    seen = ram.way[0] * situation.x + ram.way[1] * situation.y
    backwards = ~ram.strikes & (jnp.linalg.norm(ram.way) < BACKWARDS)
    return drive_towards(seen, ram.speed, speed, backwards)


def _ram(situation: Situation, speed: Array) -> Ram:
    heading, nose = _heading(situation, ROOM), jnp.stack([situation.x[0], situation.y[0]])
    to_ball, gap = situation.ball - situation.me, situation.now - situation.me
    far, near, side = jnp.linalg.norm(to_ball), jnp.linalg.norm(gap), _side(situation)
    off_wall, own_end = situation.inside - jnp.abs(situation.ball), _own_end(situation)
    off = jnp.abs(angle(heading, to_ball))
    slack = jnp.where((off_wall < 0.35).any() & ~own_end, SLACK_BY_WALL, SLACK)
    slack = jnp.where(speed * jnp.sum(nose * to_ball) > 0.2 * far, 1.5 * slack, slack)
    kicks = (speed > 0.5) & (near < KICK) & (jnp.abs(angle(nose, gap)) < 0.5) & (jnp.abs(angle(nose, heading)) < 1.0)
    kicks &= side * jnp.sum(left(nose) * gap) < ASIDE  # a ball on the wall's side of the nose would only be grazed
    most = situation.inside - 0.25
    stage = jnp.clip(situation.ball - RUN * heading, -most, most)
    past = situation.ball - PASS * jnp.sign(situation.ball) * (off_wall < BAND)
    place = jnp.where(off < slack, _aim(situation), jnp.where(off < ROUND, stage, past))
    way = jnp.where(kicks, 2 * _heading(situation, NO_ROOM), place - situation.me)
    rolls = (situation.ball[0] - situation.now[0]) / LEAD
    follows = (off_wall[1] < BESIDE) & (near < 1.5) & (gap[0] > 0) & (rolls > ROLLING) & ~kicks
    clear_way = jnp.linalg.norm(way) * clear(situation, unit(way), far)
    return Ram(clear_way, (off < slack) | kicks, jnp.where(follows, SLOW, SPEED))


def _heading(situation: Situation, room: float) -> Array:
    """Return the heading (2,) for ramming: to the goal, but the less away from a wall the nearer the ball is to it.

    `room` is the distance in m from a wall at which ramming is parallel to it; a nearer ball is rammed into the wall.
    At its own end the heading is outwards along the wall, and never into it, because its goal lies that way.
    """
    side, goal = _side(situation), unit(situation.goal - situation.ball)
    away = (situation.inside - jnp.abs(situation.ball) - room) / RUN
    x = jnp.where(situation.ball[0] > 0, jnp.maximum(goal[0], -away[0]), goal[0])
    inwards = jnp.minimum(-side * goal[1], jnp.minimum(away[1], jnp.sqrt(jnp.maximum(0.0, 1.0 - x**2))))
    inwards = jnp.clip(inwards, -STEEPEST, STEEPEST)
    ahead = jnp.stack([jnp.sqrt(1.0 - inwards**2), -side * inwards])
    off_end = jnp.clip(away[0], OWN_END, STEEPEST)
    outwards = jnp.stack([off_end, side * jnp.sqrt(1.0 - off_end**2)])
    return jnp.where((situation.ball[0] < 0) & (goal[0] > away[0]), outwards, ahead)


def _aim(situation: Situation) -> Array:
    """Return the place (2,) to drive at: beside the ball's middle, so that the ball rolls to the other side."""
    ball, side = situation.ball, _side(situation)
    off_wall, gap = situation.inside - jnp.abs(ball), situation.now - situation.me
    at_wall = jnp.clip((0.5 - off_wall) / 0.2, 0.0, 1.0)
    to_goal = jnp.stack([at_wall[1], jnp.where(ball[0] > 0, -side * at_wall[0], 0.0)])
    aim = ball - ASIDE * jnp.where(_own_end(situation), jnp.array([1.5, 0.0]), to_goal)
    most = situation.inside - 0.2
    follows = (off_wall[1] < BESIDE) & ~_own_end(situation) & (gap[0] > 0.0) & (side * gap[1] < 0.6 * gap[0])
    hug = jnp.stack([ball[0] - 0.2, side * jnp.minimum(situation.inside[1] - CLOSE, jnp.abs(ball[1]) + WIDE)])
    return jnp.where(follows, hug, jnp.clip(aim, -most, most))


def _own_end(situation: Situation) -> Array:
    return (situation.ball[0] < 0) & (situation.inside[0] + situation.ball[0] < BAND)


def _side(situation: Situation) -> Array:
    """Return () the sign of y at the ball: the half of the pitch that it is in."""
    return jnp.where(situation.ball[1] < 0, -1.0, 1.0)
