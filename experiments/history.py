"""Each main player of a league against its past: its newest snapshot plays its own earlier ones.

    league run --preset alphastar --budget.training_time 20m --budget.rating_time 0s --store runs/alphastar
    python -m experiments.history runs/alphastar --out experiments/results/alphastar-cpu.json

Every pair plays `--episodes` new episodes, half of them with sides swapped, on the league's own engine. If there are
more than `--earlier` snapshots, evenly spaced ones are taken.
"""

from pathlib import Path

import numpy as np

from league.system.environment import prepare

prepare()  # before jax reads the environment

import league
from experiments.episodes import Pair, rate, score
from league.config import experiment as configuration
from league.state.league_state import LeagueState
from scripts.record import make_parser, report, run_info


def main() -> None:
    """Play all pairs and write the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("--league", help="default: the one that ran last")
    parser.add_argument("--earlier", type=int, default=24, help="snapshots of each player at most")
    parser.add_argument("--episodes", type=int, default=128, help="of each pair")
    parser.add_argument("--batch", type=int, default=1024, help="of them at once")
    args = parser.parse_args()
    with league.open(str(args.store), args.league) as opened:
        store, name = opened.store, opened.league
        config = configuration.loads(store.league(name).config)
        state = LeagueState.of(store, name)
        pairs = list(met(state, args.earlier))
        ladder, voids, _ = rate(store, config, name, pairs, args.episodes, args.batch)
        report({
            **run_info(args.commit), "arena": config.arena.name, "void_episodes": voids,
            "snapshots": {player.name: len(state.history(player.name)) for player in state.players},
            "table": [
                {"newest": a.name, "earlier": b.name, "seconds": round(b.seconds, 1), "steps": b.step}
                | score(ladder, a, b) for a, b in pairs if b
            ],
        }, args.out)  # fmt: skip


def met(state: LeagueState, earlier: int) -> list[Pair]:
    """Return pairs of each main player's newest snapshot with up to `earlier` of its own before it."""
    pairs: list[Pair] = []
    for player in state.players:
        own = state.history(player.name)
        if player.role == "main" and len(own) > 1:
            chosen = np.unique(np.linspace(0, len(own) - 2, earlier).round().astype(int))
            pairs += [(own[-1], own[i]) for i in chosen]
    return pairs


if __name__ == "__main__":
    main()
