"""Which past snapshots a learning player meets: probabilities over a list ordered from oldest to newest."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

Kind = Literal["latest", "uniform", "delta_uniform", "prioritized"]


def latest(n: int) -> np.ndarray:
    """(n,) All weight on the newest of n snapshots."""
    return np.eye(_positive(n))[-1]


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
    start = min(math.ceil(delta * _positive(n) - 1e-9), n - 1)  # 1e-9: 0.1 × 30 may come out just above 3
    return np.where(np.arange(n) >= start, 1 / (n - start), 0.0)


def prioritized(win_rates: np.ndarray, hardness: float = 2.0) -> np.ndarray:
    """(n,) Prioritised fictitious self-play: more weight on those that the learner fails to beat.

    Vinyals et al. 2019, "Grandmaster level in StarCraft II using multi-agent reinforcement learning", Methods:
    P(B) = f(P[A beats B]) / Σ f(P[A beats C]), with f(x) = (1 - x)^p.

    Args:
        win_rates: (n,) the learner's score against each snapshot in [0, 1]; nan where they never met counts as ½.
        hardness: p above; 0 is uniform, larger looks harder at the strongest.

    Returns:
        probabilities (n,); uniform if the learner beats all of them always.
    """
    x = np.nan_to_num(np.asarray(win_rates, float), nan=0.5)
    if x.ndim != 1 or not np.all((x >= 0) & (x <= 1)):
        raise ValueError(f"win_rates must be one row of scores between 0 and 1 (nan where never met), not {win_rates}")
    f = (1 - x) ** hardness
    return f / f.sum() if f.sum() > 0 else uniform(len(x))


def draw(weights: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """(k,) Indices drawn independently with probabilities `weights`; the same one may come twice."""
    return rng.choice(len(weights), size=k, p=weights)


class Split(NamedTuple):
    """How many groups of a learner's worlds play present opponents, and how many past ones."""

    present: int
    past: int


@dataclass(frozen=True)
class Opponents:
    """Whom a learning player meets."""

    kind: Kind = "latest"
    """Which past snapshots: latest, uniform, delta_uniform (with `delta`) or prioritized (by score against each)."""

    past: float = 0.0
    """Share of the worlds, 0 to 1, that play past snapshots; all others play the opponents' present policies."""

    delta: float = 0.0
    """For delta_uniform: the oldest share of the history that is left out, 0 to 1."""

    groups: int = 8
    """Equal groups of a learner's worlds, those with present opponents included; each other one meets a snapshot."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind is {self.kind!r}; choose one of {', '.join(get_args(Kind))}")
        for name in ("past", "delta"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it is a share and must lie between 0 and 1")
        fewest = 2 if 0 < self.past < 1 else 1
        if self.groups < fewest:
            why = f", for present and past opponents (past = {self.past})" if fewest == 2 else ""
            raise ValueError(f"groups is {self.groups}; it must be {fewest} or more{why}")
        if self.delta and self.kind != "delta_uniform":
            raise ValueError(f"delta = {self.delta} does nothing with kind = {self.kind!r}; use kind = 'delta_uniform'")
        if self.kind != "latest" and not self.past:
            raise ValueError(f"kind = {self.kind!r} does nothing with past = 0; give past > 0, e.g. 0.2")

    def split(self) -> Split:
        """Groups against present and against past opponents: the share `past` to within one group, none left empty.

        Where all opponents are present there is one group, for all worlds are alike.
        """
        if self.past in (0, 1):
            return Split(0, self.groups) if self.past else Split(1, 0)
        past = min(max(round(self.past * self.groups), 1), self.groups - 1)
        return Split(self.groups - past, past)

    @property
    def true_share(self) -> float:
        """The share of the worlds that really play past snapshots."""
        present, past = self.split()
        return past / (present + past)

    def weights(self, n: int, win_rates: np.ndarray | None = None) -> np.ndarray:
        """(n,) Probabilities over n snapshots, oldest first; `win_rates` (n,) are read by prioritized alone."""
        if self.kind == "latest":
            return latest(n)
        if self.kind == "prioritized":
            return prioritized(np.full(_positive(n), np.nan) if win_rates is None else win_rates)
        return delta_uniform(n, self.delta)


def _positive(n: int) -> int:
    if n < 1:
        raise ValueError(f"there are {n} snapshots to choose from; a league has at least its initial one")
    return n
