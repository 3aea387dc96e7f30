"""Coverage of the intervals of ratings that are fitted to rankings of four teams, and of those of scores.

    python -m experiments.rankings [--leagues N] [--out FILE]

Simulated leagues of eight snapshots with normal strengths. Lineups of four of them, drawn at random, play a number of
episodes each, whose rankings have the chances of Plackett and Luce's model with ties of two and three teams, or
without. All are fitted as in a league without parents. Prints JSON: how often the 95 % interval of a snapshot's Elo
above the mean holds the true one, and that of the gap between two snapshots; the mean error in Elo, and mean tie terms.
The same of scores: of one snapshot against another, against all others, and of the mean over these.

Then the four rotations of a lineup share seeds, as they do in a league. Each ranking alone still has the chances of the
model. With "luck of snapshots" the second to fourth ranking repeats the first with a probability of one half each. With
"luck of seats" the random parts of the four utilities are drawn, by a Gaussian copula, with a correlation of 0.7 for
the same seat in all rotations. The intervals are those with the clusters and, for comparison, with all taken as
independent; scores then count each two teams of a ranking as a game of their own.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from matchmaking.ratings.fit import ELO, Ratings, fit
from matchmaking.ratings.payoff import Payoff, sum_matches
from matchmaking.ratings.plackett_luce import ranking_chances
from matchmaking.ratings.scores import Score, mean_interval, score_interval
from scripts.record import make_parser, report, run_info
from storage.records import ArenaKey, RankedMatch, competition_ranks

SNAPSHOTS, TEAMS = 8, 4
TIES = {"no ties": {}, "ties": {2: 0.4, 3: 0.3}}
REPEATED, CORRELATION = 0.5, 0.7

Ranks = tuple[int, ...]
Play = Callable[[np.ndarray, int, np.random.Generator], list[list[Ranks]]]
"""A function of strengths (4,) and a number of seeds that returns for each seed the rankings of four rotations."""


def independent(ties: dict[int, float]) -> Play:
    """Return games that share nothing."""
    return lambda theta, seeds, rng: np.reshape(_drawn(theta, ties, seeds * TEAMS, rng), (seeds, TEAMS, TEAMS)).tolist()


def luck_of_snapshots(ties: dict[int, float]) -> Play:
    """Return games in which a seed favours the same snapshots from every seat."""

    def play(theta: np.ndarray, seeds: int, rng: np.random.Generator) -> list[list[Ranks]]:
        ranks = np.reshape(_drawn(theta, ties, seeds * TEAMS, rng), (seeds, TEAMS, TEAMS))
        repeated = rng.random((seeds, TEAMS, 1)) < REPEATED
        return np.where(repeated, ranks[:, :1], ranks).tolist()

    return play


def luck_of_seats(theta: np.ndarray, seeds: int, rng: np.random.Generator) -> list[list[Ranks]]:
    """Return games without ties in which a seed favours the same seats, whoever takes them.

    The order of utilities θ + G, with G of Gumbel's distribution, has the chances of Plackett and Luce's model.
    """
    of_seat, own = rng.normal(size=(seeds, TEAMS)), rng.normal(size=(seeds, TEAMS, TEAMS))
    seat = (np.arange(TEAMS) - np.arange(TEAMS)[:, None]) % TEAMS  # of each snapshot in each rotation
    normal = np.sqrt(CORRELATION) * of_seat[:, seat] + np.sqrt(1 - CORRELATION) * own
    utility = theta - np.log(-np.log(ndtr(normal)))
    return (1 + np.argsort(np.argsort(-utility, -1), -1)).tolist()


def _drawn(theta: np.ndarray, ties: dict[int, float], number: int, rng: np.random.Generator) -> np.ndarray:
    """Return rankings (number, 4)."""
    chances = ranking_chances(theta.tolist(), ties)
    return np.array(list(chances))[rng.choice(len(chances), number, p=list(chances.values()))]


def league(theta: np.ndarray, play: Play, lineups: int, n: int, rng: np.random.Generator) -> list[RankedMatch]:
    """Simulate n episodes of each of a number of lineups."""
    found, key = [], ArenaKey("tag", "0", "c")
    for number in range(lineups):
        who = rng.choice(len(theta), TEAMS, replace=False)
        seeds = [tuple(competition_ranks(ranks) for ranks in seed) for seed in play(theta[who], n // TEAMS, rng)]
        rankings, names = Counter(ranks for seed in seeds for ranks in seed), tuple(f"s{i}" for i in who)
        clusters = dict(Counter(seeds))
        found.append(RankedMatch("bench", key, names, rankings, 0, (0,) * TEAMS, number, seed_clusters=clusters))
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


def expected_scores(theta: np.ndarray, ties: dict[int, float], log: list[RankedMatch]) -> np.ndarray:
    """Return the expected score (8, 8) of each snapshot against each other in these lineups, nan without games."""
    points, games = np.zeros((2, len(theta), len(theta)))
    for match in log:
        who = np.array([int(name[1:]) for name in match.snapshots])
        chances = ranking_chances(theta[who].tolist(), ties)
        ranks, chance = np.array(list(chances)), np.array(list(chances.values()))
        ahead = (np.sign(ranks[:, None] - ranks[:, :, None]) + 1) / 2
        points[np.ix_(who, who)] += match.episodes * np.tensordot(chance, ahead, 1)
        games[np.ix_(who, who)] += match.episodes
    with np.errstate(invalid="ignore"):
        return points / np.where(np.eye(len(theta)), np.nan, games)


def covered_scores(payoff: Payoff, truth: np.ndarray) -> dict[str, list[tuple[bool, bool]]]:
    """Return for scores of each kind if their intervals hold the truth, and if those that ignore seeds do."""
    found: dict[str, list[tuple[bool, bool]]] = {"score": [], "score_of_all": [], "mean_score": []}
    for i, name in enumerate(payoff.names):
        met = [j for j, other in enumerate(payoff.names) if j != i and payoff.games[i, j]]
        others = [payoff.names[j] for j in met]
        wins, draws, losses = payoff.between(np.array(i), np.array(met))[:, :3].T
        low, high = score_interval(wins, draws, losses)
        for k, other in enumerate(others):
            found["score"].append(_both(payoff.score(name, other), (low[k], high[k]), truth[i, met[k]]))
        games = wins + draws + losses
        pooled = (games * truth[i, met]).sum() / games.sum()
        low, high = map(float, score_interval(wins.sum(), draws.sum(), losses.sum()))
        found["score_of_all"].append(_both(payoff.score(name, *others), (low, high), pooled))
        _, *ignoring = mean_interval(wins, draws, losses, np.zeros((len(met), 5)))
        found["mean_score"].append(_both(payoff.mean_score(name, *others), ignoring, truth[i, met].mean()))
    return found


def _both(score: Score, ignoring: Sequence[float], true: float) -> tuple[bool, bool]:
    return score.low <= true <= score.high, bool(ignoring[0] <= true <= ignoring[1])


def figures(
    play: Play, ties: dict[int, float], lineups: int, n: int, leagues: int, rng: np.random.Generator
) -> dict[str, object]:
    """Return the figures of leagues of one kind, and those of intervals that ignore seeds."""
    own, gaps, errors, terms, alone, gaps_alone, widths = [], [], [], [], [], [], []
    scores: dict[str, list[tuple[bool, bool]]] = {}
    for _ in range(leagues):
        theta = rng.normal(0, 1, SNAPSHOTS)
        log = league(theta, play, lineups, n, rng)
        payoff = sum_matches(log)
        ratings, ignoring = fit(payoff), fit(sum_matches([replace(m, seed_clusters={}) for m in log]))
        if len(ratings.names) < SNAPSHOTS:
            continue  # a snapshot was never drawn
        for found, (ratings_held, gaps_held) in (
            (ratings, (own, gaps)), (ignoring, (alone, gaps_alone)),
        ):  # fmt: skip
            held, held_gaps, error = covered(found, theta)
            ratings_held.append(held)
            gaps_held.append(held_gaps)
        for kind, held in covered_scores(payoff, expected_scores(theta, ties, log)).items():
            scores.setdefault(kind, []).extend(held)
        errors.append(error)
        terms.append([ratings.ties.get(k, 0.0) for k in ties])
        widths.append(np.mean(ratings.stderr / ignoring.stderr))
    return {
        "rating_covered": round(float(np.mean(own)), 4), "gap_covered": round(float(np.mean(gaps)), 4),
        "rating_covered_ignoring_seeds": round(float(np.mean(alone)), 4),
        "gap_covered_ignoring_seeds": round(float(np.mean(gaps_alone)), 4),
        "width_to_that_ignoring_seeds": round(float(np.mean(widths)), 3), "error_elo": round(float(np.mean(errors)), 1),
        "ties": {k: round(float(mean), 3) for k, mean in zip(ties, np.mean(terms, 0), strict=True)},
        **{f"{kind}_covered": round(float(np.mean(held, 0)[0]), 4) for kind, held in scores.items()},
        **{f"{kind}_covered_ignoring_seeds": round(float(np.mean(held, 0)[1]), 4) for kind, held in scores.items()},
    }  # fmt: skip


def main() -> None:
    """Simulate all kinds of leagues and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--leagues", type=int, default=400, help="simulated leagues of each kind")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    kinds = {f"independent, {name}": (independent(ties), ties) for name, ties in TIES.items()}
    kinds |= {f"luck of snapshots, {name}": (luck_of_snapshots(ties), ties) for name, ties in TIES.items()}
    kinds["luck of seats, no ties"] = luck_of_seats, {}
    found = {
        f"{name}, {lineups} lineups of {n} episodes": figures(play, ties, lineups, n, args.leagues, rng)
        for name, (play, ties) in kinds.items()
        for lineups, n in ((20, 4), (20, 16), (20, 64))
    }
    report({**run_info(args.commit), "leagues": args.leagues, "simulated": found}, args.out)


if __name__ == "__main__":
    main()
