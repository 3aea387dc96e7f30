"""Scripted players of soccer, by robot kind: anchors for the ratings, which show progress that learners hide.

| script  | what it does                                                                          |
|---------|---------------------------------------------------------------------------------------|
| striker | goes round the ball until it is behind it, on the line from the goal, and through it;  |
|         | rovers ram a ball by a wall along it (`arenas/soccer/walls.py`)                       |
| keeper  | stands before its goal where the ball would come in, and clears a ball that is near   |
| chaser  | goes straight at the ball, whichever way that pushes it                               |

Rovers drive, forwards or in reverse, and ANYmals trot in arcs. Where it is on the pitch a robot sees by the two goals:
the way from its own to the other is the x axis of the frame in which all is reckoned here.
"""

from collections.abc import Callable, Collection

import jax.numpy as jnp
from jax import Array

from arenas.robots.robot import Script
from arenas.soccer import walls
from arenas.soccer.rules import PitchRules
from arenas.soccer.situation import Scene, angle, clear, left, read, turned, unit
from arenas.sumo.scripts import GOING, SPEED, Pace, View

FULL_SPEED, FULL_STEERING = 50.0, 0.6  # rad/s of the wheels, rad: full throttle and steering of the scripts' rovers
TROT = -0.5  # what ANYmals tell their gait, see `arenas.sumo.scripts.Pace`
BACK = 1.5  # rad per m by which it turns away from a ball that is nearer than its circle
BRAKE = 0.3  # share of its speed that a rover takes off in its sharpest turn: at full speed its tyres slide
EAGER = 1.2  # how many times as far aside of the ball a striker heads as it is off the line behind it
AHEAD = 2.0  # m that a heading is long, where a place is asked for
SQUEEZE = 0.35  # m by which a circle may overlap a wall: the wall then turns the rover along it
CORNER = 0.6  # m from a side wall that is a corner
INWARD = 0.2  # share of the way to the goal that a ball at a wall is still turned in
BY_WALL = 0.35  # m from a wall in which a ball is pushed along it
LINE, BEFORE = 0.8, 1.5  # m before its goal's middle where a keeper stands; nearer than this the ball is cleared
HEED, HEED_BACK = 0.33, 0.7  # m ahead of a rover in which a wall turns it back, and which it then backs off


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
        scene = read(kind, observation, inside)
        way = plan(scene)
        seen = way[0] * scene.x + way[1] * scene.y
        if kind != "leatherback":
            return GOING[kind](pace, seen, observation, view, stops)
        if stops:
            action = GOING[kind](pace, seen, observation, view, True)
        else:
            shares = _head(seen)
            if plan is _strike:
                shares = jnp.where(walls.beside(scene), walls.drive(scene, observation[0]), shares)
            action = _braked(pace, shares)
        return jnp.where(_blocked(scene, action[0], observation[0]), -action, action)

    return play


def _head(way: Array) -> Array:
    """A rover's shares of full throttle and steering that turn its nose into a way (2,) ahead and left."""
    return jnp.stack([jnp.asarray(SPEED), jnp.clip(2.0 * jnp.arctan2(way[1], way[0]), -1.0, 1.0)])


def _braked(pace: Pace, shares: Array) -> Array:
    """The action of such shares (2,); the sharper the turn, the slower."""
    throttle, steering = shares
    return jnp.stack([pace.throttle * throttle * (1.0 - BRAKE * jnp.abs(steering)), pace.steering * steering])


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


# Plans ----------------------------------------------------------------------------------------------------------------


def _strike(scene: Scene) -> Array:
    """Round the ball until it lies on the line to the goal, which is to head beside it; then through it."""
    most = scene.inside - scene.build.edge
    to_ball = jnp.clip(scene.ball, -most, most) - scene.me  # of a ball at a wall, the place where it can be met
    far, circle = jnp.linalg.norm(to_ball), scene.build.circle
    push = _push(scene)
    off = angle(push, to_ball)  # how far round the ball it still has to go, and which way
    back = jnp.pi / 2 + BACK * (circle - far)
    round_it = jnp.where(far > circle, jnp.arcsin(circle / jnp.maximum(far, circle)), back)
    eager = EAGER * jnp.maximum(1.0, 0.8 / far)
    aside = jnp.sign(off) * jnp.minimum(eager * jnp.abs(off), round_it)
    beside = scene.ball + jnp.sign(off) * circle * left(unit(to_ball))
    room = jnp.maximum(most, jnp.abs(scene.ball)) + SQUEEZE
    shut = (jnp.abs(beside) > room).any() & (jnp.abs(off) > 0.8)
    aside = jnp.where(shut, -jnp.sign(off) * round_it, aside)  # no room on that side: the other way round
    return AHEAD * _open(scene, clear(scene, turned(unit(to_ball), aside), far))


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
    return unit(jnp.where(cornered, jnp.stack([jnp.ones(()), jnp.sign(ball[1])]), push))


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
    stand = -scene.goal + LINE * unit(way)
    place = jnp.where((near < LINE + BEFORE) & behind, scene.ball + 0.3 * unit(way), stand)
    most = scene.inside - scene.build.edge
    return jnp.clip(place, -most, most) - scene.me
