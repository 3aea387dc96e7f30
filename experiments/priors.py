"""Priors of the rating fit compared on held-out games: virtual games with the opponents met, or with the parent.

    python -m experiments.priors [--store league-data] [--out FILE]

Simulated leagues: two lineages whose strength grows by normal steps. Each new snapshot meets its initial one and a few
others; besides transitive strength every pair has an advantage of its own. Real leagues (`--store`): of each row of the
log a few games are fitted and the others held out. Prints JSON. Each prior has the mean log loss of a held-out game
(nats), the calibration error (mean distance of score and prediction over ten equal groups), and, for simulated leagues,
how often the 95 % interval of a snapshot's gap to its parent holds the true gap.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

import league
from matchmaking.ratings.davidson import davidson
from matchmaking.ratings.fit import ELO, Ratings, fit
from matchmaking.ratings.likelihoods import priors
from matchmaking.ratings.likelihoods.priors import Prior
from matchmaking.ratings.payoff import Payoff, sum_matches
from scripts.record import make_parser, report, run_info
from storage.records import ArenaKey, Match, PairCounts

NU, SIDE = 0.3, 0.1
Parents = Mapping[str, str]
PRIORS: dict[str, Callable[[Payoff, Parents], Prior]] = {
    **{f"opponents, {n:g}": lambda payoff, _, n=n: priors.opponents(payoff, n) for n in (0.5, 1, 2, 4)},
    **{f"parent, {n:g}": lambda payoff, parents, n=n: priors.parents(payoff, parents, n) for n in (0.5, 1, 2, 4, 8)},
}
REGIMES = {  # mean and standard deviation of a lineage's step in log odds, games per pair
    f"{pace}, {games} games a pair": (mean, deviation, games)
    for pace, mean, deviation in (("leaps", 1.2, 0.6), ("fast", 0.5, 0.3), ("slow", 0.1, 0.15), ("level", 0.0, 0.2))
    for games in (4, 16, 64)
}


@dataclass
class Tried:
    """One league: the fitted log, and the held-out log."""

    log: list[Match]
    held_out: list[Match]
    parents: Parents
    theta: Mapping[str, float] | None = None  # true strengths of a simulated league


def games(a: str, b: str, gap: float, n: int, rng: np.random.Generator) -> Match:
    """Simulate n games, half of them with sides swapped."""
    p = [np.exp(davidson(np.array(gap + side), np.log(NU)).log_likelihood) for side in (SIDE, -SIDE)]
    home, away = (rng.multinomial(n // 2, each / each.sum()) for each in p)
    return _match(a, b, home, away)


def _match(a: str, b: str, home: np.ndarray, away: np.ndarray) -> Match:
    w, d, l = (int(x) for x in home + away)  # noqa: E741
    return Match("bench", ArenaKey("sumo", "0", "c"), a, b, w, d, l, 0, *map(int, home), PairCounts(), seed=0)


def simulated(mean: float, deviation: float, n: int, rng: np.random.Generator, length: int = 16) -> Tried:
    """Simulate two lineages; each snapshot meets its initial one and four others that came before it."""
    theta, parents, log, held_out = {}, {}, [], []
    for player in ("blue", "red"):
        steps = np.append(0, np.cumsum(rng.normal(mean, deviation, length - 1)))
        theta |= {f"{player}@{i:02d}": float(x) for i, x in enumerate(steps)}
        parents |= {f"{player}@{i:02d}": f"{player}@{i - 1:02d}" for i in range(1, length)}
    own = {tuple(sorted(pair)): rng.normal(0, 0.2) for pair in _pairs(theta)}
    met = set()
    for i in range(1, length):
        for name in (f"blue@{i:02d}", f"red@{i:02d}"):
            earlier = [other for other in theta if int(other[-2:]) < i]
            for other in {f"{name[:-2]}00", *rng.choice(earlier, min(4, len(earlier)), replace=False)}:
                met.add(tuple(sorted((name, str(other)))))
    for a, b in _pairs(theta):
        gap = theta[a] - theta[b] + own[a, b]
        if (a, b) in met:
            log.append(games(a, b, gap, n, rng))
        held_out.append(games(a, b, gap, 8, rng))
    return Tried(log, held_out, parents, theta)


def thinned(store: str, n: int, rng: np.random.Generator) -> Tried:
    """Split a real league's newest ladder: n games of each row are fitted, the others held out."""
    with league.open(store) as opened:
        key = opened.ladders()[0]
        log = [m for m in opened.store.matches(opened.league, ("rating", "request")) if m.arena == key]
        parents = {s.name: s.parent for s in opened.store.snapshots(opened.league) if s.parent}
    kept, held_out = [], []
    for m in log:
        home = np.array([m.side_wins, m.side_draws, m.side_losses])
        away = np.array([m.wins, m.draws, m.losses]) - home
        parts = [rng.multivariate_hypergeometric(side, min(n // 2, side.sum())) for side in (home, away)]
        kept.append(_match(m.a, str(m.b), *parts))
        held_out.append(_match(m.a, str(m.b), home - parts[0], away - parts[1]))
    return Tried(kept, held_out, parents)


def _pairs(names) -> Iterator[tuple[str, str]]:
    names = sorted(names)
    return ((a, b) for i, a in enumerate(names) for b in names[i + 1 :])


def predictions(ratings: Ratings, log: list[Match]) -> np.ndarray:
    """Return rows of expected score, log loss, number and actual score, one for each kind of held-out game."""
    rows = []
    for m in log:
        gap = float(ratings.elo[ratings.index(m.a)] - ratings.elo[ratings.index(str(m.b))])
        home = np.array([m.side_wins, m.side_draws, m.side_losses])
        for counts, side in ((home, 1), (np.array([m.wins, m.draws, m.losses]) - home, -1)):
            d = np.array((gap + side * ratings.side_advantage) / ELO)
            predicted = davidson(d, np.log(max(ratings.draw, 1e-3)))
            if n := counts.sum():
                rows.append(
                    (
                        float(predicted.score),
                        -float(counts @ predicted.log_likelihood) / n,
                        n,
                        (counts @ [1, 0.5, 0]) / n,
                    )
                )
    return np.array(rows)


def calibration_error(rows: np.ndarray) -> float:
    """Return the mean distance of score and prediction over ten groups of equal size in the order of predictions."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    groups = np.minimum(10 * np.cumsum(rows[:, 2]) // (rows[:, 2].sum() + 1), 9)
    n, expected, scored = (np.bincount(groups.astype(int), weight, 10) for weight in
                           (rows[:, 2], rows[:, 2] * rows[:, 0], rows[:, 2] * rows[:, 3]))  # fmt: skip
    return float(np.abs(expected - scored).sum() / n.sum())


def covered(ratings: Ratings, tried: Tried) -> list[bool]:
    """Return for each snapshot with a parent, if the interval of their gap holds the true gap."""
    if tried.theta is None:
        return []
    deviation, found = np.sqrt(ratings.variances()), []
    for child, parent in tried.parents.items():
        i, j = ratings.index(child), ratings.index(parent)
        gap = ELO * (tried.theta[child] - tried.theta[parent])
        found.append(bool(abs(ratings.elo[i] - ratings.elo[j] - gap) < 1.96 * deviation[i, j]))
    return found


def compared(leagues: list[Tried]) -> dict[str, dict]:
    """Fit all leagues with each prior and return the prior's figures."""
    found = {}
    for name, prior in PRIORS.items():
        rows, inside = [], []
        for tried in leagues:
            payoff = sum_matches([replace(m, pairs=PairCounts()) for m in tried.log])
            ratings = fit(payoff, prior=prior(payoff, tried.parents))
            rows.append(predictions(ratings, tried.held_out))
            inside += covered(ratings, tried)
        every = np.concatenate(rows)
        found[name] = {
            "log_loss": round(float(np.average(every[:, 1], weights=every[:, 2])), 5),
            "calibration_error": round(calibration_error(every), 4),
            **({"parent_gap_covered": round(float(np.mean(inside)), 3)} if inside else {}),
        }
    return found


def main() -> None:
    """Compare all priors and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--leagues", type=int, default=60, help="simulated leagues of each kind")
    parser.add_argument("--store", help="the store of a real league")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    result: dict = {"leagues": args.leagues, "simulated": {}, "real": {}}
    for name, (mean, deviation, n) in REGIMES.items():
        result["simulated"][name] = compared([simulated(mean, deviation, n, rng) for _ in range(args.leagues)])
    for n in (4, 16) if args.store else ():
        result["real"][f"{n} games a row"] = compared([thinned(args.store, n, rng) for _ in range(20)])
    report({**run_info(args.commit), **result}, args.out)


if __name__ == "__main__":
    main()
