"""How each main player of a league fares against what it was: its newest snapshot against its own earlier ones.

    league run --preset alphastar --budget.train 20m --budget.rate 0s --store runs/alphastar
    python benchmarks/history.py runs/alphastar --out benchmarks/results/alphastar-cpu.json

Every pair plays `--episodes` fresh episodes, half of them with sides swapped, on the league's own engine; of more than
`--earlier` snapshots those are taken that lie evenly in the player's history.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

import league  # noqa: E402
from benchmarks.episodes import Pair, rate, score  # noqa: E402
from benchmarks.record import commit, machine, tell  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.standing import Standing  # noqa: E402
from league.versions import versions  # noqa: E402


def main() -> None:
    """Play all pairs and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("--league", help="default: the one that ran last")
    parser.add_argument("--earlier", type=int, default=24, help="snapshots of each player at most")
    parser.add_argument("--episodes", type=int, default=128, help="of each pair")
    parser.add_argument("--batch", type=int, default=1024, help="of them at once")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with league.open(str(args.store), args.league) as opened:
        store, name = opened.store, opened.league
        config = configuration.loads(store.league(name).config)
        standing = Standing.of(store, name)
        pairs = list(met(standing, args.earlier))
        ladder, voids, _ = rate(store, config, name, pairs, args.episodes, args.batch)
        tell({
            "command": " ".join(["python", *sys.argv]), "commit": commit(), "machine": machine(),
            "versions": versions(), "arena": config.arena.name, "void_episodes": voids,
            "snapshots": {player.name: len(standing.history(player.name)) for player in standing.players},
            "table": [
                {"newest": a.name, "earlier": b.name, "seconds": round(b.seconds, 1), "steps": b.step}
                | score(ladder, a, b) for a, b in pairs if b
            ],
        }, args.out)  # fmt: skip


def met(standing: Standing, earlier: int) -> list[Pair]:
    """Each main player's newest snapshot with so many of its own before it."""
    pairs: list[Pair] = []
    for player in standing.players:
        own = standing.history(player.name)
        if player.role == "main" and len(own) > 1:
            chosen = np.unique(np.linspace(0, len(own) - 2, earlier).round().astype(int))
            pairs += [(own[-1], own[i]) for i in chosen]
    return pairs


if __name__ == "__main__":
    main()
