"""Metrics of a rollout. Each is one program, because JAX takes up to a millisecond to start a single operation."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.rollout.rollout import Trajectory
from agents.rollout.team_view import select_agents, take_worlds
from arenas.description import EVENT_METRIC
from arenas.physics.void_causes import METRIC_PREFIX, Cause
from arenas.state import mean_pairwise_score

ALL = slice(None)
COUNTS = "episodes", "counted", "voids", "own_voids"
EPISODE, DECISION = ("score", "length"), ("reward", "shaping")  # means over episodes, and over decisions


def rollout_metrics(
    trajectory: Trajectory,
    index: int,
    worlds: slice | np.ndarray,
    sum_over_ranks: Callable[[list[float]], list[float]] = lambda sums: sums,
) -> dict[str, float]:
    """Return metrics of a team in its `worlds` for its learning curve, all finite.

    `reward` and `shaping`, and each of several terms of either (`reward.result`), are means per decision that was not
    void. `episodes` is the number of episodes that ended by the rules, `counted` that of those among them whose world
    had run for the longest episode before (in new worlds short ones end first, see `new_worlds`). The mean `score` of
    the counted, against all other teams, their `length` in decisions and the share of them in which an event happened
    to the team (`event.goal`) are present only if there is one. `voids` counts void decisions, `own_voids` those that
    the team's own robots caused, and `void.pairs` and the like those of each cause that occurred
    (arenas.physics.void_causes). If the worlds are split over processes, `sum_over_ranks` sums a list of numbers over
    them.
    """
    length, number = trajectory.void.shape
    chosen = np.arange(number)[worlds]
    told = select_agents(trajectory)._replace(terms=trajectory.terms, events=trajectory.events)
    terms, events = sorted(told.terms), [f"{EVENT_METRIC}{name}" for name in sorted(told.events)]
    names = *COUNTS, *EPISODE, *DECISION, *Cause, *terms, *events
    size, *found = sum_over_ranks([length * chosen.size, *np.asarray(_sums(told, index, chosen)).tolist()])
    sums = dict(zip(names, found, strict=True))
    counted, decisions = sums["counted"], max(size - sums["voids"], 1)
    figures = {
        **{name: sums[name] for name in COUNTS},
        **{name: sums[name] / decisions for name in (*DECISION, *terms)},
        **{f"{METRIC_PREFIX}{cause.key}": sums[cause] for cause in Cause if sums[cause]},
    }
    return figures | {name: sums[name] / counted for name in (*EPISODE, *events) if counted}


def episode_results(
    trajectory: Trajectory,
    index: int,
    groups: int,
    sum_over_ranks: Callable[[list[float]], list[float]] = lambda sums: sums,
) -> np.ndarray:
    """Return (groups, teams, 4) results of a team against each team in each of equal groups of worlds.

    Results are the numbers of episodes won, drawn, lost and void; against itself a team draws. Cut episodes do not
    count, nor any before the world has run for the longest episode. `sum_over_ranks` is as for `rollout_metrics`.
    """
    counts = np.asarray(_count_results(select_agents(trajectory), index, groups))
    return np.array(sum_over_ranks(counts.ravel().astype(float).tolist())).reshape(groups, -1, 4)


@partial(jax.jit, static_argnums=1)
def _sums(trajectory: Trajectory, index: int, worlds: Array) -> Array:
    """Return (14 + terms + events,) counts and sums of a team in its worlds.

    Episodes, counted episodes, void decisions, own void decisions; sums of score and length over counted episodes, of
    reward and dense reward; void decisions by cause; sums of each term of the rewards; counted episodes in which each
    event happened.
    """
    own = take_worlds(trajectory, worlds)
    whole = (own.terminated | own.truncated) & ~own.cut
    counted = whole if own.settled is None else whole & own.settled
    why = jnp.zeros(own.void.shape, jnp.uint8) if own.causes is None else own.causes

    def total(values: Array, where: Array) -> Array:
        return jnp.where(where, values, 0).sum()

    scores = mean_pairwise_score(own.score), own.reward, own.shaping
    score, reward, shaping = (values[..., index] for values in scores)
    return jnp.stack([
        whole.sum(), counted.sum(), own.void.sum(), (own.void & own.at_fault[..., index]).sum(), total(score, counted),
        total(own.age, counted), total(reward, ~own.void), total(shaping, ~own.void),
        *((own.void & (why & int(cause) != 0)).sum() for cause in Cause),
        *(total(own.terms[name][..., index], ~own.void) for name in sorted(own.terms)),
        *((own.events[name][..., index] & counted).sum() for name in sorted(own.events)),
    ])  # fmt: skip


@partial(jax.jit, static_argnums=(1, 2))
def _count_results(trajectory: Trajectory, index: int, groups: int) -> Array:
    """Return the counts of `episode_results`."""
    ahead = trajectory.score[..., index, None] - trajectory.score  # (T, N, teams)
    settled = jnp.ones_like(trajectory.void) if trajectory.settled is None else trajectory.settled
    whole = ((trajectory.terminated | trajectory.truncated) & ~trajectory.cut & ~trajectory.void & settled)[..., None]
    void = jnp.broadcast_to((trajectory.void & settled)[..., None], ahead.shape)
    ended = jnp.stack([whole & (ahead > 0), whole & (ahead == 0), whole & (ahead < 0), void], axis=-1)
    length, number, teams, _ = ended.shape
    return ended.reshape(length, groups, number // groups, teams, 4).sum((0, 2))
