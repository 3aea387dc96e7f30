"""Time of ratings: the fit of a log, and `league ratings` as a new process. Prints JSON.

    python -m benchmarks.ratings [--repeats 5] [--out benchmarks/results/ratings-cpu.json]

Logs are simulated: batches of 64 games, half of them with sides swapped, between random policies of known strength. A
fit is timed from the summed log, which the manager has; a query from the start of its process to its end. CPU time, of
all threads, stands beside wall-clock time: on a machine with other work it is the more reliable one.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from league.system import environment

environment.prepare()  # as every command does, before NumPy is loaded: one BLAS thread

import numpy as np

from matchmaking.ratings.davidson import davidson
from matchmaking.ratings.fit import ELO, fit
from matchmaking.ratings.payoff import sum_matches
from scripts.record import make_parser, report, run_info, spread
from storage.records import ArenaKey, Job, League, Match, PairCounts, Player, Snapshot
from storage.store import Store

FITS = {(200, 800_000): 0.1, (1000, 800_000): 1.0}  # policies and games -> seconds asked
QUERIES = {(200, 1_000_000): 0.7, (1000, 1_000_000): 1.5}
BATCH = 64
KEY = ArenaKey("sumo", "0", "c")


def name(policy: int) -> str:
    """Return the name of a policy; two lineages alternate."""
    return f"{('blue', 'red')[policy % 2]}@{policy // 2}"


def simulate(
    policies: int, games: int, rng: np.random.Generator, batch: int = BATCH
) -> tuple[list[Match], dict[str, float]]:
    """Return the rows of a log, and the strength of each policy in log odds."""
    theta = rng.normal(0, 1.5, policies)
    matches = []
    for row in range(games // batch):
        a, b = rng.choice(policies, 2, replace=False)
        outcomes = [davidson(np.array(sign * (theta[a] - theta[b]) + 0.2), np.log(0.5)) for sign in (1, -1)]
        first, second = (rng.choice([2, 1, 0], batch // 2, p=np.exp(o.log_likelihood)) for o in outcomes)
        home, away = np.bincount(first, minlength=3), np.bincount(2 - second, minlength=3)
        losses, draws, wins = (int(n) for n in home + away)
        pairs = PairCounts(*(int(n) for n in np.bincount(first + 2 - second, minlength=5)))
        side = [int(n) for n in home[::-1]]
        names = name(int(a)), name(int(b))
        matches.append(Match("bench", KEY, *names, wins, draws, losses, 0, *side, pairs, seed=row, id=row))
    return matches, {name(i): float(x) for i, x in enumerate(theta)}


def filled(folder: Path, policies: int, matches: list[Match]) -> None:
    """Create a store with this log."""
    with Store.open(folder, create=True) as store:
        store.create_league(League("bench", "[rating]\nvoid_limit = 0.05\n"))
        store.add_players(
            [Player("bench", player, team, "main", "rover") for team, player in enumerate(("blue", "red"))]
        )
        store.start_run("bench", "", "here", {})
        blob = store.blobs.put(b"policy")
        store.add_snapshots([
            Snapshot("bench", name(i), blob, "rover", name(i).partition("@")[0], initial=i < 2, iteration=i // 2,
                     parent=name(i - 2) if i > 1 else None)
            for i in range(policies)
        ])  # fmt: skip
        store.queue([Job("bench", "any", "all")])
        claimed = store.claim("bench", ["any"], "here:1:0", 600)
        assert claimed is not None
        store.finish(claimed[0], matches=matches)


def timed(work: Callable[[], object], repeats: int, of: int) -> dict:
    """Return wall-clock and CPU seconds of `work()`; `of` is `resource.RUSAGE_SELF` or `RUSAGE_CHILDREN`."""
    walls, processors = [], []
    for _ in range(repeats):
        before, start = resource.getrusage(of), time.perf_counter()
        work()
        walls.append(time.perf_counter() - start)
        after = resource.getrusage(of)
        processors.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return {"seconds": spread(walls), "processor_seconds": spread(processors)}


def fitted(policies: int, games: int, asked: float, repeats: int) -> dict:
    """Time the fit of a log, and return how often its 95 % intervals hold the true strengths."""
    matches, theta = simulate(policies, games, np.random.default_rng(0))
    payoff = sum_matches(matches)
    ratings = fit(payoff)
    truth = ELO * np.array([theta[each] for each in ratings.names])
    truth += ratings.elo.mean() - truth.mean()
    return {
        "policies": policies, "games": games, "pairs_that_met": len(payoff.first), "asked_seconds": asked,
        **timed(lambda: fit(payoff), repeats, resource.RUSAGE_SELF),
        "tally": timed(lambda: sum_matches(matches), repeats, resource.RUSAGE_SELF),
        "covered_by_95%": round(float(((ratings.low < truth) & (truth < ratings.high)).mean()), 3),
    }  # fmt: skip


def queried(policies: int, games: int, asked: float, repeats: int) -> dict:
    """Time `league ratings` on a store."""
    matches, _ = simulate(policies, games, np.random.default_rng(1))
    with tempfile.TemporaryDirectory() as folder:
        filled(Path(folder, "store"), policies, [replace(m, id=0) for m in matches])
        command = [sys.executable, "-m", "league", "ratings", "--store", str(Path(folder, "store"))]

        def ask() -> None:
            subprocess.run(command, check=True, capture_output=True, env={**os.environ, "COLUMNS": "120"})

        ask()  # byte code is compiled once
        took = timed(ask, repeats, resource.RUSAGE_CHILDREN)
    return {"snapshots": policies, "games": games, "match_rows": len(matches), "asked_seconds": asked, **took}


def main() -> None:
    """Measure and print the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    result = {
        "load_average_at_start": round(os.getloadavg()[0], 1),
        "fit": [fitted(*size, asked, args.repeats) for size, asked in FITS.items()],
        "league ratings": [queried(*size, asked, args.repeats) for size, asked in QUERIES.items()],
    }
    report({**run_info(args.commit), **result}, args.out)


if __name__ == "__main__":
    main()
