"""Collecting experience and playing matches, each one jitted `lax.scan`: nothing leaves the device per step.

T decisions, N worlds, K opponents: worlds are split into K groups of N/K, and in group k each agent acts with the k-th
policy of its crew.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from agents.policy import Crew, act, remember, units
from arenas.arena import Arena
from arenas.robots.robot import Script
from arenas.state import Frames, State

CUT_DICE = 0x7FFFFFFF  # the same key places the robots: an arena that splits it gets the keys of small numbers


Memory = Mapping[str, Array]  # (N, units) by the names of agents in whose crew somebody is recurrent


class Worlds(NamedTuple):
    """N worlds that live on from one rollout to the next."""

    state: State
    age: Array  # (N,) int32: decisions taken in the present episode
    left: Array  # (N,) int32: decisions until this episode, the first one here, is cut short; 0: it is not
    memory: Memory | None = None  # what who sits there remembers of the present episode; see `remembering`


class Trajectory(NamedTuple):
    """What happened in T decisions of N worlds. Dicts are keyed by agent name."""

    observations: dict[str, Array]  # (T, N, obs) that the agent acted on
    next_observations: dict[str, Array]  # (T, N, obs) that followed, before any new episode began
    actions: dict[str, Array]  # (T, N, act)
    log_probs: dict[str, Array]  # (T, N)
    alive: dict[str, Array]  # (T, N) bool: the agent took part in this decision
    next_alive: dict[str, Array]  # (T, N) bool: and in the state that followed
    reward: Array  # (T, N, teams) outcome
    shaping: Array  # (T, N, teams) dense hints
    score: Array  # (T, N, teams), meaningful where the episode ended and was not cut
    terminated: Array  # (T, N) bool
    truncated: Array  # (T, N) bool, also where it was cut
    void: Array  # (T, N) bool
    culprits: Array  # (T, N, teams) bool: whose robots made it void; none where that cannot be told
    cut: Array  # (T, N) bool: cut short so that worlds do not end together; its score counts for nobody
    age: Array  # (T, N) int32: decisions of the episode so far, this one included
    # (T, N, privileged_size) twice, the whole state before and after each decision, where a critic sees it:
    whole: tuple[Array, ...] = ()
    memories: Memory | None = None  # (T / chunk, N, units) before the first decision of each chunk, if asked for


class Seen(NamedTuple):
    """What critics judge by, of the recorded worlds R before each decision."""

    observations: dict[str, Array]  # (T, R, obs)
    alive: dict[str, Array]  # (T, R) bool
    whole: tuple[Array, ...]  # one, (T, R, privileged_size), of an arena that offers its whole state; else none


class Games(NamedTuple):
    """How one episode in each of N worlds ended, and what the recorded worlds R looked like."""

    score: Array  # (N, teams)
    void: Array  # (N,) bool
    culprits: Array  # (N, teams) bool: whose robots made it void; none where that cannot be told
    decisions: Array  # (N,) int: the length of each episode
    frames: Frames  # (T, hold, R, ...)
    actions: dict[str, Array]  # (T, R, act)
    reward: Array  # (T, R, teams)
    running: Array  # (T, R) bool: the episode was still on before this decision
    seen: Seen | None = None  # where it was asked for


Act = Callable[
    [Mapping[str, Crew], dict[str, Array], Array, Memory | None, Array],
    tuple[dict[str, Array], dict[str, Array], Memory | None],
]


def make_rollout(
    arena: Arena, length: int, chunk: int | None = None, privileged: bool = False
) -> jax.stages.Wrapped:  # fmt: skip
    """Compile the training rollout: `rollout(crews, worlds, key) -> (worlds, trajectory)` of `length` decisions.

    `crews` are by agent name, N is a multiple of their K groups. Finished worlds begin anew at once. The buffers of
    `worlds` are used up. With `privileged` the trajectory holds the whole state too, of an arena that offers it.
    Recurrent learners need what was remembered as each `chunk` of decisions began, into which the length is split.
    """
    if chunk is not None and length % chunk:
        raise ValueError(f"{length} decisions are no whole number of chunks of {chunk}")
    decide = _make_act(arena)
    whole = jax.vmap(arena.whole)

    def by_agent(alive: Array) -> dict[str, Array]:
        return {agent.name: alive[:, i] for i, agent in enumerate(arena.agents)}

    def rollout(crews: Mapping[str, Crew], worlds: Worlds, key: Array) -> tuple[Worlds, Trajectory]:
        number = worlds.age.shape[0]

        def decision(worlds: Worlds, key: Array) -> tuple[Worlds, Trajectory]:
            state = worlds.state
            act_key, place_key = jax.random.split(key)
            actions, log_probs, memory = decide(
                crews, state.observations, jax.random.split(act_key, number), worlds.memory, worlds.age == 0
            )
            after = jax.vmap(arena.step)(state, actions)
            verdict, age = after.verdict, worlds.age + 1
            cut = (worlds.left == 1) & ~after.done
            over = after.done | cut
            step = Trajectory(
                state.observations, after.observations, actions, log_probs,
                by_agent(state.alive), by_agent(after.alive), verdict.reward, verdict.shaping, verdict.score,
                verdict.terminated, verdict.truncated | cut, after.void, after.culprits, cut, age,
                (whole(state), whole(after)) if privileged else (),
            )  # fmt: skip
            fresh = jax.vmap(arena.restart)(after, jax.random.split(place_key, number), over)
            left = jnp.where(over, 0, jnp.maximum(worlds.left - 1, 0))
            return Worlds(fresh, jnp.where(over, 0, age), left, memory), step

        def stretch(worlds: Worlds, keys: Array) -> tuple[Worlds, tuple[Memory | None, Trajectory]]:
            after, steps = jax.lax.scan(decision, worlds, keys)
            return after, (worlds.memory, steps)

        worlds, keys = remembering(worlds, crews), jax.random.split(key, length)
        if chunk is None:
            return jax.lax.scan(decision, worlds, keys)
        worlds, (memories, steps) = jax.lax.scan(stretch, worlds, keys.reshape(-1, chunk))
        steps = jax.tree.map(lambda x: x.reshape(length, *x.shape[2:]), steps)
        return worlds, steps._replace(memories=memories)

    return _compiled(rollout, donate_argnums=1)


def make_reset(arena: Arena, stagger: bool = True) -> jax.stages.Wrapped:
    """Compile `reset(keys (N,)) -> Worlds` of N fresh worlds.

    Worlds that begin together would end together, and every few iterations a batch would hold little but the ends of
    episodes. With `stagger` each first episode is cut after a number of decisions drawn evenly up to the longest.
    """

    def reset(keys: Array) -> Worlds:
        left = _cuts(arena, keys) if stagger else jnp.zeros(keys.shape[0], jnp.int32)
        return Worlds(jax.vmap(arena.reset)(keys), jnp.zeros(keys.shape[0], jnp.int32), left)

    return _compiled(reset)


def make_restart(arena: Arena, stagger: bool = True) -> jax.stages.Wrapped:
    """Compile `restart(worlds, keys (N,), where (N,) bool) -> Worlds`: chosen worlds begin anew, as after `make_reset`.

    For worlds whose opponents changed: half an episode against one and half against another is neither's game. What was
    under way there is lost. The buffers of `worlds` are used up.
    """

    def restart(worlds: Worlds, keys: Array, where: Array) -> Worlds:
        state = jax.vmap(arena.restart)(worlds.state, keys, where)
        left = _cuts(arena, keys) if stagger else jnp.zeros_like(worlds.left)
        return Worlds(state, jnp.where(where, 0, worlds.age), jnp.where(where, left, worlds.left), worlds.memory)

    return _compiled(restart, donate_argnums=0)


def remembering(worlds: Worlds, crews: Mapping[str, Crew]) -> Worlds:
    """The worlds with memory as wide as these crews need; what is remembered in them stays.

    Whatever a world holds there is forgotten where its episode begins: in fresh worlds, after an episode's end, and
    where `make_restart` has begun it anew because others sit there now.
    """
    return worlds._replace(memory=_fitted(worlds.memory, crews, worlds.age.shape[0]))


def make_play(
    arena: Arena, recorded: tuple[int, ...] = (), seen: bool = False, privileged: bool = False
) -> jax.stages.Wrapped:  # fmt: skip
    """Compile a match: `play(crews, keys (N,)) -> Games`, one whole episode in every world.

    Every world plays exactly one episode, so that short episodes do not count more often than long ones. A world's key
    fixes its start and its dice; worlds with equal keys are a seed pair. `recorded` are the worlds to keep frames of,
    and with `seen` what critics see of them; with `privileged` that is the whole state, of an arena that offers it.
    """
    decide, whole = _make_act(arena), jax.vmap(arena.whole)
    kept = jnp.asarray(recorded, jnp.int32)

    def sight(state: State) -> Seen:
        state = jax.tree.map(lambda x: x[kept], state)
        alive = {agent.name: state.alive[:, i] for i, agent in enumerate(arena.agents)}
        return Seen(state.observations, alive, (whole(state),) if privileged else ())

    def play(crews: Mapping[str, Crew], keys: Array) -> Games:
        start, dice = jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, 2))(keys), 1, 0)

        def decision(carry: tuple[State, Memory | None], t: Array) -> tuple[tuple[State, Memory | None], tuple]:
            state, memory = carry
            keys = jax.vmap(lambda key: jax.random.fold_in(key, t))(dice)
            actions, _, memory = decide(crews, state.observations, keys, memory, jnp.broadcast_to(t == 0, keys.shape))
            after, frames = jax.vmap(arena.step_with_frames)(state, actions)
            watched = (
                jax.tree.map(lambda x: jnp.moveaxis(x[kept], 0, 1), frames),
                {name: a[kept] for name, a in actions.items()},
                after.verdict.reward[kept],
                ~state.done[kept],
                sight(state) if seen else None,
            )
            return (after, memory), (watched, ~state.done)

        state = jax.vmap(arena.reset)(start)
        (state, _), ((frames, actions, reward, running, seen_by), on) = jax.lax.scan(
            decision, (state, _fitted(None, crews, keys.shape[0])), jnp.arange(arena.timing.decisions)
        )
        return Games(
            state.verdict.score, state.void, state.culprits, on.sum(axis=0), frames, actions, reward, running, seen_by
        )  # fmt: skip

    return _compiled(play)


def scripts_of(arena: Arena, kind: str) -> dict[str, Script]:
    """The scripts that a robot of this kind can play, by name; their places are their numbers in a crew."""
    return {name: kinds[kind] for name, kinds in arena.scripts().items() if kind in kinds}


def _compiled(function: Callable, **options: Any) -> jax.stages.Wrapped:
    """`jax.jit` on this process's device. Arrays that came over from torch are bound to it and others are not: left to
    itself, JAX compiles anew for every mix of the two.
    """
    return jax.jit(function, in_shardings=jax.sharding.SingleDeviceSharding(jax.devices()[0]), **options)


def _cuts(arena: Arena, keys: Array) -> Array:
    """Decisions (N,) until a first episode is cut, drawn evenly up to the longest episode."""
    own = jax.vmap(lambda key: jax.random.fold_in(key, CUT_DICE))(keys)
    return jax.vmap(lambda key: jax.random.randint(key, (), 1, arena.timing.decisions + 1))(own)


def _fitted(memory: Memory | None, crews: Mapping[str, Crew], number: int) -> Memory | None:
    """The memory of so many worlds, its columns cut or followed by zeros as these crews need; None if they need none.

    Zeros are what everybody remembers at first.
    """
    found = {}
    for agent, members in crews.items():
        if width := units(members):
            before = (memory or {}).get(agent, jnp.zeros((number, 0)))[:, :width]
            found[agent] = jnp.pad(before, ((0, 0), (0, width - before.shape[1])))
    return found or None


def _make_act(arena: Arena) -> Act:
    """decide(crews, observations, keys (N,), memory, first (N,)) -> (actions, log_probs, memory) by agent name."""
    scripts = {agent.kind: tuple(scripts_of(arena, agent.kind).values()) for agent in arena.agents}

    def decide(
        crews: Mapping[str, Crew], observations: dict[str, Array], keys: Array, memory: Memory | None, first: Array
    ) -> tuple[dict[str, Array], dict[str, Array], Memory | None]:
        actions, log_probs, after = {}, {}, dict(memory or {})
        for i, agent in enumerate(arena.agents):
            own = jax.vmap(lambda key: jax.random.fold_in(key, i))(keys)  # noqa: B023  (called at once)
            members, seen = crews[agent.name], observations[agent.name]
            if agent.name in after:
                after[agent.name] = remember(members, seen, after[agent.name], first)
            actions[agent.name], log_probs[agent.name] = act(
                members, seen, own, scripts[agent.kind], after.get(agent.name)
            )
        return actions, log_probs, after or None

    return decide
