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
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

import numpy as np

from experiments.policy_files import (
    INITIAL,
    FileLeague,
    between_seeds,
    check_pairs,
    file_league,
    parser_of_pairs,
    score_of,
)
from experiments.role_clips import Examples, write_clips
from experiments.role_metrics import Game, numbers_of_side, share_of_games, table_of_ends
from experiments.role_tracks import Observer
from league.commands.cli import guarded
from league.config.experiment import default
from scripts.record import run_info, write
from storage.records import Match

ARENA, LEAGUE = "sumo-within-team", "roles"
SIDES = ("blue", "red")
SHOWN = (
    "at legs", "driving at legs", "towards anymal", "towards leatherback", "centre", "outer fifth", "mate", "still",
    "still alone",
)  # fmt: skip


def play(
    league: FileLeague, observer: Observer, a: str, b: str, batches: int, examples: Examples
) -> tuple[list[Match], list[Game]]:
    """Play a pair in so many batches; return their rows, and every game that is not void, measured."""
    rows: list[Match] = []
    found: list[Game] = []
    each = league.evaluator.each
    for number, batch in enumerate(league.batches(a, b, batches)):
        rows.append(batch.match)
        recordings = league.evaluator.recordings(batch.games, 0, batch.seats, batch.seed)
        for world, recording in enumerate(recordings):
            if not batch.games.void[world]:
                side = batch.seats[world // each].index(league.snapshots[a])
                found.append(observer.game(recording, side, number * each + world % each))
                examples.add(found[-1], recording, (a, b))
    return rows, found


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
    starts = np.array([game.start for game in games])
    return {
        **score_of(a, b, matches),
        "time was up": share_of_games(np.array([not game.ends for game in games]), starts),
        "lost": {"a": table_of_ends(games, of_a=True), "b": table_of_ends(games, of_a=False)},
        "robots": {"a": numbers_of_side(games, of_a=True), "b": numbers_of_side(games, of_a=False)},
    }  # fmt: skip


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
    parser = parser_of_pairs(__doc__)
    parser.add_argument("--clips", type=Path, help="write recordings and films of examples into this folder")
    args = parser.parse_args()
    check_pairs(parser, args, SIDES)
    return args


def main() -> int:
    """Play all pairs, measure them, print the figures and write JSON after each pair."""
    args = parsed()
    about = run_info(args.commit)
    for path, name in ((args.folder, "OUT"), (args.clips, "CLIPS")):
        about["command"] = about["command"].replace(str(path), name) if path else about["command"]
    examples, matches = Examples(), []
    result: dict[str, Any] = {**about, "arena": ARENA, "engine": "c", "seeds": args.seeds}
    with file_league(replace(default(ARENA), league=LEAGUE), args.folder, args.seeds, SIDES, args.worlds) as league:
        result |= {"rules": league.arena.config_hash, "policies": league.policies(), "pairs": []}
        observer = Observer(league.arena)
        for a, b in pairs_of(args.seeds):
            began = time.monotonic()
            rows, games = play(league, observer, a, b, args.episodes // args.worlds, examples)
            matches += rows
            result["pairs"].append(row_of(a, b, rows, games))
            print(f"{a} against {b}: {len(games)} games, {time.monotonic() - began:.0f} s", flush=True)
            write(result, args.out)
    if len(args.seeds) > 1:
        result["cross_play"] = between_seeds(matches, args.seeds, SIDES)
        print(json.dumps({"cross_play": result["cross_play"]}), flush=True)
    if args.clips:
        result["clips"] = list(write_clips(examples, args.clips))
        print(json.dumps({"clips": result["clips"]}), flush=True)
    write(result, args.out)
    print(tables(result["pairs"]))
    return 0


if __name__ == "__main__":
    sys.exit(guarded(main))
