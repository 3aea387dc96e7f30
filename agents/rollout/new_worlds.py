"""Worlds that begin, all together or some of them, and from when on the episodes that end there count.

Worlds that begin together would end together, and every few iterations a batch would hold little but the ends of
episodes. So each first episode is cut after a uniformly random number of decisions, up to the longest.

Of the episodes that begin with a world the short ones end first. Where a robot that scores ends an episode and one that
fails waits for the time limit, nearly all of the first episodes to end are successes. Episodes therefore count for
scores, lengths and events only once their world has run for as many decisions as the longest of them has: then those
that end are a fair sample of all.
"""

import jax
import jax.numpy as jnp
from jax import Array

from agents.rollout.rollout import Worlds, compiled, unless
from arenas.arena import Arena

CUT_SEED = 0x7FFFFFFF  # folded into the key that also places the robots; an arena may use the small numbers


def make_reset(arena: Arena, stagger: bool = True, settle: bool = True) -> jax.stages.Wrapped:
    """Compile `reset(keys (N,)) -> Worlds` of N new worlds.

    With `stagger` each first episode is cut at random. Without `settle` all episodes count that were not cut.
    """

    def reset(keys: Array) -> Worlds:
        number = keys.shape[0]
        left = _cuts(arena, keys) if stagger else jnp.zeros(number, jnp.int32)
        state = jax.vmap(arena.reset)(keys)
        nothing = jax.tree.map(jnp.zeros_like, state.verdict.events)
        return Worlds(state, jnp.zeros(number, jnp.int32), left, _unsettled(arena, number, settle), events=nothing)

    return compiled(reset)


def make_restart(arena: Arena, stagger: bool = True, settle: bool = True) -> jax.stages.Wrapped:
    """Compile `restart(worlds, keys (N,), where (N,) bool) -> Worlds`: chosen worlds restart as after `make_reset`.

    It is for worlds whose opponents changed: an episode against two opponents in turn belongs to neither. The episodes
    under way there are lost. The buffers of `worlds` are donated.
    """

    def restart(worlds: Worlds, keys: Array, where: Array) -> Worlds:
        state = jax.vmap(arena.restart)(worlds.state, keys, where)
        left = _cuts(arena, keys) if stagger else jnp.zeros_like(worlds.left)
        age, left = jnp.where(where, 0, worlds.age), jnp.where(where, left, worlds.left)
        unsettled = jnp.where(where, _unsettled(arena, keys.shape[0], settle), worlds.unsettled)
        return Worlds(state, age, left, unsettled, worlds.memory, unless(where, worlds.events))

    return compiled(restart, donate_argnums=0)


def _cuts(arena: Arena, keys: Array) -> Array:
    """Return the decisions (N,) until a first episode is cut, uniform up to the longest episode."""
    own = jax.vmap(lambda key: jax.random.fold_in(key, CUT_SEED))(keys)
    return jax.vmap(lambda key: jax.random.randint(key, (), 1, arena.timing.decisions + 1))(own)


def _unsettled(arena: Arena, number: int, settle: bool) -> Array:
    """Return the decisions (N,) until the episodes that end in a new world count: those of the longest, or none."""
    return jnp.full(number, arena.timing.decisions if settle else 0, jnp.int32)
