"""Number of worlds that reaches a fixed score in the shortest training time on one GPU.

    python -m experiments.worlds walk --worlds 2048 4096 8192 16384 --store runs/worlds --out walk-worlds-h100.json
    python -m experiments.worlds push --worlds 2048 4096 8192 16384 --store runs/worlds --out push-worlds-h100.json

Each number of worlds trains a league of its own by `league run`, without matches and with nothing else on the GPU:
`walk` is the ANYmal alone, until 90 % succeed; `push` is the ANYmals' block pushing, until they score 80 % against
`idle`, and continues from a walk (`--after`; trained first if the store has none). Then snapshots play `--episodes` new
episodes each. The result has the seconds of training at which the score crosses the threshold, interpolated linearly
between two snapshots, and at which the lower end of its 95 % interval is first above it. Results in the file are not
repeated, and no number of worlds is begun with less than `--each` seconds of `--within` left: the same command
continues. Arguments after `--` are further flags of `league run`. `league/system/batch_sizes.py` has the table that
this experiment supports. Prints and writes JSON after each number of worlds.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from league.system.environment import prepare

prepare()  # before jax reads the environment

from experiments.episodes import rate, score
from experiments.stages import LEARNER, PUSH, opponents
from league.config import experiment as configuration
from league.state.league_state import LeagueState
from scripts.record import make_parser, run_info, split_arguments, write
from storage.errors import StorageError
from storage.store import Store


class Task(NamedTuple):
    """A task and its threshold (`asked`)."""

    arena: str
    asked: float
    train: int  # seconds at most
    against: str  # opponent of the snapshots; empty in an arena of one team


TASKS = {
    "walk": Task("anymal-walk", 0.9, 90, ""),
    "push": Task("block-push-anymal", 0.8, 150, "idle"),
}


def main() -> None:
    """Measure what is not in the file, while there is time."""
    parser = make_parser(__doc__, out_required=True)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--worlds", type=int, nargs="+", default=[2048, 4096, 8192, 16384])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--store", type=Path, required=True, help="the folder for the leagues' store")
    parser.add_argument("--train", type=int, help="seconds of training of each league at most")
    parser.add_argument("--arena", help="another arena, to test the script")
    parser.add_argument("--after", help="the league of the walk from which `push` continues (default: its own)")
    parser.add_argument("--episodes", type=int, default=256, help="for each snapshot")
    parser.add_argument("--snapshots", type=int, default=16, help="newest of each player that play")
    parser.add_argument("--within", type=float, default=560.0, help="seconds for everything")
    parser.add_argument("--each", type=float, default=190.0, help="seconds that a number of worlds takes at most")
    own, further = split_arguments(sys.argv[1:])
    args = parser.parse_args(own, argparse.Namespace(flags=further))
    task, began = TASKS[args.task], time.monotonic()
    rows = json.loads(args.out.read_text())["rows"] if args.out.exists() else []
    done = {(row["worlds"], row["seed"]) for row in rows}
    for seed in args.seeds:
        for worlds in args.worlds:
            if (worlds, seed) in done:
                continue
            if time.monotonic() - began > args.within - args.each:
                print(f"no time for {worlds} worlds, seed {seed}: give the same command again", flush=True)
                return
            rows.append(measured(args, task, worlds, seed))
            print(json.dumps({k: v for k, v in rows[-1].items() if k != "curve"}), flush=True)
            write({**run_info(args.commit), "asked": task.asked, "rows": rows}, args.out)


def measured(args: argparse.Namespace, task: Task, worlds: int, seed: int) -> dict:
    """Train with this number of worlds, rate snapshots, and return when they reached the threshold."""
    name, started = f"{args.task}-{worlds}-{seed}", time.monotonic()
    after = walk(args, seed) if args.task == "push" else ""
    seconds, settings = args.train or task.train, PUSH if args.task == "push" else {}
    first = train(args, name, args.arena or task.arena, worlds, seed, seconds, after, settings)
    with Store.open(args.store) as store:
        config = configuration.loads(store.league(name).config)
        state = LeagueState.of(store, name)
        chosen = {s.name for p in state.players for s in state.history(p.name)[-args.snapshots :]}
        pairs = [pair for pair in opponents(state, task.against) if pair[0].name in chosen]
        ladder, voids, _ = rate(store, config, name, pairs, args.episodes, 4096)
        last = state.newest
        assert last is not None
        curve = [
            {"snapshot": s.name, "player": s.player, "seconds": round(s.seconds, 1), "steps": s.step,
             **score(ladder, s, other)}
            for s, other in pairs
        ]  # fmt: skip
    crossed = {p.name: crossing([row for row in curve if row["player"] == p.name], task.asked)
               for p in state.players}  # fmt: skip
    known = [at for at in crossed.values() if at is not None]
    return {
        "worlds": worlds, "seed": seed, "training_seconds": round(last.seconds, 1), "iterations": last.iteration,
        "steps": last.step, "steps_per_second_learning_included": round(last.step / last.seconds),
        "seconds_to_asked": crossed, "mean_seconds_to_asked": round(sum(known) / len(known), 1) if known else None,
        "surely": {
            p.name: next((r["seconds"] for r in curve if r["player"] == p.name and r["low"] > task.asked), None)
            for p in state.players
        },
        "void_episodes": voids, "wall_seconds": round(time.monotonic() - started, 1), "first_line": first,
        "curve": curve,
    }  # fmt: skip


def walk(args: argparse.Namespace, seed: int) -> str:
    """Return the name of a walk's league in the store, trained if there is none."""
    name = args.after or f"walk-4096-{seed}"
    with suppress(StorageError), Store.open(args.store) as store:
        if name in {league.name for league in store.leagues()}:
            return name
    train(args, name, args.arena or TASKS["walk"].arena, 4096, seed, TASKS["walk"].train, "", {})
    return name


def train(
    args: argparse.Namespace, name: str, arena: str, worlds: int, seed: int, seconds: int, after: str,
    further: dict[str, str],
) -> str:  # fmt: skip
    """Train a league for `seconds`; return the first line of the run's output.

    Training episodes cannot decide when to stop: successful ones end early, so most ended episodes are successes.
    """
    settings = {
        **LEARNER, **further, "store": str(args.store.resolve()), "league": name, "arena.name": arena,
        "training.worlds": str(worlds), "training.iterations_per_turn": "8", "seed": str(seed),
        "budget.training_time": f"{seconds}s", "budget.rating_time": "0s", **({"after": after} if after else {}),
    }  # fmt: skip
    flags = [f"--{key}={value}" for key, value in settings.items()]
    command = [sys.executable, "-m", "league", "run", *flags, *args.flags]
    log = args.store / f"{name}.txt"
    args.store.mkdir(parents=True, exist_ok=True)
    with log.open("w") as out:
        done = subprocess.run(command, stdout=out, stderr=subprocess.STDOUT, check=False)
    if done.returncode:
        sys.exit(f"the league failed:\n{log.read_text()}")
    return log.read_text().splitlines()[0]


def crossing(curve: Sequence[dict], asked: float) -> float | None:
    """Return the second of training after which the score stays above the threshold, interpolated linearly."""
    below = max((i for i, row in enumerate(curve) if row["score"] < asked), default=None)
    if below is None:
        return curve[0]["seconds"] if curve else None
    if below + 1 == len(curve):
        return None
    a, b = curve[below], curve[below + 1]
    part = (asked - a["score"]) / (b["score"] - a["score"])
    return round(a["seconds"] + part * (b["seconds"] - a["seconds"]), 1)


if __name__ == "__main__":
    main()
