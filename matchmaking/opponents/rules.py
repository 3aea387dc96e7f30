"""The rules: probabilities over a list of snapshots, ordered from oldest to newest."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

Weighting = Literal["squared", "variance", "linear", "linear_capped"]

_WEIGHTINGS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "squared": lambda x: (1 - x) ** 2,
    "variance": lambda x: x * (1 - x),
    "linear": lambda x: 1 - x,
    "linear_capped": lambda x: np.minimum(0.5, 1 - x),
}

BEATEN_TOO_SELDOM = 0.3
"""AlphaStar: a learner that wins no more often than this learns from the opponent's past instead."""

BEATEN = 0.7
"""AlphaStar: a past main player is forgotten where the learner wins less often than this."""

TOO_STRONG = 0.1
"""A main player that is beaten no more often than this is too strong for an exploiter to learn from it."""

AHEAD, SELF_PLAY, VERIFICATION = 0.5, 0.35, 0.15
"""AlphaStar: how a main player's games are shared out."""


def latest(n: int) -> np.ndarray:
    """(n,) All weight on the newest of n snapshots."""
    return np.eye(positive(n))[-1]


def uniform(n: int) -> np.ndarray:
    """(n,) The same weight for every snapshot: fictitious self-play over the whole history."""
    return delta_uniform(n, 0.0)


def delta_uniform(n: int, delta: float) -> np.ndarray:
    """(n,) Uniform over the newest share 1 - δ of the history, from snapshot ⌈δ n⌉ on, counted from 0.

    Bansal et al. 2018, "Emergent complexity via multi-agent competition": the opponent is drawn from
    Uniform(δ v, v), v the newest. δ = 0 is the whole history; δ = 1 is the newest snapshot alone.
    """
    if not 0 <= delta <= 1:
        raise ValueError(f"delta is {delta}; it must lie between 0 (all history) and 1 (only the newest snapshot)")
    start = min(math.ceil(delta * positive(n) - 1e-9), n - 1)  # 1e-9: 0.1 × 30 may come out just above 3
    return np.where(np.arange(n) >= start, 1 / (n - start), 0.0)


def pfsp(win_rates: np.ndarray, weighting: Weighting = "squared") -> np.ndarray:
    """(n,) Prioritised fictitious self-play: by what the learner's win rate against each says.

    Vinyals et al. 2019, "Grandmaster level in StarCraft II using multi-agent reinforcement learning", Methods and
    published pseudocode: P(B) = f(x_B) / Σ f(x_C), x the learner's win rate, with f one of

        squared        (1 - x)²            the hardest
        variance       x (1 - x)           those of its own strength
        linear         1 - x
        linear_capped  min(½, 1 - x)       evenly those that it does not beat yet

    Args:
        win_rates: (n,) the learner's score against each snapshot in [0, 1]; nan where they never met counts as ½.
        weighting: which f.

    Returns:
        probabilities (n,); uniform where f is 0 for all of them, e.g. where the learner beats all of them always.
    """
    x = _shares(win_rates)
    if weighting not in _WEIGHTINGS:
        raise ValueError(f"weighting is {weighting!r}; choose one of {', '.join(get_args(Weighting))}")
    f = _WEIGHTINGS[weighting](x)
    return f / f.sum() if f.sum() > 1e-10 else uniform(len(x))


def by_quality(qualities: np.ndarray) -> np.ndarray:
    """(n,) Softmax of the quality scores q: p_i = exp(q_i) / Σ exp(q_j).

    Berner et al. 2019 (OpenAI Five), "Dota 2 with large scale deep reinforcement learning", appendix on opponents: for
    the fifth of its games that it plays against its past. How q follows from the games says `Qualities`.
    """
    q = np.asarray(qualities, float)
    if q.ndim != 1 or not np.all(np.isfinite(q)):
        raise ValueError(f"qualities must be one row of finite numbers, not {qualities}")
    positive(len(q))
    p = np.exp(q - q.max())
    return p / p.sum()


def gaussian(win_rates: np.ndarray, sigma: float = 1 / 6) -> np.ndarray:
    """(n,) A normal law of the predicted win probability, around ½: those of the learner's own strength.

    Jaderberg et al. 2019 (FTW), "Human-level performance in 3D multiplayer games with population-based reinforcement
    learning", supplement: p_i ∝ exp(-(x_i - ½)² / (2 σ²)) with σ = 1/6, x_i predicted by ratings.

    Args:
        win_rates: (n,) predicted scores of the learner in [0, 1]; nan counts as ½.
        sigma: σ, above 0.
    """
    if not sigma > 0:
        raise ValueError(f"sigma is {sigma}; it must be above 0, e.g. 1/6")
    logs = -((_shares(win_rates) - 0.5) ** 2) / (2 * sigma**2)
    p = np.exp(logs - logs.max())
    return p / p.sum()


class Mixture(NamedTuple):
    """Probabilities over the opponent as it plays now and n snapshots; they sum to 1. And how they came about."""

    present: float
    past: np.ndarray  # (n,)
    why: str


def alphastar(
    win_rates: np.ndarray,
    against_present: float | None,
    own: np.ndarray,
    exploiters: np.ndarray,
    mix: tuple[float, float, float] = (AHEAD, SELF_PLAY, VERIFICATION),
) -> Mixture:
    """What a main player of AlphaStar meets (Vinyals et al. 2019, Methods and published pseudocode, `MainPlayer`).

    - 0.5: PFSP (squared) over all snapshots.
    - 0.35: self-play against the present opponent; where it is beaten in no more than 30 % of games, its past by PFSP
      (variance) instead.
    - 0.15: verification. Exploiters' snapshots by PFSP (squared) where one of them is beaten in less than 30 % of
      games; else forgotten players: past snapshots of the opponent that are beaten in less than 70 %, by PFSP
      (squared). Its newest snapshots as far as each is harder than the one before are not forgotten but new, and left
      out. Without any of these it is self-play too.

    Args:
        win_rates: (n,) the learner's score against each snapshot in [0, 1]; nan counts as ½.
        against_present: its score against the opponent as it plays now; None where nobody sits there now, and then
            self-play is against its past.
        own: (n,) bool, the present opponent's own snapshots.
        exploiters: (n,) bool, exploiters' snapshots.
        mix: the shares of the three, in this order; ValueError unless they are shares that sum to 1.
    """
    ahead, alone, verified = check_mix(mix)
    x = _shares(win_rates)
    past = ahead * pfsp(x)
    found, why = _verification(x, np.asarray(own, bool), np.asarray(exploiters, bool))
    if found is None:
        alone += verified
    else:
        past = past + verified * found
    if against_present is not None and against_present > BEATEN_TOO_SELDOM:
        return Mixture(alone, past, f"{why}; self-play against the opponent as it plays now")
    chosen = np.flatnonzero(own)
    history = _spread(len(x), chosen, pfsp(x[chosen], "variance")) if chosen.size else pfsp(x, "variance")
    reason = "which is not there" if against_present is None else f"which is beaten in {100 * against_present:.0f} %"
    return Mixture(0.0, past + alone * history, f"{why}; self-play against the past of the opponent, {reason}")


def exploit(win_rates: np.ndarray, players: Sequence[str]) -> Mixture:
    """What a main exploiter of AlphaStar meets (Vinyals et al. 2019, published pseudocode, `MainExploiter`).

    One of the players, each as likely as another: its newest snapshot where that is beaten in more than 10 % of games,
    for else there is nothing to learn from; then its snapshots by PFSP (variance). There the player itself sits
    opposite instead of its newest snapshot; here the one that learns elsewhere is as it was frozen last.

    Args:
        win_rates: (n,) the learner's score against each snapshot in [0, 1]; nan counts as ½.
        players: (n,) whose snapshot each is.
    """
    x = _shares(win_rates)
    past, why = np.zeros(len(x)), []
    for player in sorted(set(players)):
        own = np.flatnonzero([name == player for name in players])
        if x[own[-1]] > TOO_STRONG:
            chosen, told = latest(len(own)), "as it was frozen last"
        else:
            chosen, told = pfsp(x[own], "variance"), f"its past, for it is beaten in {100 * x[own[-1]]:.0f} %"
        past += _spread(len(x), own, chosen) / len(set(players))
        why.append(f"{player} {told}")
    return Mixture(0.0, past, "; ".join(why))


def check_mix(mix: tuple[float, float, float]) -> tuple[float, float, float]:
    """The shares of AlphaStar's three kinds of games as they are; ValueError unless they sum to 1."""
    if min(mix) < 0 or not math.isclose(sum(mix), 1.0, abs_tol=1e-6):
        raise ValueError(f"mix: three shares that sum to 1, not to {sum(mix):g}")
    return mix


def draw(weights: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """(k,) Indices drawn independently with probabilities `weights`; the same one may come twice."""
    return rng.choice(len(weights), size=k, p=weights)


def positive(n: int) -> int:
    """The number of snapshots as it is; ValueError where there are none."""
    if n < 1:
        raise ValueError(f"there are {n} snapshots to choose from; a league has at least its initial one")
    return n


def _verification(x: np.ndarray, own: np.ndarray, exploiters: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Probabilities of the verification games and their reason; None where there is nobody to be verified against."""
    strong = np.flatnonzero(exploiters)
    if strong.size and x[strong].min() < BEATEN_TOO_SELDOM:
        return _spread(len(x), strong, pfsp(x[strong])), "verification against exploiters"
    known = _less_monotonic_end(np.flatnonzero(own), x)
    forgotten = known[x[known] < BEATEN]
    if forgotten.size:
        return _spread(len(x), forgotten, pfsp(x[forgotten])), "verification against forgotten players"
    return None, "nobody to be verified against"


def _less_monotonic_end(history: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The history less its newest snapshots as far as each one is no easier than the one before it."""
    easier = np.flatnonzero(x[history][1:] > x[history][:-1])
    return history[: easier[-1] + 2] if easier.size else history[:0]


def _spread(n: int, where: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
    """Probabilities (n,) of the chosen ones, 0 elsewhere."""
    whole = np.zeros(n)
    whole[where] = probabilities
    return whole


def _shares(win_rates: np.ndarray) -> np.ndarray:
    x = np.nan_to_num(np.asarray(win_rates, float), nan=0.5)
    if x.ndim != 1 or not np.all((x >= 0) & (x <= 1)):
        raise ValueError(f"win_rates must be one row of scores between 0 and 1 (nan where never met), not {win_rates}")
    positive(len(x))
    return x
