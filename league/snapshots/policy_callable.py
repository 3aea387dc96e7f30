"""A snapshot as a callable from observations to actions, in NumPy: learnt, scripted or imported."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from agents.policy.host_policy import HostPolicy
from agents.policy.jax_policy import (
    Params,
    mean_action,
    memory_size,
    sample,
    stack_policies,
    update_memory,
)
from agents.policy.skill_arrays import is_over_skills, strategy_of
from agents.policy.skills import held_choice, skilled_actions
from arenas.arena import Arena
from league.config import experiment
from league.snapshots.codec import learnt_policies
from league.snapshots.programs import stored
from league.snapshots.programs.model import AgentSizes
from storage.blobs import arrays, programs
from storage.records import Snapshot

if TYPE_CHECKING:
    from league.queries.query import Open

Seat = Callable[[np.ndarray, jax.Array, np.ndarray, bool], np.ndarray]
"""One agent: (observations (n, obs), key, first (n,), explore) -> actions (n, act)."""


class PolicyCallable:
    """A frozen policy: `policy(observations)` are its actions.

    Observations (n, obs) have a row for each world, with those of the roster's agents one after the other, as
    `arenas.vector` gives them; actions (n, act) likewise. One world's (obs,) gives (act,). Of learnt policies the
    action is the mean; with `explore` it is drawn, as in the league's matches. A recurrent or stateful policy remembers
    from call to call: `reset` where episodes begin.
    """

    def __init__(self, snapshot: Snapshot, agents: Sequence[AgentSizes], seats: Sequence[Seat], seed: int = 0):
        self.snapshot, self.agents, self._seats = snapshot, tuple(agents), seats
        self.observation_size = sum(agent.observation for agent in agents)
        self.action_size = sum(agent.action for agent in agents)
        self._key, self._first = jax.random.key(seed), np.ones(0, bool)

    def __repr__(self) -> str:
        return f"<policy {self.snapshot.name}: ({self.observation_size},) -> ({self.action_size},)>"

    def __call__(self, observations: np.ndarray, explore: bool = False) -> np.ndarray:
        """Return the actions. Raises ValueError for observations of another size."""
        rows = np.atleast_2d(np.asarray(observations, np.float32))
        if rows.ndim != 2 or rows.shape[1] != self.observation_size:
            raise ValueError(
                f"{self.snapshot.name} takes observations (n, {self.observation_size}) or ({self.observation_size},),"
                f" and got {np.shape(observations)}"
            )
        if len(self._first) != len(rows):
            self._first = np.ones(len(rows), bool)
        self._key, *keys = jax.random.split(self._key, 1 + len(self.agents))
        parts = np.split(rows, np.cumsum([agent.observation for agent in self.agents])[:-1], axis=1)
        found = [seat(own, key, self._first, explore) for seat, own, key in zip(self._seats, parts, keys, strict=True)]
        self._first = np.zeros(len(rows), bool)
        actions = np.concatenate(found, axis=1)
        return actions if np.ndim(observations) > 1 else actions[0]

    def reset(self, first: np.ndarray | None = None) -> None:
        """Forget what was seen, in all worlds or where `first` (n,) is true."""
        self._first = np.ones(0, bool) if first is None else np.asarray(first, bool)


def policy_callable(league: "Open", name: str, seed: int = 0) -> PolicyCallable:
    """Return a snapshot of a league as a callable that acts as in the league's matches.

    Of a script, and to know whether a policy learnt elsewhere, the league's arena is built first.
    Raises UnknownName, StorageError or ConfigError, one line.
    """
    snapshot = league.snapshot(name)
    agents = stored.sizes(snapshot.roster)
    if snapshot.script is not None:
        return PolicyCallable(snapshot, agents, _scripted(league, snapshot.script, agents), seed)
    data = league.store.blobs.get(snapshot.digest)
    if programs.is_program(data):
        hosts = stored.host_policies(data, snapshot.name)
        seats = [_hosted(host, agent.action) for host, agent in zip(hosts, agents, strict=True)]
    else:
        arena = None if snapshot.arena is None else _arena(_settings(league))
        seats = [_learnt(policy) for policy in learnt_policies(arrays.from_bytes(data), snapshot, arena)]
    return PolicyCallable(snapshot, agents, seats, seed)


def _learnt(params: Params) -> Seat:
    if is_over_skills(params):
        return _commanding(params)
    stack = stack_policies([params])
    units = memory_size(stack)
    memory = jnp.zeros((0, units))
    mean = jax.jit(lambda seen, kept: mean_action(params, seen, kept))
    drawn, remembered = jax.jit(lambda *given: sample(params, *given)[0]), jax.jit(update_memory)

    def act(observations: np.ndarray, key: jax.Array, first: np.ndarray, explore: bool) -> np.ndarray:
        nonlocal memory
        seen, kept = jnp.asarray(observations), None
        if units:
            before = memory if len(memory) == len(seen) else jnp.zeros((len(seen), units))
            memory = kept = remembered(stack, seen, before, jnp.asarray(first))
        answer = drawn(seen, jax.random.split(key, len(seen)), kept) if explore else mean(seen, kept)
        return np.asarray(answer)

    return act


def _commanding(params: Params) -> Seat:
    """Return a policy over skills; with `explore` its commands are drawn, and its skills act by their means."""
    strategy, size = strategy_of(params), memory_size(stack_policies([params]))
    memory = jnp.zeros((0, size))

    @jax.jit
    def go_on(new: jax.Array, seen: jax.Array, before: jax.Array, first: jax.Array) -> tuple[jax.Array, jax.Array]:
        choice, after = held_choice(params, new, before, first)
        return skilled_actions(params, seen, choice, mean_action), after

    mean, drawn = (jax.jit(lambda *given, f=f: f(strategy, *given)) for f in (mean_action, sample))

    def act(observations: np.ndarray, key: jax.Array, first: np.ndarray, explore: bool) -> np.ndarray:
        nonlocal memory
        seen = jnp.asarray(observations)
        before = memory if len(memory) == len(seen) else jnp.zeros((len(seen), size))
        new = drawn(seen, jax.random.split(key, len(seen)))[0] if explore else mean(seen)
        answer, memory = go_on(new, seen, before, jnp.asarray(first))
        return np.asarray(answer)

    return act


def _hosted(host: HostPolicy, size: int) -> Seat:
    def act(observations: np.ndarray, key: jax.Array, first: np.ndarray, explore: bool) -> np.ndarray:
        shape = (len(observations), size)
        noise = np.asarray(jax.random.normal(key, shape)) if explore else np.zeros(shape, np.float32)
        return host.act("", 0, observations, noise, first)

    return act


def _scripted(league: "Open", script: str, agents: Sequence[AgentSizes]) -> list[Seat]:
    kinds = _arena(_settings(league)).scripts()[script]

    def seat(agent: AgentSizes) -> Seat:
        batched = jax.jit(jax.vmap(kinds[agent.kind]))
        return lambda seen, key, *_: np.asarray(batched(jnp.asarray(seen), jax.random.split(key, len(seen))))

    return [seat(agent) for agent in agents]


def _settings(league: "Open") -> str:
    return league.store.league(league.league).config


@lru_cache(maxsize=1)  # who asks for many policies of a league does not wait for its arena each time
def _arena(settings: str) -> Arena:
    """Return the arena of a league with these settings."""
    return experiment.loads(settings).arena.build(engine="c", threads=1)
