"""Observations in the gate race, of a drone. Vectors are in its own frame, unless noted otherwise.

They are the paper's (2512.11781) with six additions: rates, position also without walls, the state of the race, of
contacts and of the clock, and what is known of the other drone's race. Others are in the order of their distance,
nearest first, and nobody is known by its team: thus drones can change places.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from arenas.description import Entities, Part, entity_places
from arenas.games.race.settings import GATES_SIZE, OTHER_SIZE, OWN_SIZE
from arenas.robots.robot import MOTION
from arenas.robots.rotations import into_body

EAST = jnp.array([1.0, 0.0, 0.0])


class RaceView(NamedTuple):
    """The parts of an observation that scripts use."""

    velocity: Array  # (3,) m/s
    down: Array  # (3,) unit vector
    gates: Array  # (2, 4, 3) m, corners of the next two gates, from the upper left


class Standing(NamedTuple):
    """Numbers that are observed of each drone's race."""

    passed: Array  # (drones,) gates
    flying: Array  # (drones,) bool
    contacts: Array  # (drones,) share of the contacts that a drone may have


def parts(others: int) -> tuple[Part, ...]:
    """Describe the observation of a drone among so many others."""
    own = (
        *MOTION,
        Part("east", 3, "", "the world's x, a unit vector: with down it is the attitude"),
        Part("position", 3, "m", "in the world"),
        Part("lap", 1, "", "share of the gates that it has passed"),
        Part("contacts", 1, "", "share of the contacts that end its flight"),
        Part("time", 1, "", "share of the episode that has passed"),
        Part("gate", GATES_SIZE // 2, "m", "vectors to the corners of its next gate, from the upper left"),
        Part("gate after", GATES_SIZE // 2, "m", "the same for the gate after that"),
    )
    return own + tuple(
        Part(
            f"{name} other", OTHER_SIZE, "m, m/s, 1, 1", "vector to it, its velocity, gates it is ahead, 1 if it flies"
        )
        for name in ("nearest", "second", "third")[:others]
    )


def entities(others: int) -> tuple[Entities, ...]:
    """Return the set in the observation: the other drones."""
    return (Entities("others", entity_places(OWN_SIZE + GATES_SIZE, others, OTHER_SIZE)),)


def observe(
    i: int, pose: Array, motion: Array, gates: Array, places: Array, velocity: Array, standing: Standing,
    total: int, time: Array, others: int,
) -> Array:  # fmt: skip
    """Return the observation of drone `i`.

    Args:
        i: its number.
        pose: (7,) m and quaternion.
        motion: (9,) its proprioception.
        gates: (2, 4, 3) m, corners of its next two gates in the world.
        places: (drones, 3) m in the world.
        velocity: (drones, 3) m/s in the world.
        standing: of all drones.
        total: number of gates in a race.
        time: () share of the episode that has passed.
        others: blocks for other drones, at least as many as there are.
    """
    at, turned = pose[:3], jax.vmap(lambda vector: into_body(pose[3:], vector))
    race = jnp.stack([standing.passed[i] / total, standing.contacts[i], time])
    own = jnp.concatenate([motion, into_body(pose[3:], EAST), at, race])
    corners = turned((gates - at).reshape(-1, 3)).ravel()
    seen = _others(i, turned, places, velocity, standing) if len(places) > 1 else jnp.zeros(0)
    return jnp.concatenate([own, corners, jnp.pad(seen, (0, others * OTHER_SIZE - len(seen)))])


def _others(i: int, turned: Callable[[Array], Array], places: Array, velocity: Array, standing: Standing) -> Array:
    """Return the blocks of all other drones. Where those that fly no more are does not matter: they come last."""
    others = jnp.asarray([j for j in range(len(places)) if j != i])
    flying, lead = standing.flying[others], (standing.passed[others] - standing.passed[i]).astype(jnp.float32)
    gaps = places[others] - places[i]
    order = jnp.argsort(jnp.where(flying, jnp.sum(gaps**2, axis=-1), 1e6 - lead))
    seen = jnp.concatenate([turned(gaps), turned(velocity[others])], axis=-1) * flying[:, None]
    return jnp.concatenate([seen, lead[:, None], 1.0 * flying[:, None]], axis=-1)[order].ravel()


def read(observation: Array) -> RaceView:
    """Split an observation into the parts that scripts use."""
    corners = observation[OWN_SIZE : OWN_SIZE + GATES_SIZE].reshape(2, 4, 3)
    return RaceView(observation[:3], observation[6:9], corners)
