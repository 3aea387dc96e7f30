"""Values that an arena returns: teams, the state of a world between two decisions, verdicts, frames of a recording."""

from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.description import Entities
from arenas.physics.engine import Physics
from arenas.rosters import AgentSizes, roster_text

OBSERVATION_LIMIT = 1e6  # numbers of observations are within ±it


@dataclass(frozen=True)
class AgentSpec:
    """One robot of a team. Its name is its MJCF prefix, the key of its observation and its path in the viewer."""

    name: str  # e.g. blue/0
    kind: str
    observation_size: int
    action_size: int
    entities: tuple[Entities, ...] = ()  # sets of like things in its observation


@dataclass(frozen=True)
class TeamSpec:
    """One team of an arena: a fixed roster of agents."""

    name: str
    agents: tuple[AgentSpec, ...]
    side_specific: bool = False  # another team has equal agents, and the arena does not declare both exchangeable

    @property
    def roster(self) -> str:
        """The roster that a policy must fit to play this side, e.g. `leatherback:38:2+leatherback:38:2`
        (`arenas.rosters`).
        """
        sizes = (AgentSizes(a.kind, a.observation_size, a.action_size) for a in self.agents)
        return roster_text(sizes, self.name if self.side_specific else "")


class Verdict(NamedTuple):
    """A game's verdict on a control step. *Reward* is for learning; *score* decides matches.

    `terminated`: the game is over and the future has no value. `truncated`: the game was cut off and the future still
    has value. If neither holds, `score` is ignored. With three and more teams it may be any finite numbers: they rank
    the teams, the largest first, and equal numbers are a tie. Names of terms and events are the same in every verdict
    of an arena. In a `State`, terms are summed over the decision's control steps, and an event is true if it happened
    in any of them.
    """

    rewards: dict[str, Array]  # name -> (teams,) rewards of the outcome; they sum to `reward`
    shapings: dict[str, Array]  # name -> (teams,) dense shaping, which a learner may anneal; it sums to `shaping`
    score: Array  # (teams,) of one team 1 success, 0 failure; of two 1 win, ½ draw, 0 loss; of more see above
    terminated: Array  # () bool
    truncated: Array  # () bool
    events: dict[str, Array] = {}  # noqa: RUF012  (name -> (teams,) bool: the team's contact, out, fall, goal, ...)

    @property
    def reward(self) -> Array:
        """The outcome as one number per team, (teams,): the sum of its terms."""
        return sum_terms(self.rewards, self.score)

    @property
    def shaping(self) -> Array:
        """Dense shaping as one number per team, (teams,): the sum of its terms."""
        return sum_terms(self.shapings, self.score)


class State(NamedTuple):
    """The state of one world between two decisions."""

    physics: Physics
    game: Any  # the game's own pytree
    observations: dict[str, Array]  # agent name -> (observation_size,)
    actions: dict[str, Array]  # the latest, agent name -> (action_size,)
    verdict: Verdict
    void: Array  # () bool: physics failed before the game was decided, so the episode counts for no team
    at_fault: Array  # (teams,) bool: the teams whose own numbers made the world void; none if unknown
    alive: Array  # (agents,) bool: agents in the game; the others observe zeros and execute `limp`
    causes: Array  # () uint8, bits of arenas.physics.void_causes: the causes of the void; 0 if not void

    @property
    def done(self) -> Array:
        """() bool: the episode is over, for any reason."""
        return self.verdict.terminated | self.verdict.truncated | self.void


class Frames(NamedTuple):
    """Record of a decision: one row per control step. Fields that no caller reads cost nothing."""

    qpos: Array  # (hold, nq)
    time: Array  # (hold,) seconds since the start of the episode
    markers: dict[str, Array]  # name -> (hold, m), see Arena.marker_kinds
    rewards: dict[str, Array]  # term -> (hold, teams), of this control step alone; 0 once the game is decided
    shapings: dict[str, Array]
    events: dict[str, Array]  # event -> (hold, teams) bool
    over: Array  # (hold,) bool: the episode has ended, in this control step or before


def sum_terms(terms: dict[str, Array], like: Array) -> Array:
    """Sum the terms in their order; without terms, return zeros shaped as `like`."""
    return reduce(add, terms.values()) if terms else jnp.zeros_like(like)


def mean_pairwise_score(score: Any) -> Any:
    """Return each team's mean score against the other teams, from verdicts' scores (..., teams), NumPy or JAX.

    Of three and more teams it is the share of the others that rank behind a team, a tie counted half, which is ½ on
    average. The score of one team or two is returned as it is.
    """
    teams = score.shape[-1]
    if teams < 3:
        return score
    own, other = score[..., :, None], score[..., None, :]
    return ((own > other) + 0.5 * (own == other) - 0.5 * np.eye(teams)).sum(-1) / (teams - 1)


def undecided_verdict(shapes: Verdict) -> Verdict:
    """Return the verdict before the first judgement, with the names and shapes of a game's verdicts."""
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def begin_decision(verdict: Verdict) -> Verdict:
    """Return the verdict for the start of the next decision: the outcome stays, terms and events are cleared."""
    terms = (verdict.rewards, verdict.shapings, verdict.events)
    rewards, shapings, events = jax.tree.map(jnp.zeros_like, terms)
    return verdict._replace(rewards=rewards, shapings=shapings, events=events)


def masked_verdict(news: Verdict, counts: Array) -> Verdict:
    """Return the verdict where it `counts` () bool; elsewhere terms are 0, and nothing ends or happens."""
    return Verdict(
        rewards={name: jnp.where(counts, term, 0.0) for name, term in news.rewards.items()},
        shapings={name: jnp.where(counts, term, 0.0) for name, term in news.shapings.items()},
        score=news.score,
        terminated=news.terminated & counts,
        truncated=news.truncated & counts,
        events={name: event & counts for name, event in news.events.items()},
    )


def merge_verdicts(verdict: Verdict, news: Verdict) -> Verdict:
    """Add the terms of a control step, record its events, and take its outcome if the game ended in it."""
    over = news.terminated | news.truncated
    return Verdict(
        rewards=jax.tree.map(jnp.add, verdict.rewards, news.rewards),
        shapings=jax.tree.map(jnp.add, verdict.shapings, news.shapings),
        score=jnp.where(over, news.score, verdict.score),
        terminated=verdict.terminated | news.terminated,
        truncated=verdict.truncated | news.truncated,
        events=jax.tree.map(jnp.logical_or, verdict.events, news.events),
    )


def finite_observations(observations: dict[str, Array]) -> dict[str, Array]:
    """Replace NaN and infinities by 0 and bound the rest: non-finite numbers must not reach a network."""
    return {
        k: jnp.clip(jnp.nan_to_num(v, nan=0.0, posinf=0.0, neginf=0.0), -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
        for k, v in observations.items()
    }
