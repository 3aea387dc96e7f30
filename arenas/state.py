"""What an arena tells: its sides, a world between two decisions, verdicts, and frames of a recording."""

from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from arenas.physics import Physics


@dataclass(frozen=True)
class AgentSpec:
    """One robot of a team: its name is its MJCF prefix, the key of its observation and its path in the viewer."""

    name: str  # e.g. blue/0
    kind: str
    observation_size: int
    action_size: int


@dataclass(frozen=True)
class TeamSpec:
    """One side of an arena: a fixed roster of agents."""

    name: str
    agents: tuple[AgentSpec, ...]

    @property
    def roster(self) -> str:
        """What a policy must fit to play this side, e.g. `leatherback:38:2+leatherback:38:2`."""
        return "+".join(f"{a.kind}:{a.observation_size}:{a.action_size}" for a in self.agents)


class Verdict(NamedTuple):
    """What a game says after a control step. *Reward* is for learning; *score* decides matches.

    `terminated`: the game is over and the future is worth nothing. `truncated`: it was cut and the future still has
    value. Where neither holds, `score` is ignored. Names of terms and events are the same in every verdict of an arena.
    In a `State`, terms are summed over the decision's control steps and events say whether they happened in any.
    """

    rewards: dict[str, Array]  # name -> (teams,) the outcome as rewards; they sum to `reward`
    shapings: dict[str, Array]  # name -> (teams,) dense hints, which a learner may anneal away; they sum to `shaping`
    score: Array  # (teams,) 1 win, ½ draw, 0 loss; with one team 1 success, 0 failure
    terminated: Array  # () bool
    truncated: Array  # () bool
    events: dict[str, Array] = {}  # noqa: RUF012  (name -> (teams,) bool: contact, out, fall, goal, ... befell a team)

    @property
    def reward(self) -> Array:
        """The outcome as one number per team, (teams,): the sum of its terms."""
        return summed(self.rewards, self.score)

    @property
    def shaping(self) -> Array:
        """Dense hints as one number per team, (teams,): the sum of their terms."""
        return summed(self.shapings, self.score)


class State(NamedTuple):
    """One world between two decisions."""

    physics: Physics
    game: Any  # the game's own pytree
    observations: dict[str, Array]  # agent name -> (observation_size,)
    actions: dict[str, Array]  # the last ones, agent name -> (action_size,)
    verdict: Verdict
    void: Array  # () bool: physics became unstable before the game was decided; counts for nobody
    culprits: Array  # (teams,) bool: whose own numbers were bad when the world became void; none if it cannot be told
    alive: Array  # (agents,) bool: who takes part in the game; who does not sees zeros and acts as its robot's `limp`

    @property
    def done(self) -> Array:
        """() bool: the episode is over, for whatever reason."""
        return self.verdict.terminated | self.verdict.truncated | self.void


class Frames(NamedTuple):
    """What a recording keeps of a decision: one row per control step. What nobody reads costs nothing."""

    qpos: Array  # (hold, nq)
    time: Array  # (hold,) seconds since the start of the episode
    markers: dict[str, Array]  # name -> (hold, m), see Arena.marker_kinds
    rewards: dict[str, Array]  # term -> (hold, teams), of this control step alone; 0 once the game is decided
    shapings: dict[str, Array]
    events: dict[str, Array]  # event -> (hold, teams) bool


def summed(terms: dict[str, Array], like: Array) -> Array:
    """The sum of the terms in their order; without any, zeros as many as `like`."""
    return reduce(add, terms.values()) if terms else jnp.zeros_like(like)


def undecided(shapes: Verdict) -> Verdict:
    """The verdict before anything was judged, of the names and shapes that a game's verdicts have."""
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def begun(verdict: Verdict) -> Verdict:
    """The verdict as the next decision begins: outcomes stay, terms and events start anew."""
    terms = (verdict.rewards, verdict.shapings, verdict.events)
    rewards, shapings, events = jax.tree.map(jnp.zeros_like, terms)
    return verdict._replace(rewards=rewards, shapings=shapings, events=events)


def counted(news: Verdict, counts: Array) -> Verdict:
    """What a control step tells where it `counts` () bool; elsewhere terms are 0 and nothing ends or happens."""
    return Verdict(
        rewards={name: jnp.where(counts, term, 0.0) for name, term in news.rewards.items()},
        shapings={name: jnp.where(counts, term, 0.0) for name, term in news.shapings.items()},
        score=news.score,
        terminated=news.terminated & counts,
        truncated=news.truncated & counts,
        events={name: event & counts for name, event in news.events.items()},
    )


def merged(verdict: Verdict, news: Verdict) -> Verdict:
    """Add the terms of a control step, note its events, and take its outcome if the game ended in it."""
    over = news.terminated | news.truncated
    return Verdict(
        rewards=jax.tree.map(jnp.add, verdict.rewards, news.rewards),
        shapings=jax.tree.map(jnp.add, verdict.shapings, news.shapings),
        score=jnp.where(over, news.score, verdict.score),
        terminated=verdict.terminated | news.terminated,
        truncated=verdict.truncated | news.truncated,
        events=jax.tree.map(jnp.logical_or, verdict.events, news.events),
    )


def finite(observations: dict[str, Array]) -> dict[str, Array]:
    """Bad numbers of an unstable world must not reach a network: NaN and infinities become 0, the rest is bounded."""
    return {k: jnp.clip(jnp.nan_to_num(v, nan=0.0, posinf=0.0, neginf=0.0), -1e6, 1e6) for k, v in observations.items()}
