"""Scripted players of soccer, by robot kind: anchors for the ratings, which show progress that learners hide.

| script  | what it does                                                                          |
|---------|---------------------------------------------------------------------------------------|
| striker | goes round the ball until it is behind it, on the line from the goal, and through it   |
| keeper  | stands before its goal where the ball would come in, and clears a ball that is near   |
| chaser  | goes straight at the ball, whichever way that pushes it                               |

Rovers drive, forwards or in reverse, and ANYmals trot in arcs. Where it is on the pitch a robot sees by the two goals:
the way from its own to the other is the x axis of the frame in which all is reckoned here.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.robots.robot import Script
from arenas.soccer.layouts import BEGINNING, VECTORS
from arenas.soccer.rules import PitchRules
from arenas.sumo.scripts import GOING, SPEED, Pace, View

FULL_SPEED, FULL_STEERING = 50.0, 0.6  # rad/s of the wheels, rad: full throttle and steering of the scripts' rovers
TROT = -0.5  # what ANYmals tell their gait, see `arenas.sumo.scripts.Pace`
LEAD = 0.2  # s for which the ball is thought to roll on
BACK = 1.5  # rad per m by which it turns away from a ball that is nearer than its circle
BRAKE = 0.3  # share of its speed that a rover takes off in its sharpest turn: at full speed its tyres slide
EAGER = 1.2  # how many times as far aside of the ball a striker heads as it is off the line behind it
AHEAD = 2.0  # m that a heading is long, where a place is asked for
SQUEEZE = 0.35  # m by which a circle may overlap a wall: the wall then turns the rover along it
CORNER = 0.6  # m from a side wall that is a corner
INWARD = 0.2  # share of the way to the goal that a ball at a wall is still turned in
BY_WALL = 0.35  # m from a wall in which a ball is pushed along it
MIND = 1.2  # m in which others are passed by
LINE, BEFORE = 0.8, 1.5  # m before its goal's middle where a keeper stands; nearer than this the ball is cleared
HEED, HEED_BACK = 0.33, 0.7  # m ahead of a rover in which a wall turns it back, and which it then backs off


class Build(NamedTuple):
    """What a player must know of its own body, in metres."""

    edge: float  # from the walls that it keeps its middle
    circle: float  # on which it goes round the ball; it cannot turn on a much smaller one
    berth: float  # from the middle of others, to pass them


BUILDS = {"leatherback": Build(0.2, 1.0, 0.6), "anymal": Build(0.65, 1.0, 0.9)}


class Scene(NamedTuple):
    """What a player sees, as places (2,) in metres on the pitch, in the frame in which it plays at +x."""

    x: Array  # (2,) the frame's x axis in the robot's own
    y: Array
    me: Array
    ball: Array  # where it soon will be
    goal: Array  # the one it plays at; its own is opposite
    others: Array  # (3, 2) the team-mate and two enemies
    there: Array  # (3,) bool: whether they are
    inside: Array  # (2,) the walls, on either side of the middle
    build: Build


Plan = Callable[[Scene], Array]  # the way to go from where it is, (2,) m
Go = Callable[[Pace, Array, Array], Array]  # pace, that way ahead and left, observation -> action


def of_soccer(kinds: Collection[str], decision: float, rules: PitchRules) -> dict[str, dict[str, Script]]:
    """The game's scripts, name -> kind -> script; `decision` is the time in seconds between two actions."""
    pace = Pace(decision, FULL_SPEED / rules.drive_scale, FULL_STEERING / rules.steer_scale, TROT)
    plans: dict[str, tuple[Plan, bool]] = {
        "striker": (_strike, False), "keeper": (_keep, True), "chaser": (lambda scene: scene.ball - scene.me, False),
    }  # fmt: skip
    return {name: {kind: _player(kind, pace, rules, *plan) for kind in kinds} for name, plan in plans.items()}


def _player(kind: str, pace: Pace, rules: PitchRules, plan: Plan, stops: bool) -> Script:
    """A script that goes where `plan` says, and `stops` there or only heads that way."""
    inside = jnp.array(rules.inside)
    # Observations of either kind begin with the velocity, ahead first.
    view = View(lambda seen: seen, lambda seen: seen[0], lambda seen: jnp.asarray(jnp.inf), None)

    def play(observation: Array, key: Array) -> Array:
        scene = _scene(kind, observation, inside)
        way = plan(scene)
        seen = way[0] * scene.x + way[1] * scene.y
        if kind != "leatherback":
            return GOING[kind](pace, seen, observation, view, stops)
        action = GOING[kind](pace, seen, observation, view, True) if stops else _head(pace, seen)
        return jnp.where(_blocked(scene, action[0], observation[0]), -action, action)

    return play


def _head(pace: Pace, way: Array) -> Array:
    """A rover's action that turns its nose into a way (2,) ahead and left; the sharper the turn, the slower."""
    steering = jnp.clip(2.0 * jnp.arctan2(way[1], way[0]), -1.0, 1.0)
    return jnp.stack([pace.throttle * SPEED * (1.0 - BRAKE * jnp.abs(steering)), pace.steering * steering])


def _blocked(scene: Scene, throttle: Array, speed: Array) -> Array:
    """() bool: a wall, or another before the ball, is in the way of a rover that drives so.

    It then backs off, with its wheels turned about, and heeds from further away what it is backing off from.
    """
    ahead = jnp.sign(throttle) * jnp.stack([scene.x[0], scene.y[0]])
    backing = speed * throttle < 0
    wall = (jnp.abs(scene.me + jnp.where(backing, HEED_BACK, HEED) * ahead) > scene.inside).any()
    gaps = scene.others - scene.me
    far = jnp.where(scene.there, jnp.linalg.norm(gaps, axis=1), jnp.inf)
    near = far < jnp.minimum(HEED + jnp.where(backing, HEED_BACK, HEED), jnp.linalg.norm(scene.ball - scene.me))
    return wall | (near & (gaps @ ahead > 0.8 * far)).any()


def _scene(kind: str, observation: Array, inside: Array) -> Scene:
    first = BEGINNING[kind]
    ball, rolls, goal, own, *others = observation[first : first + 3 * VECTORS].reshape(VECTORS, 3)[:, :2]
    along = goal - own
    half = jnp.linalg.norm(along) / 2
    x = along / jnp.maximum(2 * half, 1e-6)
    y = _left(x)

    def placed(vector: Array) -> Array:
        return jnp.stack([jnp.sum(vector * x), jnp.sum(vector * y)])

    me = -placed(goal + own) / 2
    soon = me + placed(ball + LEAD * (rolls + observation[:2]))
    there = (jnp.stack(others) != 0).any(axis=1)
    places = me + jnp.stack([placed(other) for other in others])
    return Scene(x, y, me, soon, jnp.stack([half, jnp.zeros(())]), places, there, inside, BUILDS[kind])


# Plans ----------------------------------------------------------------------------------------------------------------


def _strike(scene: Scene) -> Array:
    """Round the ball until it lies on the line to the goal, which is to head beside it; then through it."""
    most = scene.inside - scene.build.edge
    to_ball = jnp.clip(scene.ball, -most, most) - scene.me  # of a ball at a wall, the place where it can be met
    far, circle = jnp.linalg.norm(to_ball), scene.build.circle
    push = _push(scene)
    off = _angle(push, to_ball)  # how far round the ball it still has to go, and which way
    back = jnp.pi / 2 + BACK * (circle - far)
    round_it = jnp.where(far > circle, jnp.arcsin(circle / jnp.maximum(far, circle)), back)
    eager = EAGER * jnp.maximum(1.0, 0.8 / far)
    aside = jnp.sign(off) * jnp.minimum(eager * jnp.abs(off), round_it)
    beside = scene.ball + jnp.sign(off) * circle * _left(_unit(to_ball))
    room = jnp.maximum(most, jnp.abs(scene.ball)) + SQUEEZE
    shut = (jnp.abs(beside) > room).any() & (jnp.abs(off) > 0.8)
    aside = jnp.where(shut, -jnp.sign(off) * round_it, aside)  # no room on that side: the other way round
    return AHEAD * _open(scene, _clear(scene, _turned(_unit(to_ball), aside), far))


def _push(scene: Scene) -> Array:
    """Which way (2,) the ball shall roll: to the goal; by a side wall along it, by its own end away from its goal."""
    ball = scene.ball
    push = scene.goal - ball
    off_wall = scene.inside - jnp.abs(ball)  # m
    along = jnp.clip((off_wall[1] - BY_WALL) / 1.0, INWARD, 1.0)
    push = jnp.where(push[0] > 1.0, push * jnp.stack([jnp.ones(()), along]), push)
    by_end = off_wall[0] < jnp.where(ball[0] > 0, BY_WALL, 0.8)
    push = jnp.where(by_end, jnp.stack([jnp.zeros(()), -jnp.sign(ball[0]) * ball[1]]), push)
    cornered = by_end & (ball[0] < 0) & (off_wall[1] < CORNER)  # out of its own corner it is squeezed
    return _unit(jnp.where(cornered, jnp.stack([jnp.ones(()), jnp.sign(ball[1])]), push))


def _clear(scene: Scene, heading: Array, far: Array) -> Array:
    """The heading (2,), turned aside as far as the nearest of the others asks for that is nearer than `far` in m."""
    gaps = scene.others - scene.me
    gap = jnp.where(scene.there, jnp.linalg.norm(gaps, axis=1), jnp.inf)
    nearest = jnp.argmin(gap)
    berth = jnp.arcsin(jnp.clip(scene.build.berth / jnp.maximum(gap[nearest], 1e-6), 0.0, 1.0))
    off = _angle(gaps[nearest], heading)
    minded = (gap[nearest] < jnp.minimum(far, MIND)) & (jnp.abs(off) < berth)
    return jnp.where(minded, _turned(_unit(gaps[nearest]), jnp.where(off < 0, -berth, berth)), heading)


def _open(scene: Scene, heading: Array) -> Array:
    """The heading (2,), the less towards a wall the nearer that is."""
    room = jnp.clip(scene.inside - scene.build.edge - jnp.abs(scene.me), 0.0, 1.0)
    out = jnp.sign(scene.me) * jnp.minimum(jnp.abs(heading), 2.0 * room)
    return jnp.where(heading * scene.me > 0, out, heading)


def _keep(scene: Scene) -> Array:
    """On the line from the ball to the middle of its goal; a ball that has come near is driven at from behind."""
    way = scene.ball + scene.goal  # its own goal is opposite
    near = jnp.linalg.norm(way)
    behind = scene.me[0] < scene.ball[0] - 0.1
    stand = -scene.goal + LINE * _unit(way)
    place = jnp.where((near < LINE + BEFORE) & behind, scene.ball + 0.3 * _unit(way), stand)
    most = scene.inside - scene.build.edge
    return jnp.clip(place, -most, most) - scene.me


def _unit(vector: Array) -> Array:
    return vector / jnp.maximum(jnp.linalg.norm(vector), 1e-6)


def _left(vector: Array) -> Array:
    """The vector (2,) a quarter round to the left."""
    return jnp.stack([-vector[1], vector[0]])


def _turned(vector: Array, angle: Array) -> Array:
    """The vector (2,) turned to the left by an angle in rad."""
    return jnp.cos(angle) * vector + jnp.sin(angle) * _left(vector)


def _angle(one: Array, other: Array) -> Array:
    """How far to the left of `one` (2,) the `other` points, rad."""
    return jnp.arctan2(jnp.sum(_left(one) * other), jnp.sum(one * other))
