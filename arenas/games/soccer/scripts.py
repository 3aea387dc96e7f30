"""Scripted players of soccer, by robot kind: anchors for the ratings, which show progress that learners hide.

| script  | action                                                                                |
|---------|---------------------------------------------------------------------------------------|
| striker | goes round the ball until it is behind it on the line to the goal, then through it;   |
|         | rovers ram a ball near a wall along the wall (`arenas/games/soccer/walls.py`)         |
| keeper  | stands before its goal on the line of the ball, and clears a ball that is near        |
| chaser  | goes straight at the ball, whichever way that pushes it                               |

Rovers drive, forwards or in reverse, and ANYmals trot in arcs. A robot locates itself by the two goals: the vector from
its own goal to the other is the x axis of the frame used here.
"""

from collections.abc import Callable, Iterable

import jax.numpy as jnp
from jax import Array

from arenas.games.soccer import walls
from arenas.games.soccer.observation_layout import OWN_SIZE
from arenas.games.soccer.rules import PitchRules
from arenas.games.soccer.situation import Situation, angle, body_sizes, clear, left, read_situation, rotated, unit
from arenas.games.sumo.scripts import GOING, SPEED, Pace, View, going_of
from arenas.robots.robot import Robot, Script

FULL_SPEED, FULL_STEERING = 50.0, 0.6  # rad/s of the wheels, rad: full throttle and steering of the scripts' rovers
TROT = -0.5  # speed command of ANYmals to their gait, see `arenas.games.sumo.scripts.Pace`
BACK = 1.5  # rad per m by which it turns away from a ball that is inside its circle
BRAKE = 0.3  # share of its speed that a rover loses in its sharpest turn: at full speed its tyres slide
EAGER = 1.2  # ratio of a striker's heading beside the ball to its angle off the line behind the ball
AHEAD = 2.0  # m, length of a heading where a place is required
SQUEEZE = 0.35  # m by which a circle may overlap a wall, which then turns the rover along it
CORNER = 0.6  # m from a side wall: a corner
INWARD = 0.2  # remaining share of the turn to the goal for a ball at a wall
BY_WALL = 0.35  # m from a wall: a ball there is pushed along the wall
LINE, BEFORE = 0.8, 1.5  # m from its goal's middle to a keeper, and range of clearing
HEED, HEED_BACK = 0.33, 0.7  # m ahead of a rover at which a wall makes it reverse, and while it reverses


Plan = Callable[[Situation], Array]  # the vector to go, (2,) m
Go = Callable[[Pace, Array, Array], Array]  # pace, that vector ahead and left, observation -> action


def of_soccer(robots: Iterable[Robot], decision: float, rules: PitchRules) -> dict[str, dict[str, Script]]:
    """Return the game's scripts, name -> kind -> script, of the kinds that can move by one; `decision` is the time in
    seconds between two actions.
    """
    movers = {robot.kind: robot for robot in robots if body_sizes(robot) is not None}
    pace = Pace(decision, FULL_SPEED / rules.drive_scale, FULL_STEERING / rules.steer_scale, TROT)
    plans: dict[str, tuple[Plan, bool]] = {
        "striker": (_strike, False),
        "keeper": (_keep, True),
        "chaser": (lambda situation: situation.ball - situation.me, False),
    }
    if not movers:
        return {}
    return {
        name: {kind: _player(robot, pace, rules, *plan) for kind, robot in movers.items()}
        for name, plan in plans.items()
    }


def _player(robot: Robot, pace: Pace, rules: PitchRules, plan: Plan, stops: bool) -> Script:
    """Make a script that follows `plan`, and `stops` there or only heads there."""
    inside, kind, build = jnp.array(rules.inside), robot.kind, body_sizes(robot)
    assert build is not None
    first = OWN_SIZE.get(kind, robot.proprioception_size)
    going = {**going_of([robot]), **GOING}
    # Observations of both kinds begin with the velocity, ahead first.
    view = View(lambda seen: seen, lambda seen: seen[0], lambda seen: jnp.asarray(jnp.inf), None)

    def play(observation: Array, key: Array) -> Array:
        situation = read_situation(first, build, observation, inside)
        way = plan(situation)
        seen = way[0] * situation.x + way[1] * situation.y
        if kind != "leatherback":
            return going[kind](pace, seen, observation, view, stops)
        if stops:
            action = GOING[kind](pace, seen, observation, view, True)
        else:
            shares = _head(seen)
            if plan is _strike:
                shares = jnp.where(walls.ball_at_wall(situation), walls.drive(situation, observation[0]), shares)
            action = _braked(pace, shares)
        return jnp.where(_blocked(situation, action[0], observation[0]), -action, action)

    return play


def _head(way: Array) -> Array:
    """Return a rover's shares of full throttle and steering towards a vector (2,), ahead and left."""
    return jnp.stack([jnp.asarray(SPEED), jnp.clip(2.0 * jnp.arctan2(way[1], way[0]), -1.0, 1.0)])


def _braked(pace: Pace, shares: Array) -> Array:
    """Return the action of such shares (2,), slower in sharper turns."""
    throttle, steering = shares
    return jnp.stack([pace.throttle * throttle * (1.0 - BRAKE * jnp.abs(steering)), pace.steering * steering])


def _blocked(situation: Situation, throttle: Array, speed: Array) -> Array:
    """Return () bool: a wall, or a robot nearer than the ball, is in the way of a rover with this throttle.

    The rover then reverses, with its wheels turned the other way, and keeps a larger distance while it reverses.
    """
    ahead = jnp.sign(throttle) * jnp.stack([situation.x[0], situation.y[0]])
    backing = speed * throttle < 0
    wall = (jnp.abs(situation.me + jnp.where(backing, HEED_BACK, HEED) * ahead) > situation.inside).any()
    gaps = situation.others - situation.me
    far = jnp.where(situation.present, jnp.linalg.norm(gaps, axis=1), jnp.inf)
    near = far < jnp.minimum(HEED + jnp.where(backing, HEED_BACK, HEED), jnp.linalg.norm(situation.ball - situation.me))
    return wall | (near & (gaps @ ahead > 0.8 * far)).any()


# Plans ----------------------------------------------------------------------------------------------------------------


def _strike(situation: Situation) -> Array:
    """Go round the ball, beside it, until it lies on the line to the goal; then go through it."""
    most = situation.inside - situation.build.edge
    to_ball = (
        jnp.clip(situation.ball, -most, most) - situation.me
    )  # for a ball at a wall, a place that the robot can reach
    far, circle = jnp.linalg.norm(to_ball), situation.build.circle
    push = _push(situation)
    off = angle(push, to_ball)  # remaining angle round the ball, signed
    back = jnp.pi / 2 + BACK * (circle - far)
    round_it = jnp.where(far > circle, jnp.arcsin(circle / jnp.maximum(far, circle)), back)
    eager = EAGER * jnp.maximum(1.0, 0.8 / far)
    aside = jnp.sign(off) * jnp.minimum(eager * jnp.abs(off), round_it)
    beside = situation.ball + jnp.sign(off) * circle * left(unit(to_ball))
    room = jnp.maximum(most, jnp.abs(situation.ball)) + SQUEEZE
    shut = (jnp.abs(beside) > room).any() & (jnp.abs(off) > 0.8)
    aside = jnp.where(shut, -jnp.sign(off) * round_it, aside)  # no room on that side: go round the other side
    return AHEAD * _open(situation, clear(situation, rotated(unit(to_ball), aside), far))


def _push(situation: Situation) -> Array:
    """Return the desired direction (2,) of the ball: to the goal; along a near side wall; at its own end away from its
    goal.
    """
    ball = situation.ball
    push = situation.goal - ball
    off_wall = situation.inside - jnp.abs(ball)  # m
    along = jnp.clip((off_wall[1] - BY_WALL) / 1.0, INWARD, 1.0)
    push = jnp.where(push[0] > 1.0, push * jnp.stack([jnp.ones(()), along]), push)
    by_end = off_wall[0] < jnp.where(ball[0] > 0, BY_WALL, 0.8)
    push = jnp.where(by_end, jnp.stack([jnp.zeros(()), -jnp.sign(ball[0]) * ball[1]]), push)
    cornered = by_end & (ball[0] < 0) & (off_wall[1] < CORNER)  # squeeze the ball out of the own corner
    return unit(jnp.where(cornered, jnp.stack([jnp.ones(()), jnp.sign(ball[1])]), push))


def _open(situation: Situation, heading: Array) -> Array:
    """Limit the heading (2,) towards a wall, more so near the wall."""
    room = jnp.clip(situation.inside - situation.build.edge - jnp.abs(situation.me), 0.0, 1.0)
    out = jnp.sign(situation.me) * jnp.minimum(jnp.abs(heading), 2.0 * room)
    return jnp.where(heading * situation.me > 0, out, heading)


def _keep(situation: Situation) -> Array:
    """Stand on the line from the ball to the middle of the own goal; drive at a near ball from behind."""
    way = situation.ball + situation.goal  # the own goal is opposite
    near = jnp.linalg.norm(way)
    behind = situation.me[0] < situation.ball[0] - 0.1
    stand = -situation.goal + LINE * unit(way)
    place = jnp.where((near < LINE + BEFORE) & behind, situation.ball + 0.3 * unit(way), stand)
    most = situation.inside - situation.build.edge
    return jnp.clip(place, -most, most) - situation.me
