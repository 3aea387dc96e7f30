"""Rollouts for training and matches, each one jitted `lax.scan`: no data leaves the device between steps.

T decisions, N worlds, K opponents: the worlds are split into K groups of N / K, and in group k each agent acts by the
k-th policy of its stack.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.policy.jax_policy import Decision, PolicyStack, decide, memory_size
from arenas.arena import Arena
from arenas.robots.robot import Script
from arenas.state import Frames, State, Verdict

Memory = Mapping[str, Array]  # (N, units) by agent name, for agents with a policy in their stack that remembers
Events = dict[str, Array]  # (N, teams) bool by name
Frozen = Mapping[str, np.ndarray]  # (N, obs) bool by agent name: numbers that its policy sees as they were at the start


class Worlds(NamedTuple):
    """N worlds that continue from one rollout to the next."""

    state: State
    age: Array  # (N,) int32: decisions taken in the current episode
    left: Array  # (N,) int32: decisions until the first episode of a new world is cut; 0: it is not cut
    unsettled: Array  # (N,) int32: decisions until episodes that end here are like all others, see `new_worlds`
    memory: Memory | None = None  # hidden states in the current episode, see `with_memory`
    events: Events = {}  # noqa: RUF012  (it has happened to the team in the current episode)


class Trajectory(NamedTuple):
    """Experience of T decisions in N worlds. Dicts are keyed by agent name."""

    observations: dict[str, Array]  # (T, N, obs) before the decision
    next_observations: dict[str, Array]  # (T, N, obs) after the decision, before a new episode begins
    actions: dict[str, Array]  # (T, N, act) what policies chose: over skills, their commands (`jax_policy.Decision`)
    log_probs: dict[str, Array]  # (T, N)
    alive: dict[str, Array]  # (T, N) bool: the agent took part in this decision
    next_alive: dict[str, Array]  # (T, N) bool: the same in the state that followed
    reward: Array  # (T, N, teams) outcome
    shaping: Array  # (T, N, teams) dense reward
    score: Array  # (T, N, teams), meaningful where the episode ended and was not cut
    terminated: Array  # (T, N) bool
    truncated: Array  # (T, N) bool, also where it was cut
    void: Array  # (T, N) bool
    at_fault: Array  # (T, N, teams) bool: their robots made the world void; all False if that is unclear
    cut: Array  # (T, N) bool: cut so that worlds do not end together; the score counts for no team
    age: Array  # (T, N) int32: decisions of the episode so far, this one included
    # (T, N, privileged_size) twice: the full state before and after each decision, where a critic observes it:
    whole: tuple[Array, ...] = ()
    memories: Memory | None = None  # (T / chunk, N, units) before the first decision of each chunk, if requested
    causes: Array | None = None  # (T, N) uint8, bits of `void_causes.Cause`; None where not recorded
    terms: dict[str, Array] = {}  # noqa: RUF012  ((T, N, teams) parts of `reward` and `shaping`: `reward.result`, ...)
    events: dict[str, Array] = {}  # noqa: RUF012  ((T, N, teams) bool: it has happened in the episode so far)
    settled: Array | None = None  # (T, N) bool: an episode that ends here is like all others; None: everywhere


class CriticObservations(NamedTuple):
    """Input of critics in the recorded worlds R, before each decision."""

    observations: dict[str, Array]  # (T, R, obs)
    alive: dict[str, Array]  # (T, R) bool
    whole: tuple[Array, ...]  # one array (T, R, privileged_size) if the arena offers its full state, else none


class PlayedEpisodes(NamedTuple):
    """Results of one episode in each of N worlds, and records of the recorded worlds R."""

    score: Array  # (N, teams)
    void: Array  # (N,) bool
    at_fault: Array  # (N, teams) bool: their robots made the world void; all False if that is unclear
    decisions: Array  # (N,) int: the length of each episode
    frames: Frames  # (T, hold, R, ...)
    actions: dict[str, Array]  # (T, R, act)
    reward: Array  # (T, R, teams)
    running: Array  # (T, R) bool: the episode had not ended before this decision
    seen: CriticObservations | None = None  # if requested
    causes: Array | None = None  # (N,) uint8, bits of `void_causes.Cause`; None where not recorded
    events: Events = {}  # noqa: RUF012  (it happened to the team in the episode)


Act = Callable[
    [Mapping[str, PolicyStack], dict[str, Array], Array, Memory | None, Array, Array | None],
    tuple[dict[str, Decision], Memory | None],
]


def make_rollout(
    arena: Arena, length: int, chunk: int | None = None, privileged: bool = False
) -> jax.stages.Wrapped:  # fmt: skip
    """Compile the training rollout: `rollout(stacks, worlds, key) -> (worlds, trajectory)` of `length` decisions.

    `stacks` are keyed by agent name; N must be a multiple of their K groups. Finished worlds restart at once. The
    buffers of `worlds` are donated. With `privileged` the trajectory also holds the full state, if the arena offers it.
    For recurrent learners it holds the hidden states at the start of each `chunk` of decisions. Raises ValueError if
    `length` is no multiple of `chunk`.
    """
    if chunk is not None and length % chunk:
        raise ValueError(f"{length} decisions are no whole number of chunks of {chunk}")
    let_act = _make_act(arena)
    whole = jax.vmap(arena.privileged_state)

    def by_agent(alive: Array) -> dict[str, Array]:
        return {agent.name: alive[:, i] for i, agent in enumerate(arena.agents)}

    def rollout(stacks: Mapping[str, PolicyStack], worlds: Worlds, key: Array) -> tuple[Worlds, Trajectory]:
        number = worlds.age.shape[0]

        def decision(worlds: Worlds, moment: tuple[Array, Array]) -> tuple[Worlds, Trajectory]:
            state, (key, tick) = worlds.state, moment
            act_key, place_key = jax.random.split(key)
            decisions, memory = let_act(
                stacks, state.observations, jax.random.split(act_key, number), worlds.memory, worlds.age == 0, tick
            )
            after = jax.vmap(arena.step)(state, {agent: each.actions for agent, each in decisions.items()})
            verdict, age = after.verdict, worlds.age + 1
            events = jax.tree.map(jnp.logical_or, worlds.events, verdict.events)
            cut = (worlds.left == 1) & ~after.done
            over = after.done | cut
            step = Trajectory(
                state.observations, after.observations,
                {agent: each.choices for agent, each in decisions.items()},
                {agent: each.log_probs for agent, each in decisions.items()},
                by_agent(state.alive), by_agent(after.alive), verdict.reward, verdict.shaping, verdict.score,
                verdict.terminated, verdict.truncated | cut, after.void, after.at_fault, cut, age,
                (whole(state), whole(after)) if privileged else (), causes=after.causes, terms=_terms(verdict),
                events=events, settled=worlds.unsettled == 0,
            )  # fmt: skip
            fresh = jax.vmap(arena.restart)(after, jax.random.split(place_key, number), over)
            left = jnp.where(over, 0, jnp.maximum(worlds.left - 1, 0))
            unsettled = jnp.maximum(worlds.unsettled - 1, 0)
            return Worlds(fresh, jnp.where(over, 0, age), left, unsettled, memory, unless(over, events)), step

        def stretch(worlds: Worlds, moments: tuple[Array, Array]) -> tuple[Worlds, tuple[Memory | None, Trajectory]]:
            after, steps = jax.lax.scan(decision, worlds, moments)
            return after, (worlds.memory, steps)

        worlds, moments = with_memory(worlds, stacks), (jax.random.split(key, length), jnp.arange(length))
        if chunk is None:
            return jax.lax.scan(decision, worlds, moments)
        chunks = jax.tree.map(lambda x: x.reshape(-1, chunk), moments)
        worlds, (memories, steps) = jax.lax.scan(stretch, worlds, chunks)
        steps = jax.tree.map(lambda x: x.reshape(length, *x.shape[2:]), steps)
        return worlds, steps._replace(memories=memories)

    return compiled(rollout, donate_argnums=1)


def _terms(verdict: Verdict) -> dict[str, Array]:
    """Return the terms of reward and of dense reward by their curves' names; one that has no other beside it is left
    out, because it is the whole.
    """
    kinds = (("reward", verdict.rewards), ("shaping", verdict.shapings))
    return {f"{kind}.{name}": x for kind, terms in kinds if len(terms) > 1 for name, x in terms.items()}


def unless(over: Array, events: Events) -> Events:
    """Return the events of episodes that go on; where the episode is `over` (N,) bool nothing has happened yet."""
    return jax.tree.map(lambda happened: happened & ~over[:, None], events)


def with_memory(worlds: Worlds, stacks: Mapping[str, PolicyStack]) -> Worlds:
    """Return the worlds with hidden states as wide as these stacks need; existing states stay.

    A hidden state is ignored where an episode begins: in new worlds, after an episode's end, and where `make_restart`
    has restarted a world because its policies changed.
    """
    return worlds._replace(memory=_fit_memory(worlds.memory, stacks, worlds.age.shape[0]))


class MatchState(NamedTuple):
    """One episode in each of N worlds, between two series of decisions."""

    state: State
    memory: Memory | None
    episode_keys: Array  # (N,) keys
    decisions: Array  # (N,) int32: length of each episode so far
    at: Array  # () int32: decisions of the longest episode so far
    events: Events  # it has happened to the team in this episode
    first: dict[str, Array] | None = None  # (N, obs) at the start, of agents whose observations are partly frozen


class EpisodeRecords(NamedTuple):
    """Records of the worlds R over T decisions of a match; its fields are those of `PlayedEpisodes`."""

    frames: Frames
    actions: dict[str, Array]
    reward: Array
    running: Array
    seen: CriticObservations | None


def make_play(
    arena: Arena, recorded: tuple[int, ...] = (), seen: bool = False, privileged: bool = False,
    frozen: Frozen | None = None,
) -> jax.stages.Wrapped:  # fmt: skip
    """Compile a match: `play(stacks, keys (N,)) -> PlayedEpisodes`, one full episode in every world.

    Every world plays exactly one episode, so that short episodes do not count more often than long ones. A world's key
    determines its start and its random numbers; worlds with equal keys are a seed pair. `recorded` are the worlds to
    record, with `seen` also the critics' input, and with `privileged` the full state if the arena offers it. Numbers of
    observations that are `frozen` are given to policies as they were at the start.
    """
    begin, go_on = _match(arena, recorded, seen, privileged, frozen or {})

    def play(stacks: Mapping[str, PolicyStack], keys: Array) -> PlayedEpisodes:
        match_state, records = go_on(stacks, begin(stacks, keys), arena.timing.decisions)
        return finish_match(match_state, records)

    return compiled(play)


def make_stepwise_play(
    arena: Arena, length: int, recorded: tuple[int, ...] = ()
) -> tuple[jax.stages.Wrapped, jax.stages.Wrapped]:
    """Compile a match that is played piece by piece, so that other programs can use the device in between.

    Returns:
        `begin(stacks, keys (N,)) -> MatchState`, and `go_on(stacks, match_state) -> (MatchState, EpisodeRecords,
        over)`,
        which plays `length` decisions and donates the buffers of `match_state`; `over` () bool: all episodes have
        ended.
        Then `finish_match` returns the same episodes as `make_play`.
    """
    begin, go_on = _match(arena, recorded)

    def stretch(stacks: Mapping[str, PolicyStack], match_state: MatchState) -> tuple[MatchState, EpisodeRecords, Array]:
        after, records = go_on(stacks, match_state, length)
        return after, records, after.state.done.all() | (after.at >= arena.timing.decisions)

    return compiled(begin), compiled(stretch, donate_argnums=1)


def finish_match(match_state: MatchState, records: EpisodeRecords) -> PlayedEpisodes:
    """Return the episodes of a match once all of them have ended."""
    state = match_state.state
    return PlayedEpisodes(
        state.verdict.score, state.void, state.at_fault, match_state.decisions, *records, causes=state.causes,
        events=match_state.events,
    )  # fmt: skip


def _match(
    arena: Arena, recorded: tuple[int, ...], seen: bool = False, privileged: bool = False, frozen: Frozen | None = None
) -> tuple[
    Callable[[Mapping[str, PolicyStack], Array], MatchState],
    Callable[[Mapping[str, PolicyStack], MatchState, int], tuple[MatchState, EpisodeRecords]],
]:  # fmt: skip
    """Return the functions that begin a match and play its next decisions."""
    let_act, whole = _make_act(arena), jax.vmap(arena.privileged_state)
    kept, masks = jnp.asarray(recorded, jnp.int32), frozen or {}

    def critic_observations(state: State) -> CriticObservations:
        state = jax.tree.map(lambda x: x[kept], state)
        alive = {agent.name: state.alive[:, i] for i, agent in enumerate(arena.agents)}
        return CriticObservations(state.observations, alive, (whole(state),) if privileged else ())

    def begin(stacks: Mapping[str, PolicyStack], keys: Array) -> MatchState:
        start, episode_keys = jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, 2))(keys), 1, 0)
        number, state = keys.shape[0], jax.vmap(arena.reset)(start)
        first = {agent: state.observations[agent] for agent in masks} or None
        return MatchState(
            state, _fit_memory(None, stacks, number), episode_keys, jnp.zeros(number, jnp.int32),
            jnp.zeros((), jnp.int32), jax.tree.map(jnp.zeros_like, state.verdict.events), first,
        )  # fmt: skip

    def go_on(
        stacks: Mapping[str, PolicyStack], match_state: MatchState, length: int
    ) -> tuple[MatchState, EpisodeRecords]:
        episode_keys, first = match_state.episode_keys, match_state.first or {}

        def decision(carry: tuple[State, Memory | None, Events], t: Array) -> tuple[tuple, tuple]:
            state, memory, events = carry
            keys = jax.vmap(lambda key: jax.random.fold_in(key, t))(episode_keys)
            shown = state.observations | {
                agent: jnp.where(mask, first[agent], state.observations[agent]) for agent, mask in masks.items()
            }
            decisions, memory = let_act(stacks, shown, keys, memory, jnp.broadcast_to(t == 0, keys.shape), None)
            actions = {agent: each.actions for agent, each in decisions.items()}
            after, frames = jax.vmap(arena.step_with_frames)(jax.vmap(arena.rest_if_done)(state), actions)
            records = EpisodeRecords(
                jax.tree.map(lambda x: jnp.moveaxis(x[kept], 0, 1), frames),
                {name: a[kept] for name, a in actions.items()},
                after.verdict.reward[kept],
                ~state.done[kept],
                critic_observations(state) if seen else None,
            )
            events = jax.tree.map(jnp.logical_or, events, after.verdict.events)  # an ended episode keeps its verdict
            return (after, memory, events), (records, ~state.done)

        (state, memory, events), (records, on) = jax.lax.scan(
            decision,
            (match_state.state, match_state.memory, match_state.events),
            match_state.at + jnp.arange(length),
        )
        decisions = match_state.decisions + on.sum(axis=0, dtype=jnp.int32)
        return match_state._replace(
            state=state, memory=memory, decisions=decisions, at=match_state.at + length, events=events
        ), records

    return begin, go_on


def scripts_for(arena: Arena, kind: str) -> dict[str, Script]:
    """Return the scripts for robots of this kind by name; positions are their numbers in a policy stack."""
    return {name: kinds[kind] for name, kinds in arena.scripts().items() if kind in kinds}


def compiled(function: Callable, **options: Any) -> jax.stages.Wrapped:
    """Apply `jax.jit` with all inputs on this process's device.

    Arrays that came from torch are bound to the device and others are not; without this, JAX recompiles for every
    mix of the two.
    """
    return jax.jit(function, in_shardings=jax.sharding.SingleDeviceSharding(jax.devices()[0]), **options)


def _fit_memory(memory: Memory | None, stacks: Mapping[str, PolicyStack], number: int) -> Memory | None:
    """Return hidden states of `number` worlds as wide as these stacks need, cut or padded; None if they need none.

    Hidden states start as zeros.
    """
    found = {}
    for agent, stack in stacks.items():
        if width := memory_size(stack):
            before = (memory or {}).get(agent, jnp.zeros((number, 0)))[:, :width]
            found[agent] = jnp.pad(before, ((0, 0), (0, width - before.shape[1])))
    return found or None


def _make_act(arena: Arena) -> Act:
    """Return the function that lets all agents act.

    It is let_act(stacks, observations, keys (N,), memory, first (N,), tick) -> (decisions, memory), by agent name.
    """
    scripts = {agent.kind: tuple(scripts_for(arena, agent.kind).values()) for agent in arena.agents}

    def let_act(
        stacks: Mapping[str, PolicyStack],
        observations: dict[str, Array],
        keys: Array,
        memory: Memory | None,
        first: Array,
        tick: Array | None,
    ) -> tuple[dict[str, Decision], Memory | None]:
        found, after = {}, dict(memory or {})
        for i, agent in enumerate(arena.agents):
            own = jax.vmap(lambda key: jax.random.fold_in(key, i))(keys)  # noqa: B023  (called at once)
            found[agent.name] = decide(
                stacks[agent.name], observations[agent.name], own, scripts[agent.kind], after.get(agent.name),
                agent.name, first, tick,
            )  # fmt: skip
            if (remembered := found[agent.name].memory) is not None:
                after[agent.name] = remembered
        return found, after or None

    return let_act
