"""Scripted opponents of sumo, by robot kind: anchors for the ratings, which show progress that learners hide.

| script        | rover                          | ANYmal                        | MiniTank: it cannot drive      |
|---------------|--------------------------------|-------------------------------|--------------------------------|
| pusher        | drives at the nearest enemy    | trots at the nearest enemy    | swings its barrel to that side |
| centre-holder | drives to the centre and stays | trots to the centre and stays | stays                          |

Slots do not tell where the centre is, so there is no centre-holder with them.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.robots.anymal import gait
from arenas.robots.leatherback import drive_towards
from arenas.robots.robot import Script, nothing
from arenas.sumo import slots
from arenas.sumo.rich import PER_OTHER

SPEED = 0.9  # a rover's share of full throttle
SLOW = 0.6  # m from the centre, where a rover is slower the nearer it comes
STANDING = 0.5  # m from the centre, where an ANYmal stands still
ASIDE, ARC = 1.0, 1.0  # rad and m: an ANYmal's arc towards what lies that far aside takes it that far out


class Pace(NamedTuple):
    """How a kind's scripts move where this game is played."""

    decision: float  # s between two actions
    throttle: float = 1.0  # a rover's throttle and steering for what ±1 is in the quick start: 60 rad/s and 0.6 rad
    steering: float = 1.0
    trot: float = 1.0  # how far ahead an ANYmal is told to go; at -0.5 its soft legs do too, and it hardly ever falls


class View(NamedTuple):
    """How a script reads the observation of one robot kind."""

    enemies: Callable[[Array], Array]  # observation -> positions (enemies, 3 or 2) ahead, left (, up); zeros: nobody
    throttle: Callable[[Array], Array]  # observation -> () of which the sign is the way a rover last drove
    margin: Callable[[Array], Array]  # observation -> () m to the edge
    centre: Callable[[Array], Array] | None  # observation -> (2,) the ring's centre, m ahead and left


# A kind's way of getting somewhere: (pace, position (2,) ahead and left, observation, view, slow near it?) -> action
Go = Callable[[Pace, Array, Array, View, bool], Array]


def rich_view(feeling: int, enemies: int) -> View:
    """For observations of `arenas.sumo.rich` in which the last `enemies` robots are surely enemies."""
    return View(
        lambda seen: seen[-PER_OTHER * enemies :].reshape(-1, PER_OTHER)[:, :2],
        lambda seen: seen[0],
        lambda seen: seen[feeling + 5],
        lambda seen: seen[feeling + 3 : feeling + 5] * seen[feeling + 6],
    )


def slots_view(kind: str) -> View:
    """For observations of `arenas.sumo.slots`: enemies in slots A and C, those without a slot are not looked for."""
    a, c = slots.first(kind, "a"), slots.first(kind, "c")
    distance, radius = slots.first(kind, "distance"), slots.first(kind, "radius")
    velocity = slots.first(kind, "velocity") if "velocity" in slots.layout(kind) else None
    return View(
        lambda seen: jnp.stack([seen[a : a + 3], seen[c : c + 3]]),
        lambda seen: jnp.zeros(()) if velocity is None else seen[velocity],
        lambda seen: seen[radius] - seen[distance],
        None,
    )


def pusher(kind: str, view: View, pace: Pace) -> Script:
    """Straight at the nearest enemy."""
    go = GOING[kind]

    def push(observation: Array, key: Array) -> Array:
        return go(pace, _nearest(view.enemies(observation)), observation, view, False)

    return push


def centre_holder(kind: str, view: View, pace: Pace) -> Script:
    """To the centre of the ring, and there slower the nearer, so that tyres keep their grip."""
    go, centre = GOING[kind], view.centre
    assert centre is not None

    def hold(observation: Array, key: Array) -> Array:
        return go(pace, centre(observation), observation, view, True)

    return hold


def of_match(views: Mapping[str, View], pace: Pace) -> dict[str, dict[str, Script]]:
    """The game's scripts, name -> kind -> script, for the kinds that play and how each reads what it sees."""
    known = {kind: view for kind, view in views.items() if kind in GOING}
    pushers = {kind: pusher(kind, view, pace) for kind, view in known.items()}
    holders = {kind: centre_holder(kind, view, pace) for kind, view in known.items() if view.centre}
    return {name: kinds for name, kinds in (("pusher", pushers), ("centre-holder", holders)) if kinds}


def _nearest(enemies: Array) -> Array:
    """The nearest (2,) of the enemies; zeros are nobody."""
    gap = jnp.linalg.norm(enemies, axis=1)
    return enemies[jnp.argmin(jnp.where(gap > 0, gap, jnp.inf))][:2]


def _drive(pace: Pace, position: Array, observation: Array, view: View, careful: bool) -> Array:
    speed = jnp.clip(jnp.linalg.norm(position), 0.0, SLOW) if careful else jnp.asarray(SPEED)
    shares = drive_towards(position, speed, view.throttle(observation))
    return shares * jnp.array([pace.throttle, pace.steering])


def _trot(pace: Pace, position: Array, observation: Array, view: View, careful: bool) -> Array:
    """Trot there in an arc, for on the spot the gait hardly turns; stand where the arc would lead over the edge."""
    bearing = jnp.arctan2(position[1], position[0])
    trotting = gait(observation, pace.trot, jnp.clip(2.0 * bearing, -1.0, 1.0), pace.decision)
    over = (jnp.abs(bearing) > ASIDE) & (view.margin(observation) < ARC)
    there = jnp.linalg.norm(position) < STANDING
    return jnp.where(over | there if careful else over, 0.0, trotting)


def _swing(pace: Pace, position: Array, observation: Array, view: View, careful: bool) -> Array:
    """The barrel goes round to the enemy's side; a tank that only wants to be somewhere stays."""
    return nothing(2)(observation, position) if careful else jnp.stack([jnp.zeros(()), jnp.sign(position[1])])


GOING: Mapping[str, Go] = {"leatherback": _drive, "minitank": _swing, "anymal": _trot}
