"""What predators and prey see: MADDPG's layout and, because it decides the game, the clock. All in the world's frame.

| part       | numbers          |                                                                                    |
|------------|------------------|------------------------------------------------------------------------------------|
| velocity   | 2                | its own                                                                            |
| position   | 2                | its own, from the middle of the field                                              |
| pillars    | 2 for each       | the way to its middle                                                              |
| predators  | 2 for each other | the way to it                                                                      |
| prey       | 2 for each other | the way to it; zeros where it is caught                                            |
| prey moves | 2 for each other | its velocity; zeros where it is caught. How predators move nobody sees, as there   |
| time       | 1                | share of the episode that has passed                                               |
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.about import Part


class Scene(NamedTuple):
    """All that can be seen, in metres and m/s in the plane."""

    xy: Array  # (robots, 2), predators first
    velocity: Array  # (robots, 2)
    pillars: Array  # (pillars, 2)
    free: Array  # (prey,) bool: not caught yet
    time: Array  # () share of the episode


class Seen(NamedTuple):
    """An observation taken apart, for scripts."""

    velocity: Array  # (2,)
    position: Array  # (2,)
    pillars: Array  # (pillars, 2)
    predators: Array  # (other predators, 2)
    prey: Array  # (other prey, 2)
    prey_velocity: Array  # (other prey, 2)
    time: Array  # ()


class Sight:
    """Who sees what in a game of so many predators, prey and pillars."""

    def __init__(self, predators: int, prey: int, pillars: int):
        self.predators, self.prey, self.pillars = predators, prey, pillars

    def parts(self, preys: bool) -> tuple[Part, ...]:
        """The numbers of prey's observation, or of a predator's, in words."""
        predators, prey = self._others(preys)
        hunters, hunted = ("predators", "other prey") if preys else ("other predators", "prey")
        told = (
            Part("velocity", 2, "m/s", "its own; as all that follows along the world's x and y"),
            Part("position", 2, "m", "its own, from the middle of the field"),
            Part("pillars", 2 * self.pillars, "m", "the way to the middle of each"),
            Part(hunters, 2 * predators, "m", "the way to each"),
            Part(hunted, 2 * prey, "m", "the way to each; zeros where it is caught"),
            Part(f"{hunted}, moving", 2 * prey, "m/s", "the velocity of each; zeros where it is caught"),
            Part("time", 1, "", "share of the episode that has passed"),
        )
        return tuple(part for part in told if part.size)

    def observe(self, scene: Scene, i: int) -> Array:
        """The observation of robot i."""
        others = jnp.asarray([j for j in range(len(scene.xy)) if j != i], jnp.int32)
        shown = jnp.concatenate([jnp.ones(self.predators, bool), scene.free])[others, None]
        gaps = jnp.where(shown, scene.xy[others] - scene.xy[i], 0.0)
        moving = jnp.where(shown, scene.velocity[others], 0.0)[self._others(i >= self.predators)[0] :]
        told = (scene.velocity[i], scene.xy[i], scene.pillars - scene.xy[i], gaps, moving, scene.time)
        return jnp.concatenate([jnp.ravel(each) for each in told])

    def read(self, observation: Array, preys: bool) -> Seen:
        """An observation taken apart."""
        predators, prey = self._others(preys)
        pairs = observation[:-1].reshape(-1, 2)
        pillars, hunters, hunted, moving = jnp.split(pairs[2:], np.cumsum([self.pillars, predators, prey]))
        return Seen(pairs[0], pairs[1], pillars, hunters, hunted, moving, observation[-1])

    def _others(self, preys: bool) -> tuple[int, int]:
        """How many other predators and other prey there are for prey, or for a predator."""
        return (self.predators, self.prey - 1) if preys else (self.predators - 1, self.prey)
