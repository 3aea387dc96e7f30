"""How long a query of the ratings takes: rows of matches to Elo with intervals. Prints JSON.

python benchmarks/ratings.py --policies 200 --games 800000
"""

import argparse
import json
import os
import platform
import time

import numpy as np

from matchmaking.payoff import tally
from matchmaking.ratings import davidson, fit
from storage.records import ArenaKey, Match, PairCounts


def simulate(policies: int, rows: int, episodes: int, rng: np.random.Generator) -> tuple[list[Match], np.ndarray]:
    """Rows of `episodes` games, half of them with sides swapped, between random policies of known strength."""
    theta = rng.normal(0, 1.5, policies)
    matches = []
    for row in range(rows):
        a, b = rng.choice(policies, 2, replace=False)
        outcome = [davidson(np.array(sign * (theta[a] - theta[b]) + 0.2), np.log(0.5)) for sign in (1, -1)]
        first, second = (rng.choice([2, 1, 0], episodes // 2, p=np.exp(o.log_likelihood)) for o in outcome)
        first_counts, second_counts = np.bincount(first, minlength=3), np.bincount(2 - second, minlength=3)
        losses, draws, wins = (int(n) for n in first_counts + second_counts)
        side = [int(n) for n in first_counts[::-1]]
        pairs = PairCounts(*(int(n) for n in np.bincount(first + 2 - second, minlength=5)))
        key = ArenaKey("sumo", "0", "c")
        names = f"{a:064d}", f"{b:064d}"
        matches.append(
            Match("bench", key, *names, wins, draws, losses, 0, side[0], side[1], side[2], pairs, seed=row, id=row)
        )
    return matches, theta


def seconds(work, repeats: int = 5) -> float:
    """Median wall-clock seconds of `work()`."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policies", type=int, default=200)
    parser.add_argument("--games", type=int, default=800_000)
    parser.add_argument("--episodes", type=int, default=64, help="games per row")
    args = parser.parse_args()
    rows = args.games // args.episodes
    matches, theta = simulate(args.policies, rows, args.episodes, np.random.default_rng(0))
    payoff = tally(matches)
    ratings = fit(payoff)
    truth = 1000 + 400 / np.log(10) * (theta - theta.mean())
    truth = truth[[int(name) for name in ratings.names]] + ratings.elo.mean() - truth.mean()
    print(
        json.dumps(
            {
                "machine": f"{platform.machine()} {platform.system()}, {os.cpu_count()} cores",
                "numpy": np.__version__,
                "policies": args.policies,
                "games": rows * args.episodes,
                "rows": rows,
                "pairs_that_met": len(payoff.first),
                "tally_s": round(seconds(lambda: tally(matches)), 4),
                "fit_s": round(seconds(lambda: fit(payoff)), 4),
                "covered_by_95%": round(float(((ratings.low < truth) & (truth < ratings.high)).mean()), 3),
                "side_advantage_elo": round(ratings.side_advantage, 1),
                "draw": round(ratings.draw, 3),
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
