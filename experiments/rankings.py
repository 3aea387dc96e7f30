"""Coverage of the intervals of ratings that are fitted to rankings of four teams.

    python -m experiments.rankings [--leagues N] [--out FILE]

Simulated leagues of eight snapshots with normal strengths. Lineups of four of them, drawn at random, play a number of
episodes each, whose rankings have the chances of Plackett and Luce's model with ties of two and three teams, or
without. All are fitted as in a league without parents. Prints JSON: how often the 95 % interval of a snapshot's Elo
above the mean holds the true one, and that of the gap between two snapshots; the mean error in Elo, and mean tie terms.
"""

from collections import Counter

import numpy as np

from matchmaking.ratings.fit import ELO, Ratings, fit
from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.plackett_luce import ranking_chances
from scripts.record import make_parser, report, run_info
from storage.records import ArenaKey, RankedMatch

SNAPSHOTS, TEAMS = 8, 4
TIES = {"no ties": {}, "ties": {2: 0.4, 3: 0.3}}


def league(
    theta: np.ndarray, ties: dict[int, float], lineups: int, n: int, rng: np.random.Generator
) -> list[RankedMatch]:
    """Simulate n episodes of each of a number of lineups."""
    found = []
    for number in range(lineups):
        who = rng.choice(len(theta), TEAMS, replace=False)
        chances = ranking_chances(theta[who].tolist(), ties)
        counts = rng.multinomial(n, list(chances.values()))
        rankings = Counter({ranks: int(k) for ranks, k in zip(chances, counts, strict=True) if k})
        key = ArenaKey("tag", "0", "c")
        found.append(RankedMatch("bench", key, tuple(f"s{i}" for i in who), rankings, 0, (0,) * TEAMS, seed=number))
    return found


def covered(ratings: Ratings, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return for each snapshot, and for each pair, if the interval holds the truth; and the root mean square error."""
    truth = ELO * theta[[int(name[1:]) for name in ratings.names]]
    truth = truth - truth.mean() + ratings.elo.mean()
    gaps, deviation = ratings.elo[:, None] - ratings.elo, np.sqrt(ratings.variances())
    pairs = np.triu_indices(len(truth), 1)
    inside = np.abs(gaps - (truth[:, None] - truth)) < ratings.quantile * deviation
    error = float(np.sqrt(np.mean((ratings.elo - truth) ** 2)))
    return (ratings.low < truth) & (truth < ratings.high), inside[pairs], error


def figures(ties: dict[int, float], lineups: int, n: int, leagues: int, rng: np.random.Generator) -> dict:
    """Return the figures of leagues of one kind."""
    own, gaps, errors, terms = [], [], [], []
    for _ in range(leagues):
        theta = rng.normal(0, 1, SNAPSHOTS)
        ratings = fit(sum_matches(league(theta, ties, lineups, n, rng)))
        if len(ratings.names) < SNAPSHOTS:
            continue  # a snapshot was never drawn
        each = covered(ratings, theta)
        own.append(each[0])
        gaps.append(each[1])
        errors.append(each[2])
        terms.append([ratings.ties.get(k, 0.0) for k in ties])
    return {
        "rating_covered": round(float(np.mean(own)), 4), "gap_covered": round(float(np.mean(gaps)), 4),
        "error_elo": round(float(np.mean(errors)), 1),
        "ties": {k: round(float(mean), 3) for k, mean in zip(ties, np.mean(terms, 0), strict=True)},
    }  # fmt: skip


def main() -> None:
    """Simulate all kinds of leagues and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--leagues", type=int, default=400, help="simulated leagues of each kind")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    found = {
        f"{name}, {lineups} lineups of {n} episodes": figures(ties, lineups, n, args.leagues, rng)
        for name, ties in TIES.items()
        for lineups, n in ((20, 4), (20, 16), (20, 64))
    }
    report({**run_info(args.commit), "leagues": args.leagues, "simulated": found}, args.out)


if __name__ == "__main__":
    main()
