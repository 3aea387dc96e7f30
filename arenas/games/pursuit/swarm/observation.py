"""Observations in the swarm: of itself and the game, then a block for each other puck, then one for each other rover.

A block is zeros for a robot that is not in the game, or does not exist: its last number is 1 where there is one. Thus a
policy can play with other numbers, and networks can take the blocks as sets. Vectors are in the robot's own frame: a
rover's is its heading, pucks never turn.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.description import Entities, Part, entity_places
from arenas.games.pursuit.swarm.settings import KINDS, OTHER_SIZES, OWN_SIZES, SwarmSettings

NO_HEADING = np.array([0, 1, 2, 3, 6])  # the numbers of a block of a puck, which has no heading


class PlanarState(NamedTuple):
    """Everything that can be observed, in the world's frame; pucks come first."""

    xy: Array  # (robots, 2) m
    velocity: Array  # (robots, 2) m/s
    yaw: Array  # (robots,) rad
    turning: Array  # (robots,) rad/s about z
    here: Array  # (robots,) bool: in the game
    actions: Array  # (robots, 2) the last ones
    through: Array  # () share of the pucks needed that have reached the zone
    caught: Array  # () share of the pucks that are caught
    time: Array  # () share of the episode that has passed


class SwarmView(NamedTuple):
    """The parts of an observation, for scripts."""

    zone: Array  # (2,) vector to its middle
    last_throttle: Array  # () of a rover; 0 of a puck
    pucks: Array  # (other pucks, 5)
    rovers: Array  # (other rovers, 7)


def parts(kind: str, settings: SwarmSettings) -> tuple[Part, ...]:
    """Describe the observation of a robot of this kind."""
    own = (
        Part("velocity", 2, "m/s", "its own"),
        Part("zone", 2, "m", "vector to its middle"),
        Part("through", 1, "", "share of the pucks needed that have reached the zone"),
        Part("caught", 1, "", "share of the pucks that are caught"),
        Part("time", 1, "", "share of the episode that has passed"),
    )
    if kind == KINDS[1]:
        own += (
            Part("heading", 2, "", "cosine and sine of its heading in the world"),
            Part("turning", 1, "rad/s", "about the vertical"),
            Part("position", 2, "m", "its own in the world, from the middle of the field"),
            Part("last action", 2, "", "throttle and steering"),
        )
    meaning = {
        "puck": ("m, m/s, 1", "vector to it, its velocity, 1 if it is in the game"),
        "leatherback": ("m, m/s, 1, 1", "vector to it, its velocity, its heading, 1 if there is one"),
    }
    others = tuple(
        Part(f"{each} {i + 1}", OTHER_SIZES[each], *meaning[each])
        for each, room in settings.room.items()
        for i in range(room - (each == kind))
    )
    return own + others


def entities(kind: str, settings: SwarmSettings) -> tuple[Entities, ...]:
    """Return the sets in the observation of a robot of this kind: other pucks, and other rovers."""
    found, first = [], OWN_SIZES[kind]
    for each, room in settings.room.items():
        number = room - (each == kind)
        found.append(Entities(f"{each}s", entity_places(first, number, OTHER_SIZES[each])))
        first += number * OTHER_SIZES[each]
    return tuple(each for each in found if each.places)


def observe(state: PlanarState, settings: SwarmSettings) -> list[Array]:
    """Return the observation of each robot."""
    pucks, total = settings.pucks, len(state.xy)
    turn = jnp.where(jnp.arange(total) < pucks, 0.0, -state.yaw)
    here = jnp.broadcast_to(1.0 * state.here[:, None], (total, total, 1))
    seen = (state.xy - state.xy[:, None], state.velocity[None], _ways(state.yaw)[None])
    blocks = here * jnp.concatenate([*(_turned(each, turn[:, None]) for each in seen), here], axis=-1)
    shares = jnp.broadcast_to(jnp.stack([state.through, state.caught, state.time]), (total, 3))
    own = jnp.concatenate([_turned(state.velocity, turn), _turned(-state.xy, turn), shares], axis=-1)
    of_rovers = jnp.concatenate([_ways(state.yaw), state.turning[:, None], state.xy, state.actions], axis=-1)
    found = []
    for i in range(total):
        parts = [own[i]] if i < pucks else [own[i], of_rovers[i]]
        for kind, first, number in ((KINDS[0], 0, pucks), (KINDS[1], pucks, total - pucks)):
            others = np.array([j for j in range(first, first + number) if j != i], int)
            shown = blocks[i, others] if kind == KINDS[1] else blocks[i, others][:, NO_HEADING]
            parts.append(jnp.pad(shown, ((0, settings.room[kind] - number), (0, 0))).ravel())
        found.append(jnp.concatenate(parts))
    return found


def read(observation: Array, kind: str, settings: SwarmSettings) -> SwarmView:
    """Split an observation into its parts."""
    first = OWN_SIZES[kind]
    pucks, rovers = (room - (each == kind) for each, room in settings.room.items())
    middle = first + pucks * OTHER_SIZES["puck"]
    throttle = observation[12] if kind == KINDS[1] else jnp.zeros(())
    return SwarmView(
        observation[2:4], throttle, observation[first:middle].reshape(pucks, OTHER_SIZES["puck"]),
        observation[middle:].reshape(rovers, OTHER_SIZES["leatherback"]),
    )  # fmt: skip


def _ways(yaw: Array) -> Array:
    """Return the headings (..., 2) of angles (...)."""
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)


def _turned(vectors: Array, angle: Array) -> Array:
    """Turn vectors (..., 2) by angles in rad, which broadcast to (...)."""
    (x, y), (cos, sin) = (vectors[..., 0], vectors[..., 1]), (jnp.cos(angle), jnp.sin(angle))
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
