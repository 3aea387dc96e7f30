"""What came of a rollout. Each answer is one program, for JAX takes up to a millisecond to begin a single operation."""

from collections.abc import Callable, Collection, Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.rollout import Trajectory

ALL = slice(None)


def watched(trajectory: Trajectory, agents: Collection[str] = (), whole: bool = False) -> Trajectory:
    """The trajectory with what these agents alone saw and did, and the whole state only where it is asked for.

    Each array that is handed to a program costs time, and is copied where some of the worlds are chosen.
    """

    def own(values: Mapping[str, Array]) -> dict[str, Array]:
        return {name: array for name, array in values.items() if name in agents}

    return trajectory._replace(
        observations=own(trajectory.observations), next_observations=own(trajectory.next_observations),
        actions=own(trajectory.actions), log_probs=own(trajectory.log_probs), alive=own(trajectory.alive),
        next_alive=own(trajectory.next_alive), whole=trajectory.whole if whole else (),
        memories=own(trajectory.memories or {}),
    )  # fmt: skip


def of_worlds(trajectory: Trajectory, worlds: slice | np.ndarray) -> Trajectory:
    """The trajectory in some of its worlds; in all of them it is not copied."""
    if isinstance(worlds, slice) and worlds == ALL:
        return trajectory
    return _taken(trajectory, np.arange(trajectory.void.shape[1])[worlds])


def outcomes(
    trajectory: Trajectory,
    index: int,
    worlds: slice | np.ndarray,
    everywhere: Callable[[list[float]], list[float]] = lambda sums: sums,
) -> dict[str, float]:
    """How a team fared in its `worlds`: figures for its learning curve, all finite.

    `reward` and `shaping` are means per decision that was not void. `episodes` counts those that ended by the rules;
    their mean `score` and `length` in decisions are there only if one did. `voids` counts the void ones, `own_voids`
    those that the team's own robots made so. Where other processes have a part of the worlds too, `everywhere` adds
    theirs to each of some sums.
    """
    length, number = trajectory.void.shape
    chosen = np.arange(number)[worlds]
    size, episodes, voids, own_voids, *sums = everywhere(
        [length * chosen.size, *np.asarray(_sums(watched(trajectory), index, chosen)).tolist()]
    )
    decisions = max(size - voids, 1)
    figures = {
        "episodes": episodes, "voids": voids, "own_voids": own_voids,
        "reward": sums[2] / decisions, "shaping": sums[3] / decisions,
    }  # fmt: skip
    return {**figures, "score": sums[0] / episodes, "length": sums[1] / episodes} if episodes else figures


def results(
    trajectory: Trajectory,
    index: int,
    groups: int,
    everywhere: Callable[[list[float]], list[float]] = lambda sums: sums,
) -> np.ndarray:
    """(groups, 4) Episodes that a team won, drew and lost, and void ones, in each of equal groups of worlds.

    Episodes that were cut count for nobody. Of several other teams the best one counts; a team alone wins where it
    succeeds. `everywhere` is as for `outcomes`.
    """
    counts = np.asarray(_ended(watched(trajectory), index, groups))
    return np.array(everywhere(counts.ravel().astype(float).tolist())).reshape(groups, 4)


@jax.jit
def _taken(trajectory: Trajectory, worlds: Array) -> Trajectory:
    return jax.tree.map(lambda values: values[:, worlds], trajectory)


@partial(jax.jit, static_argnums=1)
def _sums(trajectory: Trajectory, index: int, worlds: Array) -> Array:
    """(7,) Episodes, void decisions, own ones; sums of score and length over episodes, of reward and hints."""
    own = _taken(trajectory, worlds)
    whole = (own.terminated | own.truncated) & ~own.cut

    def total(values: Array, where: Array) -> Array:
        return jnp.where(where, values, 0).sum()

    score, reward, shaping = (values[..., index] for values in (own.score, own.reward, own.shaping))
    return jnp.stack([
        whole.sum(), own.void.sum(), (own.void & own.culprits[..., index]).sum(), total(score, whole),
        total(own.age, whole), total(reward, ~own.void), total(shaping, ~own.void),
    ])  # fmt: skip


@partial(jax.jit, static_argnums=(1, 2))
def _ended(trajectory: Trajectory, index: int, groups: int) -> Array:
    """(groups, 4) As `results`."""
    own, others = trajectory.score[..., index], jnp.delete(trajectory.score, index, axis=-1)
    ahead = own - (others.max(-1) if others.shape[-1] else 0.5)
    whole = (trajectory.terminated | trajectory.truncated) & ~trajectory.cut & ~trajectory.void
    ended = jnp.stack([whole & (ahead > 0), whole & (ahead == 0), whole & (ahead < 0), trajectory.void], axis=-1)
    length, number, _ = ended.shape
    return ended.reshape(length, groups, number // groups, 4).sum((0, 2))
