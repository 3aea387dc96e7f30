"""Published rules of opponent sampling: probabilities over a list of snapshots, ordered from oldest to newest."""

import hashlib
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

WEAK_BELOW = 0.3
"""AlphaStar: a learner that wins no more often than this meets the opponent's past instead."""

FORGOTTEN_BELOW = 0.7
"""AlphaStar: past main players are met again if the learner beats one of them less often than this."""

TOO_STRONG_BELOW = 0.1
"""A main player that is beaten no more often than this is too strong for an exploiter to learn from."""

PFSP_SHARE, SELF_PLAY_SHARE, VERIFICATION_SHARE = 0.5, 0.35, 0.15
"""AlphaStar: shares of a main player's games."""


def latest(n: int) -> np.ndarray:
    """Return all weight (n,) on the newest of n snapshots."""
    return np.where(np.arange(checked_count(n)) == n - 1, 1.0, 0.0)


def uniform(n: int) -> np.ndarray:
    """Return equal weights (n,): fictitious self-play over the whole history."""
    return delta_uniform(n, 0.0)


def delta_uniform(n: int, delta: float) -> np.ndarray:
    """Return uniform weights (n,) over the newest share 1 - δ of the history, from snapshot ⌈δ n⌉ on, from 0.

    Bansal et al. 2018, "Emergent complexity via multi-agent competition": the opponent is drawn from Uniform(δ v, v), v
    the newest. δ = 0 is the whole history; δ = 1 is the newest snapshot alone. Raises ValueError for δ outside [0, 1].
    """
    if not 0 <= delta <= 1:
        raise ValueError(f"delta is {delta}; it must lie between 0 (all history) and 1 (only the newest snapshot)")
    start = min(math.ceil(delta * checked_count(n) - 1e-9), n - 1)  # 1e-9: 0.1 × 30 may be slightly above 3
    return np.where(np.arange(n) >= start, 1 / (n - start), 0.0)


def pfsp(win_rates: np.ndarray, weighting: Weighting = "squared") -> np.ndarray:
    """Return probabilities (n,) of prioritised fictitious self-play, from the learner's win rates.

    Vinyals et al. 2019, "Grandmaster level in StarCraft II using multi-agent reinforcement learning", Methods and
    published pseudocode: P(B) = f(x_B) / Σ f(x_C), x the learner's win rate, with f one of

        squared        (1 - x)²            the hardest
        variance       x (1 - x)           those of its own strength
        linear         1 - x
        linear_capped  min(½, 1 - x)       evenly those that it does not beat yet

    Args:
        win_rates: (n,) the learner's score against each snapshot in [0, 1]; nan, for no games, counts as ½.
        weighting: name of f.

    Returns:
        probabilities (n,); uniform if f is 0 for all of them, e.g. if the learner always beats all of them.
    """
    x = _shares(win_rates)
    if weighting not in _WEIGHTINGS:
        raise ValueError(f"weighting is {weighting!r}; choose one of {', '.join(get_args(Weighting))}")
    f = _WEIGHTINGS[weighting](x)
    return f / f.sum() if f.sum() > 1e-10 else uniform(len(x))


def by_quality(qualities: np.ndarray) -> np.ndarray:
    """Return the softmax (n,) of the quality scores q: p_i = exp(q_i) / Σ exp(q_j).

    Berner et al. 2019 (OpenAI Five), "Dota 2 with large scale deep reinforcement learning", appendix on opponents: for
    the fifth of the games that are played against the past. `Qualities` tells how q follows from the games.
    """
    q = np.asarray(qualities, float)
    if q.ndim != 1 or not np.all(np.isfinite(q)):
        raise ValueError(f"qualities must be one row of finite numbers, not {qualities}")
    checked_count(len(q))
    p = np.exp(q - q.max())
    return p / p.sum()


def gaussian(win_rates: np.ndarray, sigma: float = 1 / 6) -> np.ndarray:
    """Return weights (n,) by a normal distribution of the predicted win probability around ½: equal opponents.

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
    """Probabilities of the opponent's present policy and of n snapshots, which sum to 1, and the reason for them."""

    present: float
    past: np.ndarray  # (n,)
    why: str

    @property
    def weights(self) -> np.ndarray:
        """(n + 1,) Probabilities of the snapshots and, last, of the present policy."""
        whole = np.append(self.past, self.present)
        return whole / whole.sum()


def alphastar(
    win_rates: np.ndarray,
    against_present: float | None,
    own: np.ndarray,
    exploiters: np.ndarray,
    mix: tuple[float, float, float] = (PFSP_SHARE, SELF_PLAY_SHARE, VERIFICATION_SHARE),
) -> Mixture:
    """Return the opponents of a main player of AlphaStar (Vinyals et al. 2019, published pseudocode, `MainPlayer`).

    - 0.5: PFSP (squared) over all snapshots.
    - 0.35: self-play against the present opponent; if it is beaten in no more than 30 % of games, its past by PFSP
      (variance) instead.
    - 0.15: verification. Exploiters' snapshots by PFSP (squared) if one of them is beaten in less than 30 % of games;
      otherwise, if one of them is beaten in less than 70 %, past snapshots of the opponent, by PFSP (squared). Its
      newest snapshots, as long as each is harder than the one before, are not forgotten but new, and left out.
      Without any of these it is self-play too.

    Args:
        win_rates: (n,) the learner's score against each snapshot in [0, 1]; nan counts as ½.
        against_present: its score against the opponent's present policy; None if that does not play now, and then
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
    if against_present is not None and against_present > WEAK_BELOW:
        return Mixture(alone, past, f"{why}; self-play against the opponent as it plays now")
    chosen = np.flatnonzero(own)
    history = _scatter(len(x), chosen, pfsp(x[chosen], "variance")) if chosen.size else pfsp(x, "variance")
    reason = "which is not there" if against_present is None else f"which is beaten in {100 * against_present:.0f} %"
    return Mixture(0.0, past + alone * history, f"{why}; self-play against the past of the opponent, {reason}")


def exploit(win_rates: np.ndarray, players: Sequence[str]) -> Mixture:
    """Return the opponents of a main exploiter of AlphaStar (Vinyals et al. 2019, `MainExploiter`).

    One of the players, with equal probability: its newest snapshot if that is beaten in more than 10 % of games,
    because otherwise nothing can be learnt from it; if not, its snapshots by PFSP (variance). In the published
    pseudocode the player itself plays instead of its newest snapshot; here the player that learns elsewhere is
    represented by its last snapshot.

    Args:
        win_rates: (n,) the learner's score against each snapshot in [0, 1]; nan counts as ½.
        players: (n,) the player of each snapshot.
    """
    x = _shares(win_rates)
    past, why = np.zeros(len(x)), []
    for player in sorted(set(players)):
        own = np.flatnonzero([name == player for name in players])
        if x[own[-1]] > TOO_STRONG_BELOW:
            chosen, how = latest(len(own)), "as it was frozen last"
        else:
            chosen, how = pfsp(x[own], "variance"), f"its past, because it is beaten in {100 * x[own[-1]]:.0f} %"
        past += _scatter(len(x), own, chosen) / len(set(players))
        why.append(f"{player} {how}")
    return Mixture(0.0, past, "; ".join(why))


def check_mix(mix: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the shares of AlphaStar's three kinds of games unchanged; ValueError unless they sum to 1."""
    if min(mix) < 0 or not math.isclose(sum(mix), 1.0, abs_tol=1e-6):
        raise ValueError(f"mix: three shares that sum to 1, not to {sum(mix):g}")
    return mix


def draw(weights: np.ndarray, names: Sequence[str], keys: Sequence[str]) -> list[int]:
    """Return for each key an index of `names`, drawn independently with probabilities `weights` (n,).

    The draw is a hash of the key and the names. So a key draws the same name again while the weights stay, and another
    one only as far as they change: of n + 1 equal weights instead of n, the new name with probability 1 / (n + 1), else
    the same as before. Each name has a time that is exponentially distributed with its weight as rate, and the
    earliest wins, as in weighted rendezvous hashing (Schindelhauer and Schomaker 2005, "Weighted distributed hash
    tables", the logarithmic method).
    """
    able = np.flatnonzero(weights > 0)
    drawn, rates = [names[i] for i in able.tolist()], weights[able]
    times = (np.array([-math.log(_uniform(f"{key}/{name}")) for name in drawn]) / rates for key in keys)
    return [int(able[np.argmin(each)]) for each in times]


def _uniform(text: str) -> float:
    """Return a number in (0, 1) that follows from the text alone, in all processes."""
    return (int.from_bytes(hashlib.blake2b(text.encode(), digest_size=6).digest(), "big") + 0.5) / 2**48


def checked_count(n: int) -> int:
    """Return the number of snapshots unchanged; ValueError if there are none."""
    if n < 1:
        raise ValueError(f"there are {n} snapshots to choose from; a league has at least its initial one")
    return n


def _verification(x: np.ndarray, own: np.ndarray, exploiters: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Return probabilities of the verification games and their reason; None if there is no such opponent."""
    exploiter_indices = np.flatnonzero(exploiters)
    if exploiter_indices.size and x[exploiter_indices].min() < WEAK_BELOW:
        return _scatter(len(x), exploiter_indices, pfsp(x[exploiter_indices])), "verification against exploiters"
    known = _less_monotonic_end(np.flatnonzero(own), x)
    if known.size and x[known].min() < FORGOTTEN_BELOW:
        return _scatter(len(x), known, pfsp(x[known])), "verification against forgotten players"
    return None, "nobody to be verified against"


def _less_monotonic_end(history: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the history without its newest snapshots as long as each is no easier than the one before it."""
    easier = np.flatnonzero(x[history][1:] > x[history][:-1])
    return history[: easier[-1] + 2] if easier.size else history[:0]


def _scatter(n: int, where: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
    """Return probabilities (n,) of the chosen snapshots, 0 elsewhere."""
    full = np.zeros(n)
    full[where] = probabilities
    return full


def _shares(win_rates: np.ndarray) -> np.ndarray:
    """Return win rates (n,) with ½ for nan; ValueError unless they are scores between 0 and 1."""
    x = np.nan_to_num(np.asarray(win_rates, float), nan=0.5)
    if x.ndim != 1 or not np.all((x >= 0) & (x <= 1)):
        raise ValueError(f"win_rates must be one row of scores between 0 and 1 (nan where never met), not {win_rates}")
    checked_count(len(x))
    return x
