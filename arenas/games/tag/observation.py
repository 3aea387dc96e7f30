"""Observations in tag, of a puck in the world's frame: itself, the one that is "it", and all others, nearest first.

Nobody is known by its team, so that pucks can change places: each then sees what the other saw.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.description import Part
from arenas.games.tag.settings import IT_SIZE, OTHER_SIZE, OWN_SIZE


class TagView(NamedTuple):
    """The parts of an observation, for scripts."""

    velocity: Array  # (2,)
    position: Array  # (2,)
    is_it: Array  # ()
    it: Array  # (2,) vector to "it", zeros if it is itself
    it_velocity: Array  # (2,)
    gaps: Array  # (others, 2)


def parts(others: int) -> tuple[Part, ...]:
    """Describe the observation of a puck among so many others."""
    own = (
        Part("velocity", 2, "m/s", "its own, along the world's x and y, as all that follows"),
        Part("position", 2, "m", "its own, from the middle of the field"),
        Part("is it", 1, "", '1 if it is "it", else 0'),
        Part("time as it", 1, "", 'share of the episode in which it was "it"'),
        Part("immunity", 1, "", "share of the immunity that remains"),
        Part("time", 1, "", "share of the episode that has passed"),
        Part("it", IT_SIZE, "m, m/s", 'vector to the puck that is "it", and its velocity; zeros if it is itself'),
    )
    return own + tuple(
        Part(name, OTHER_SIZE, "m, m/s, 1", "vector to it, its velocity, and its time as it")
        for name in (f"{_ordinal(i)} other" for i in range(others))
    )


def observe(i: int, xy: Array, velocity: Array, it: Array, held: Array, immunity: Array, time: Array) -> Array:
    """Return the observation of puck `i`.

    Args:
        i: its number.
        xy: (teams, 2) places in metres.
        velocity: (teams, 2) in m/s.
        it: () int, the number of the puck that is "it".
        held: (teams,) share of the episode in which each was "it".
        immunity: () share of the immunity that remains.
        time: () share of the episode that has passed.
    """
    others = jnp.asarray([j for j in range(len(xy)) if j != i])
    gaps = xy[others] - xy[i]
    order = jnp.argsort(jnp.sum(gaps**2, axis=-1))
    others, gaps = others[order], gaps[order]
    own = jnp.stack([1.0 * (it == i), held[i], immunity, time])
    chased = jnp.where(it == i, 0.0, jnp.concatenate([xy[it] - xy[i], velocity[it]]))
    seen = jnp.concatenate([gaps, velocity[others], held[others][:, None]], axis=-1)
    return jnp.concatenate([velocity[i], xy[i], own, chased, seen.ravel()])


def read(observation: Array) -> TagView:
    """Split an observation into its parts."""
    it, others = observation[OWN_SIZE : OWN_SIZE + IT_SIZE], observation[OWN_SIZE + IT_SIZE :].reshape(-1, OTHER_SIZE)
    return TagView(observation[:2], observation[2:4], observation[4], it[:2], it[2:], others[:, :2])


def _ordinal(i: int) -> str:
    return ("nearest", "second", "third", "fourth", "fifth", "sixth", "seventh")[i]
