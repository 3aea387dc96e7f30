"""Scripted opponents of sumo, by robot kind: anchors for the ratings, which show progress that learners hide.

| script        | rover                          | ANYmal                        | MiniTank: it cannot drive      |
|---------------|--------------------------------|-------------------------------|--------------------------------|
| pusher        | drives at the nearest enemy    | trots at the nearest enemy    | swings its barrel to that side |
| centre-holder | drives to the centre and stays | trots to the centre and stays | stays                          |

Slots do not contain the centre, so there is no centre-holder with them.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.games.sumo import paper_observation
from arenas.games.sumo.full_observation import PER_OTHER
from arenas.robots.anymal import gait
from arenas.robots.leatherback import drive_towards
from arenas.robots.robot import Robot, Script, idle_script

SPEED = 0.9  # a rover's share of full throttle
SLOW = 0.6  # m from the centre, within which a rover slows down in proportion
STANDING = 0.5  # m from the centre, within which an ANYmal stands still
ASIDE, ARC = 1.0, 1.0  # rad and m: turning by so large an angle, an ANYmal's arc moves it that far outwards


class Pace(NamedTuple):
    """Conversion of a kind's scripts to the timing and action scales of this game."""

    decision: float  # s between two actions
    throttle: float = 1.0  # a rover's throttle and steering for ±1 of the quick start: 60 rad/s and 0.6 rad
    steering: float = 1.0
    trot: float = 1.0  # forward command of an ANYmal; at -0.5 its soft legs still move ahead, and it hardly ever falls


class View(NamedTuple):
    """Access of a script to the observation of one robot kind."""

    enemies: Callable[[Array], Array]  # observation -> positions (enemies, 3 or 2) ahead, left (, up); zeros: no enemy
    throttle: Callable[[Array], Array]  # observation -> () its sign is the direction in which a rover last drove
    margin: Callable[[Array], Array]  # observation -> () m to the edge
    centre: Callable[[Array], Array] | None  # observation -> (2,) the ring's centre, m ahead and left


# Locomotion of a kind: (pace, position (2,) ahead and left, observation, view, slow near it?) -> action
Go = Callable[[Pace, Array, Array, View, bool], Array]


def full_view(proprioception_size: int, enemies: int) -> View:
    """Find enemies in the full observations (`full_observation`): the last `enemies` robots."""
    return View(
        lambda observation: observation[-PER_OTHER * enemies :].reshape(-1, PER_OTHER)[:, :2],
        lambda observation: observation[0],
        lambda observation: observation[proprioception_size + 5],
        lambda observation: (
            observation[proprioception_size + 3 : proprioception_size + 5] * observation[proprioception_size + 6]
        ),
    )


def slots_view(kind: str) -> View:
    """Find enemies in HARL-A's observations (`paper_observation`): those in slots A and C, and no others."""
    a, c = paper_observation.first_index(kind, "a"), paper_observation.first_index(kind, "c")
    distance, radius = paper_observation.first_index(kind, "distance"), paper_observation.first_index(kind, "radius")
    velocity = paper_observation.first_index(kind, "velocity") if "velocity" in paper_observation.layout(kind) else None
    return View(
        lambda observation: jnp.stack([observation[a : a + 3], observation[c : c + 3]]),
        lambda observation: jnp.zeros(()) if velocity is None else observation[velocity],
        lambda observation: observation[radius] - observation[distance],
        None,
    )


def pusher(kind: str, view: View, pace: Pace, go: Go | None = None) -> Script:
    """Make a script that moves straight at the nearest enemy; `go` moves a kind that is none of GOING."""
    go = go or GOING[kind]

    def push(observation: Array, key: Array) -> Array:
        return go(pace, _nearest(view.enemies(observation)), observation, view, False)

    return push


def centre_holder(kind: str, view: View, pace: Pace, go: Go | None = None) -> Script:
    """Make a script that moves to the centre of the ring and slows down near it, so that tyres keep their grip."""
    go, centre = go or GOING[kind], view.centre
    assert centre is not None

    def hold(observation: Array, key: Array) -> Array:
        return go(pace, centre(observation), observation, view, True)

    return hold


def of_match(views: Mapping[str, View], pace: Pace, robots: Iterable[Robot] = ()) -> dict[str, dict[str, Script]]:
    """Return the game's scripts, name -> kind -> script, for the kinds that play, each with its view of the
    observation. Of `robots` from files those on wheels play.
    """
    going = {**going_of(robots), **GOING}
    known = {kind: view for kind, view in views.items() if kind in going}
    pushers = {kind: pusher(kind, view, pace, going[kind]) for kind, view in known.items()}
    holders = {kind: centre_holder(kind, view, pace, going[kind]) for kind, view in known.items() if view.centre}
    return {name: kinds for name, kinds in (("pusher", pushers), ("centre-holder", holders)) if kinds}


def going_of(robots: Iterable[Robot]) -> dict[str, Go]:
    """Return how the robots with a drive of their own move, by kind."""

    def go(drive: Callable[[Array, bool], Array]) -> Go:
        return lambda pace, position, observation, view, careful: drive(position, careful)

    return {robot.kind: go(robot.drive) for robot in robots if robot.drive is not None}


def _nearest(enemies: Array) -> Array:
    """Return the nearest (2,) of the enemies; zeros mean no enemy."""
    gap = jnp.linalg.norm(enemies, axis=1)
    return enemies[jnp.argmin(jnp.where(gap > 0, gap, jnp.inf))][:2]


def _drive(pace: Pace, position: Array, observation: Array, view: View, careful: bool) -> Array:
    speed = jnp.clip(jnp.linalg.norm(position), 0.0, SLOW) if careful else jnp.asarray(SPEED)
    shares = drive_towards(position, speed, view.throttle(observation))
    return shares * jnp.array([pace.throttle, pace.steering])


def _trot(pace: Pace, position: Array, observation: Array, view: View, careful: bool) -> Array:
    """Trot there in an arc, since the gait hardly turns on the spot; stand still if the arc would leave the ring."""
    bearing = jnp.arctan2(position[1], position[0])
    trotting = gait(observation, pace.trot, jnp.clip(2.0 * bearing, -1.0, 1.0), pace.decision)
    over = (jnp.abs(bearing) > ASIDE) & (view.margin(observation) < ARC)
    there = jnp.linalg.norm(position) < STANDING
    return jnp.where(over | there if careful else over, 0.0, trotting)


def _swing(pace: Pace, position: Array, observation: Array, view: View, careful: bool) -> Array:
    """Swing the barrel to the enemy's side; without an enemy to hit, stay."""
    return idle_script(2)(observation, position) if careful else jnp.stack([jnp.zeros(()), jnp.sign(position[1])])


GOING: Mapping[str, Go] = {"leatherback": _drive, "minitank": _swing, "anymal": _trot}
