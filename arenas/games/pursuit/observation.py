"""Observations of predators and prey: MADDPG's layout plus the clock, which decides the game. All in the world's frame.

| part       | numbers          |                                                                                    |
|------------|------------------|------------------------------------------------------------------------------------|
| velocity   | 2                | its own                                                                            |
| position   | 2                | its own, from the middle of the field                                              |
| pillars    | 2 for each       | vector to its middle                                                               |
| predators  | 2 for each other | vector to it                                                                       |
| prey       | 2 for each other | vector to it; zeros if it is caught                                                |
| prey moves | 2 for each other | its velocity; zeros if it is caught. Predators' velocities are hidden, as there  |
| time       | 1                | share of the episode that has passed                                               |
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.description import Entities, Part, entity_places


class PlanarState(NamedTuple):
    """Everything that can be observed, in metres and m/s in the plane."""

    xy: Array  # (robots, 2), predators first
    velocity: Array  # (robots, 2)
    pillars: Array  # (pillars, 2)
    free: Array  # (prey,) bool: not caught yet
    time: Array  # () share of the episode


class PursuitView(NamedTuple):
    """The parts of an observation, for scripts."""

    velocity: Array  # (2,)
    position: Array  # (2,)
    pillars: Array  # (pillars, 2)
    predators: Array  # (other predators, 2)
    prey: Array  # (other prey, 2)
    prey_velocity: Array  # (other prey, 2)
    time: Array  # ()


class ObservationBuilder:
    """Observations in a game of so many predators, prey and pillars."""

    def __init__(self, predators: int, prey: int, pillars: int):
        self.predators, self.prey, self.pillars = predators, prey, pillars

    def parts(self, preys: bool) -> tuple[Part, ...]:
        """Describe the observation of prey (`preys`) or of a predator."""
        predators, prey = self._others(preys)
        hunters, hunted = ("predators", "other prey") if preys else ("other predators", "prey")
        parts = (
            Part("velocity", 2, "m/s", "its own, along the world's x and y, as all that follows"),
            Part("position", 2, "m", "its own, from the middle of the field"),
            Part("pillars", 2 * self.pillars, "m", "vector to the middle of each"),
            Part(hunters, 2 * predators, "m", "vector to each", opponent=preys),
            Part(hunted, 2 * prey, "m", "vector to each; zeros if it is caught", opponent=not preys),
            Part(
                f"{hunted}, moving", 2 * prey, "m/s", "the velocity of each; zeros if it is caught", opponent=not preys
            ),
            Part("time", 1, "", "share of the episode that has passed"),
        )
        return tuple(part for part in parts if part.size)

    def entities(self, preys: bool) -> tuple[Entities, ...]:
        """Return the sets in the observation: pillars, predators, and prey with its place and velocity."""
        predators, prey = self._others(preys)
        hunters = 4 + 2 * self.pillars
        hunted = hunters + 2 * predators
        pairs = zip(entity_places(hunted, prey, 2), entity_places(hunted + 2 * prey, prey, 2), strict=True)
        sets = (
            Entities("pillars", entity_places(4, self.pillars, 2)),
            Entities("predators", entity_places(hunters, predators, 2)),
            Entities("prey", tuple(place + moving for place, moving in pairs)),
        )
        return tuple(each for each in sets if each.places)

    def observe(self, state: PlanarState, i: int) -> Array:
        """Return the observation of robot i."""
        others = jnp.asarray([j for j in range(len(state.xy)) if j != i], jnp.int32)
        shown = jnp.concatenate([jnp.ones(self.predators, bool), state.free])[others, None]
        gaps = jnp.where(shown, state.xy[others] - state.xy[i], 0.0)
        moving = jnp.where(shown, state.velocity[others], 0.0)[self._others(i >= self.predators)[0] :]
        parts = (state.velocity[i], state.xy[i], state.pillars - state.xy[i], gaps, moving, state.time)
        return jnp.concatenate([jnp.ravel(each) for each in parts])

    def read(self, observation: Array, preys: bool) -> PursuitView:
        """Split an observation into its parts."""
        predators, prey = self._others(preys)
        pairs = observation[:-1].reshape(-1, 2)
        pillars, hunters, hunted, moving = jnp.split(pairs[2:], np.cumsum([self.pillars, predators, prey]))
        return PursuitView(pairs[0], pairs[1], pillars, hunters, hunted, moving, observation[-1])

    def _others(self, preys: bool) -> tuple[int, int]:
        """Return the numbers of other predators and of other prey that prey (`preys`) or a predator observes."""
        return (self.predators, self.prey - 1) if preys else (self.predators - 1, self.prey)
