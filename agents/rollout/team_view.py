"""Slices of a trajectory: the arrays of some agents, and some of the worlds."""

from collections.abc import Collection, Mapping

import jax
import numpy as np
from jax import Array

from agents.rollout.rollout import Trajectory

ALL = slice(None)


def select_agents(trajectory: Trajectory, agents: Collection[str] = (), whole: bool = False) -> Trajectory:
    """Return the trajectory with the observations and actions of these agents only, and the full state only on request.

    Terms of rewards and events, from which nobody learns, are left out. Each array that is passed to a program takes
    time, and is copied where some of the worlds are selected.
    """

    def own(values: Mapping[str, Array]) -> dict[str, Array]:
        return {name: array for name, array in values.items() if name in agents}

    return trajectory._replace(
        observations=own(trajectory.observations), next_observations=own(trajectory.next_observations),
        actions=own(trajectory.actions), log_probs=own(trajectory.log_probs), alive=own(trajectory.alive),
        next_alive=own(trajectory.next_alive), whole=trajectory.whole if whole else (),
        memories=own(trajectory.memories or {}), terms={}, events={},
    )  # fmt: skip


def select_worlds(trajectory: Trajectory, worlds: slice | np.ndarray) -> Trajectory:
    """Return the trajectory in some of its worlds; for all of them it is not copied."""
    if isinstance(worlds, slice) and worlds == ALL:
        return trajectory
    return take_worlds(trajectory, np.arange(trajectory.void.shape[1])[worlds])


@jax.jit
def take_worlds(trajectory: Trajectory, worlds: Array | np.ndarray) -> Trajectory:
    """Return a copy of the trajectory in the worlds with these indices (n,), as one program."""
    return jax.tree.map(lambda values: values[:, worlds], trajectory)
