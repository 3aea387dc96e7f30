"""Exact matches between policies of poker: which method's newest policies win, and which lose to their own past.

    python -m experiments.exact_matches leduc-poker --entries benchmarks/entries --store STORE --out ...

No game is played. With `--entries` the tables in the bench's entries of the game meet each other, with `--store` the
newest snapshots in the leagues of `experiments.baselines` meet their own earlier ones. All figures are expected chips a
hand, means over both seats:

- `wins`: of each method against each later one, the mean over all pairs of seeds, the lowest and the highest;
- `past`: of each main player's newest snapshot against each earlier one, oldest first, with the steps at which these
  were frozen; below 0 the newest loses to it;
- `forgets`: of each method, the mean over all players of the share of the past that beats the newest snapshot, and of
  the figure against the past as a whole and against its strongest snapshot, each with the lowest and highest seed.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from league.system.environment import prepare

prepare()  # before jax reads the environment

import league
from league.commands.cli import guarded
from league.matches.exact_exploitability import KnownGame
from league.runs.bench import entry_file
from league.state.league_state import LeagueState
from matchmaking.extensive_games.sequence_form import Plans, SequenceForm
from scripts.record import make_parser, run_info, write
from storage.store import Store

DIGITS = 4


def entered(known: KnownGame, form: SequenceForm, folder: Path) -> dict[str, list[Plans]]:
    """Return the plans of the tables in a folder's entries of a game, by method."""
    found = {}
    for entry in entry_file.folder(folder).values():
        if entry["task"] == f"t0-{known.name}-v1":
            tables = (dict(zip(known.known, np.array(row["table"]), strict=True)) for row in entry["rows"])
            found[entry["name"]] = [form.plans(table) for table in tables]
    return found


def wins(form: SequenceForm, plans: Mapping[str, list[Plans]]) -> dict[str, dict[str, Any]]:
    """Return what each method wins from each later one, over all pairs of seeds."""
    return {f"{a} against {b}": spread(form.payoffs(plans[a], plans[b])) for a, b in combinations(plans, 2)}


def spread(values: np.ndarray) -> dict[str, Any]:
    """Return mean, lowest and highest, and their number."""
    figures = {"mean": values.mean(), "lowest": values.min(), "highest": values.max()}
    return {**{name: round(float(value), DIGITS) for name, value in figures.items()}, "of": values.size}


def pasts(known: KnownGame, form: SequenceForm, where: Path) -> Iterator[dict[str, Any]]:
    """Yield for each main player of a store's leagues of a game what its newest snapshot wins from its earlier ones."""
    with Store.open(where) as store:
        names = sorted(each.name for each in store.leagues() if each.name.startswith(f"t0-{known.name}."))
    for name in names:
        _, method, seed = name.split(".")
        with league.open(str(where), name) as opened:
            state = LeagueState.of(opened.store, name)
            for player in state.players:
                history = state.history(player.name)
                if player.role != "main" or len(history) < 2:
                    continue
                plans = [form.plans(known.table_of(opened, snapshot)) for snapshot in history]
                figures = form.payoffs(plans[-1:], plans[:-1])[0]
                yield {
                    "method": method, "seed": int(seed[1:]), "player": player.name,
                    "steps": [snapshot.step for snapshot in history], "past": figures.round(DIGITS).tolist(),
                }  # fmt: skip


def forgets(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each method what its newest snapshots keep of their past, means of a seed's players."""
    found = {}
    measures = {"share that beats the newest": lambda past: (past < 0).mean(), "whole": np.mean, "strongest": np.min}
    for method in sorted({row["method"] for row in rows}):
        own = [row for row in rows if row["method"] == method]
        seeds = sorted({row["seed"] for row in own})
        found[method] = {"seeds": seeds} | {
            name: spread(np.array([
                np.mean([measure(np.array(row["past"])) for row in own if row["seed"] == seed]) for seed in seeds
            ])) for name, measure in measures.items()
        }  # fmt: skip
    return found


def main(argv: list[str] | None = None) -> int:
    """Compute what is asked for, print the summaries, and write JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("game", choices=["kuhn-poker", "leduc-poker"])
    parser.add_argument("--entries", type=Path, help="a folder of entries of the bench")
    parser.add_argument("--store", type=Path, help="the store of `experiments.baselines`")
    args: argparse.Namespace = parser.parse_args(argv)
    known = KnownGame(args.game)
    form = SequenceForm(known.rules)
    result: dict[str, Any] = {**run_info(args.commit), "game": args.game}
    if args.entries:
        result["wins"] = wins(form, entered(known, form, args.entries))
    if args.store:
        result["command"] = result["command"].replace(str(args.store), "STORE")
        rows = list(pasts(known, form, args.store))
        result |= {"forgets": forgets(rows), "past": rows}
    for what in ("wins", "forgets"):
        for name, row in result.get(what, {}).items():
            print(f"{what}: {name}: {row}", flush=True)
    write(result, args.out)
    return 0


if __name__ == "__main__":
    sys.exit(guarded(main))
