"""Roles of unlike team-mates in sumo: who ends whom, what robots drive at, where they stay, by seed.

    python -m experiments.roles OUT --episodes 256 --clips CLIPS --out experiments/results/roles-within-team-h100.json

OUT has a folder for each seed, in which `blue.safetensors` and `red.safetensors` are the newest policies of the last
stage, and `blue-0.safetensors` and `red-0.safetensors` the initial ones, as `league export` writes them. On the C
engine, on a host with a GPU best with JAX_PLATFORMS=cpu, these pairs play `--episodes` games each, the second half from
the same starts with sides swapped:

- each newest policy against its own initial one;
- the newest blue of each seed against the newest red of the same seed, and of every other seed (cross-play).

All games are recorded and measured: `experiments/role_metrics.py` defines the numbers. Intervals of 95 % count games,
not moments. With `--clips` the clearest examples become a recording (.mcap) and a film (.webp) each: a rover that ended
an ANYmal, an ANYmal that ended a rover, and the commonest other end (`experiments/role_clips.py`).
"""

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

from league.system.environment import prepare

prepare()  # before jax reads the environment

import numpy as np

from arenas.arena import Arena
from dashboards.system.temporary_folders import temporary_folder
from experiments.role_clips import INITIAL, Examples, write_clips
from experiments.role_metrics import Game, numbers_of_side, share_of_games, table_of_ends
from experiments.role_tracks import Observer
from league.config.experiment import default
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.runs.bench.metrics import cross_play
from league.runtime.bootstrap import create
from league.snapshots import policy_file
from league.snapshots.arena_transfer import elsewhere
from league.state.jobs import RatingMatch
from matchmaking.ratings.payoff import sum_matches
from scripts.record import make_parser, run_info, write
from storage.records import Match, Snapshot
from storage.store import Store

ARENA, LEAGUE = "sumo-within-team", "roles"
SIDES = ("blue", "red")
SHOWN = (
    "at legs", "driving at legs", "towards anymal", "towards leatherback", "centre", "outer fifth", "mate", "still",
    "still alone",
)  # fmt: skip


@dataclass(frozen=True)
class Club:
    """A league in a temporary store whose players are the policies of files."""

    store: Store
    arena: Arena
    evaluator: MatchEvaluator
    snapshots: dict[str, Snapshot]

    def policies(self) -> dict[str, dict[str, Any]]:
        """Return what JSON has of each policy; `learnt elsewhere` marks those of other rules or bodies."""
        return {
            name: {"sha256": s.digest, "steps": s.step, "learnt elsewhere": elsewhere(s, self.arena)}
            for name, s in self.snapshots.items()
        }

    def play(self, a: str, b: str, batches: int, examples: Examples) -> tuple[list[Match], list[Game]]:
        """Play a pair in so many batches; return their rows, and every game that is not void, measured."""
        observer, evaluator = Observer(self.arena), self.evaluator
        seats = evaluator.side_orders(self.snapshots[a], self.snapshots[b])
        rows: list[Match] = []
        found: list[Game] = []
        for number in range(batches):
            task = RatingMatch(((a, b),), crc32(f"{a}/{b}/{number}".encode()))
            played = evaluator.games(self.store, seats, task.seed)
            rows.append(evaluator.pair_match(played, 0, self.snapshots[a], self.snapshots[b], seats, task, None))
            recordings = evaluator.recordings(played, 0, seats, task.seed)
            for world, recording in enumerate(recordings):
                if not played.void[world]:
                    start = number * evaluator.each + world % evaluator.each
                    side = seats[world // evaluator.each].index(self.snapshots[a])
                    found.append(observer.game(recording, side, start))
                    examples.add(found[-1], recording, (a, b))
        return rows, found


@contextmanager
def club(folder: Path, seeds: Sequence[str], worlds: int) -> Iterator[Club]:
    """Yield the league of all seeds' policies, which plays and records `worlds` games at once.

    Raises StorageError, one line, for a file without a policy, or with one for other robots.
    """
    config = replace(default(ARENA), engine="c", league=LEAGUE)
    rating = replace(config.rating, worlds=worlds, pairings=1, record=True, trained=False, scripts=())
    config = replace(config, rating=rating)
    arena = config.arena.build(engine="c", worlds=worlds)
    with temporary_folder("robot-league-roles-") as kept, Store.open(kept, create=True) as store:
        create(store, config, arena)
        opened, snapshots = Open(store, LEAGUE), {}
        for seed in seeds:
            for name in (f"{side}{which}" for side in SIDES for which in ("", INITIAL)):
                policy = policy_file.read(folder / seed / f"{name}.safetensors")
                snapshots[f"{seed}:{name}"] = policy_file.bring_in(opened, policy, f"{seed}:{name}")
        evaluator = MatchEvaluator(config, arena, LEAGUE, tuple(range(worlds)))
        evaluator.make_room(store, list(snapshots.values()))
        yield Club(store, arena, evaluator, snapshots)


def pairs_of(seeds: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs that play: against the initial policies, blue against red of each seed, and cross-play."""
    against_initial = [(f"{seed}:{side}", f"{seed}:{side}{INITIAL}") for seed in seeds for side in SIDES]
    mirror = [(f"{seed}:blue", f"{seed}:red") for seed in seeds]
    return [*against_initial, *mirror, *((f"{a}:blue", f"{b}:red") for a in seeds for b in seeds if a != b)]


def is_mirror(a: str, b: str) -> bool:
    """Return whether two policies are the newest blue and red of one seed."""
    return not b.endswith(INITIAL) and a.partition(":")[0] == b.partition(":")[0]


def row_of(a: str, b: str, matches: Sequence[Match], games: Sequence[Game]) -> dict[str, Any]:
    """Return what JSON has of a pair; "a" and "b" in it are the two policies."""
    score = sum_matches(matches).score(a, b)
    starts = np.array([game.start for game in games])
    return {
        "a": a, "b": b,
        "score": {"score": round(score.score, 4), "low": round(score.low, 4), "high": round(score.high, 4)},
        "games": score.games, "voids": score.voids,
        "time was up": share_of_games(np.array([not game.ends for game in games]), starts),
        "lost": {"a": table_of_ends(games, of_a=True), "b": table_of_ends(games, of_a=False)},
        "robots": {"a": numbers_of_side(games, of_a=True), "b": numbers_of_side(games, of_a=False)},
    }  # fmt: skip


def between_seeds(matches: Sequence[Match], seeds: Sequence[str]) -> dict[str, Any]:
    """Return scores of every seed's blue against every seed's red, and their difference off the diagonal and on it.

    Its 95 % interval is of these seeds' games, whose variances add up; it says nothing of further seeds.
    """
    payoff = sum_matches(matches)
    blue, red = ([f"{seed}:{side}" for seed in seeds] for side in SIDES)
    found = cross_play(payoff, blue, red)
    scores = [[payoff.score(a, b) for b in red] for a in blue]
    halves = np.array([[(score.high - score.low) / 2 for score in row] for row in scores])
    own = np.eye(len(seeds), dtype=bool)
    half = np.sqrt(sum((halves[where] ** 2).sum() / where.sum() ** 2 for where in (own, ~own)))
    value = found["off_diagonal_less_diagonal"]
    return {**found, "low": round(float(value - half), 4), "high": round(float(value + half), 4)}


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Return the most telling figures as tables in Markdown: scores, and of the newest policies' games ends and roles.

    Ends are of games of one seed's blue against its red, from both sides; "(n)" counts those by a robot from inside.
    """
    mirrors = [row for row in rows if is_mirror(row["a"], row["b"])]
    lines = ["| policy | against | score | time was up |", "|---|---|---|---|"]
    for row in rows:
        told = f"{row['score']['score']:.1%} ({row['score']['low']:.1%}-{row['score']['high']:.1%})"
        lines.append(f"| {row['a']} | {row['b']} | {told} of {row['games']} | {row['time was up']['share']:.0%} |")
    enders = list(next(iter(rows[0]["lost"]["a"].values())))
    lines += ["", f"| seed | lost | {' | '.join(f'by {by}' for by in enders)} |", "|---" * (2 + len(enders)) + "|"]
    for row in mirrors:
        for lost in row["lost"]["a"]:
            cells = [[row["lost"][side][lost][by] for side in "ab"] for by in enders]
            counts = [f"{sum(c['games'] for c in both)} ({sum(c['inside'] for c in both)})" for both in cells]
            lines.append(f"| {row['a'].partition(':')[0]} | {lost} | {' | '.join(counts)} |")
    lines += ["", f"| policy | robot | {' | '.join(SHOWN)} |", "|---" * (2 + len(SHOWN)) + "|"]
    for row in mirrors:
        for side in "ab":
            for kind, found in row["robots"][side].items():
                lines.append(f"| {row[side]} | {kind} | {' | '.join(_text(found[name]) for name in SHOWN)} |")
    return "\n".join(lines)


def _text(found: dict[str, Any]) -> str:
    if found["mean"] is None:
        return "-"
    half = "" if found["low"] is None else f" ± {(found['high'] - found['low']) / 2:.2f}"
    return f"{found['mean']:.2f}{half}"


def parsed() -> argparse.Namespace:
    """Return the arguments."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, help="OUT, with a folder of four files for each seed")
    parser.add_argument("--seeds", nargs="+", help="names of those folders (default: all)")
    parser.add_argument("--episodes", type=int, default=256, help="games of each pair, a multiple of --worlds")
    parser.add_argument("--worlds", type=int, default=128, help="games at once, an even number")
    parser.add_argument("--clips", type=Path, help="write recordings and films of examples into this folder")
    args = parser.parse_args()
    args.seeds = args.seeds or sorted(path.parent.name for path in args.folder.glob("*/blue.safetensors"))
    if not args.seeds:
        parser.error(f"{args.folder} has no folder with a blue.safetensors")
    if args.worlds % 2 or args.episodes % args.worlds:
        parser.error("--episodes must be a multiple of --worlds, and --worlds even")
    return args


def main() -> None:
    """Play all pairs, measure them, print the figures and write JSON after each pair."""
    args = parsed()
    about = run_info(args.commit)
    for path, name in ((args.folder, "OUT"), (args.clips, "CLIPS")):
        about["command"] = about["command"].replace(str(path), name) if path else about["command"]
    examples, matches = Examples(), []
    result: dict[str, Any] = {**about, "arena": ARENA, "engine": "c", "seeds": args.seeds}
    with club(args.folder, args.seeds, args.worlds) as players:
        result["rules"], result["policies"] = players.arena.config_hash, players.policies()
        result["pairs"] = []
        for a, b in pairs_of(args.seeds):
            began = time.monotonic()
            rows, games = players.play(a, b, args.episodes // args.worlds, examples)
            matches += rows
            result["pairs"].append(row_of(a, b, rows, games))
            print(f"{a} against {b}: {len(games)} games, {time.monotonic() - began:.0f} s", flush=True)
            write(result, args.out)
    if len(args.seeds) > 1:
        result["cross_play"] = between_seeds(matches, args.seeds)
        print(json.dumps({"cross_play": result["cross_play"]}), flush=True)
    if args.clips:
        result["clips"] = list(write_clips(examples, args.clips))
        print(json.dumps({"clips": result["clips"]}), flush=True)
    write(result, args.out)
    print(tables(result["pairs"]))


if __name__ == "__main__":
    main()
