"""Seconds from nothing to a fixed strength: wall clock from the command on, compiling and rating matches included.

    python -m benchmarks.strength rovers walk --store runs/strength --out benchmarks/results/strength-h200.json
    python -m benchmarks.strength by-team soccer galaga --seeds 1 2 3 --within 900 --store ... --out ...

Each row runs `league run` as typed, with nothing else on the device, until the run ends, `--within` seconds are over,
or the league's own ratings show the strength. Then snapshots of all players play `--episodes` new episodes each against
the row's opponents; in an arena of one team they succeed or fail. The strength is reached with the first snapshot whose
95 % interval begins above the bar, and the seconds are those from the command to its commit in the store. Bars:

| row | bar |
|---|---|
| `rovers` | two Leatherbacks against two: each side scores 75 % against `pusher` |
| `walk` | an ANYmal walks to its goal in 90 % of episodes |
| `by-team` | the curriculum of `sumo-by-team`: ANYmals score 86 % against the shipped `leatherbacks-sumo` |
| `soccer` | two ANYmals against two Leatherbacks, over skills: each side scores 75 % against the shipped scorers |
| `galaga` | the curriculum of `galaga-1v1`: 92 % for the tank, 61 % for the drone (HARL-A's), against first opponents |

`stages` has for each stage of a curriculum the seconds from the command to its beginning (its league is in the store),
its first learning step (as in `start.py`, so without compilation) and its end (the last checkpoint or rating match).

Results in the file are not repeated; arguments after `--` are further flags of `league run`. Prints and writes JSON
after each row, with median and worst of its seeds.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from league.system.environment import prepare

prepare()  # before jax reads the environment

from experiments.episodes import rate, score
from experiments.trials import run_within, stage_times
from league.config import experiment as configuration
from league.state.league_state import LeagueState
from scripts.record import make_parser, run_info, split_arguments, write
from storage.errors import StorageError
from storage.records import Snapshot
from storage.store import Store


class Bar(NamedTuple):
    """The strength that a player must reach; without an opponent a share of successes."""

    opponent: str
    score: float


class Row(NamedTuple):
    """A run, and the bars of its players."""

    flags: tuple[str, ...]
    bars: Mapping[str, Bar]


ROWS = {
    "rovers": Row(("--preset", "rovers"), dict.fromkeys(("blue", "red"), Bar("pusher", 0.75))),
    "walk": Row(("--preset", "walk"), {"blue": Bar("", 0.9)}),
    "by-team": Row(("--preset", "sumo-by-team"), {"blue": Bar("leatherbacks-sumo", 0.86)}),
    "soccer": Row(("--preset", "soccer-2v2-skills"), {"blue": Bar("red@0", 0.75), "red": Bar("blue@0", 0.75)}),
    "galaga": Row(("--preset", "galaga-1v1"), {"blue": Bar("red@0", 0.92), "red": Bar("blue@0", 0.61)}),
}


def main() -> None:
    """Measure the rows that are not in the file."""
    parser = make_parser(__doc__, out_required=True)
    parser.add_argument("rows", nargs="+", choices=ROWS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--store", type=Path, required=True, help="the folder for the leagues' stores")
    parser.add_argument("--within", type=float, default=540.0, help="seconds of a run at most")
    parser.add_argument("--episodes", type=int, default=512, help="for each snapshot")
    parser.add_argument("--snapshots", type=int, default=24, help="newest of each player that play")
    own, further = split_arguments(sys.argv[1:])
    args = parser.parse_args(own, argparse.Namespace(flags=further))
    found = json.loads(args.out.read_text())["runs"] if args.out.exists() else []
    for name in args.rows:
        for seed in args.seeds:
            if any((run["row"], run["seed"]) == (name, seed) for run in found):
                continue
            found.append(measured(args, name, seed))
            print(json.dumps({k: v for k, v in found[-1].items() if k != "snapshots"}), flush=True)
            write({**run_info(args.commit), "rows": {n: summary(n, found) for n in ROWS}, "runs": found}, args.out)


def summary(name: str, runs: list[dict]) -> dict:
    """Return median and worst seconds of a row's seeds; None where a seed did not reach the bar in time."""
    took = [run["seconds"] for run in runs if run["row"] == name]
    reached = [each for each in took if each is not None]
    return {
        "seeds": len(took),
        "median": statistics.median(reached) if reached and len(reached) == len(took) else None,
        "worst": max(reached) if reached and len(reached) == len(took) else None,
    }


def measured(args: argparse.Namespace, name: str, seed: int) -> dict:
    """Run a row with one seed, and return when it reached its bars."""
    row, where = ROWS[name], args.store / f"{name}-{seed}"
    command = [
        sys.executable, "-m", "league", "run", *row.flags, "--store", str(where), "--league", name, "--seed", str(seed),
        "--budget.rating_time", "0s", *args.flags,
    ]  # fmt: skip
    where.mkdir(parents=True, exist_ok=True)
    began = run_within(command, where / "out.txt", args.within, lambda: shown(where, row))
    curve = played(args, where, row)
    at = {player: reached(curve[player], bar, began) for player, bar in row.bars.items()}
    known = [each for each in at.values() if each is not None]
    return {
        "row": name, "seed": seed, "command": " ".join(command[2:]).replace(str(where), "STORE"),
        "bars": {player: bar._asdict() for player, bar in row.bars.items()}, "seconds_by_player": at,
        "seconds": max(known) if len(known) == len(at) else None, "stages": stage_times(where, began),
        "snapshots": curve,
    }  # fmt: skip


def last_league(store: Store) -> str | None:
    """Return the league that plays: of a curriculum its last stage, once that has begun."""
    names = [league.name for league in store.leagues()]
    whole = min(names, key=len, default=None)
    stages = configuration.loads(store.league(whole).config).stages if whole else ()
    last = f"{whole}.{stages[-1].name}" if stages else whole
    return last if last in names else None


def shown(where: Path, row: Row) -> bool:
    """Return whether the league's own matches show that each player's newest rated snapshot is above its bar."""
    with suppress(StorageError, FileNotFoundError), Store.open(where) as store:
        if (league := last_league(store)) is None:
            return False
        state = LeagueState.of(store, league)
        return all(any(above(state, s, bar) for s in state.history(player)) for player, bar in row.bars.items())
    return False


def above(state: LeagueState, snapshot: Snapshot, bar: Bar) -> bool:
    """Return whether a snapshot's rated games are surely above the bar."""
    ladder = state.ladder
    if snapshot.name not in ladder.payoff.names or (bar.opponent and bar.opponent not in ladder.payoff.names):
        return False
    found = ladder.score(snapshot.name, bar.opponent) if bar.opponent else ladder.success(snapshot.name)
    return found.games > 0 and found.low > bar.score


def played(args: argparse.Namespace, where: Path, row: Row) -> dict[str, list[dict]]:
    """Play the newest snapshots of each player against its opponent; return their scores, oldest first."""
    with Store.open(where) as store:
        league = last_league(store)
        if league is None:
            return {player: [] for player in row.bars}
        config, state = configuration.loads(store.league(league).config), LeagueState.of(store, league)
        by_name = {s.name: s for s in state.snapshots}
        pairs = [
            (s, by_name[bar.opponent] if bar.opponent else None, player)
            for player, bar in row.bars.items() for s in state.history(player)[-args.snapshots :]
        ]  # fmt: skip
        ladder, _, _ = rate(store, config, league, [pair[:2] for pair in pairs], args.episodes, 4096)
        curve: dict[str, list[dict]] = {player: [] for player in row.bars}
        for s, other, player in pairs:
            about = {"snapshot": s.name, "created": s.created, "training_seconds": round(s.seconds, 1), "steps": s.step}
            curve[player].append({**about, **score(ladder, s, other)})
    return curve


def reached(curve: list[dict], bar: Bar, began: float) -> float | None:
    """Return the seconds from the command to the first snapshot surely above the bar; None without one."""
    first = next((each for each in curve if each["low"] > bar.score), None)
    return None if first is None else round(first["created"] - began, 1)


if __name__ == "__main__":
    main()
