"""HARL-A's curricula on one GPU, from the first stage to the matches: time until robots learn each stage, over seeds.

    python -m experiments.stages walk --seeds 1 2 3 --store runs/stages --out walk-h100.json
    python -m experiments.stages push-anymal --seeds 1 2 3 --store runs/stages --out push-h100.json
    python -m experiments.stages by-team-leapfrog --store runs/stages --out by-team-leapfrog-h100.json

Trains by `league run` with nothing else on the GPU, each seed in a store of its own. A stage that continues from others
finds their leagues in the same store; `--after` names policies that come with the league instead. Then every snapshot
plays `--episodes` new episodes: alone, against `idle`, or in a match against the initial snapshot of the other side,
which comes from the curriculum. A snapshot has succeeded when the lower end of its 95 % interval is above the stage's
threshold. The same command continues where it was stopped; arguments after `--` are further flags of `league run`.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from league.system.environment import prepare

prepare()  # before jax reads the environment

from experiments.ablations import CAREFUL, EASY, FREE, LONG, RESTLESS, STRONG, SUCCESS
from experiments.episodes import Pair, bare, rate, score
from league.config import experiment as configuration
from league.state.league_state import LeagueState
from scripts.record import make_parser, run_info, split_arguments, write
from storage.records import Player, Snapshot
from storage.store import Store

LEARNER = {
    "learner.architecture.hidden": "128,128,128", "learner.architecture.activation": "elu", "learner.lr": "1e-3",
    "learner.critic-lr": "1e-3", "learner.gamma": "0.99", "learner.initial-std": "0.6",
    "learner.normalise-observations": "true", "training.rollout_length": "24", "training.snapshots-per-doubling": "4",
    "training.iterations_per_turn": "32", "workers.match": "0",
}  # fmt: skip
"""As in the presets of these curricula."""

PUSH = {"training.shaping-steps": "50000000"}
MATCH = {
    "learner.lr": "3e-4", "learner.gamma": "0.995", "training.rollout_length": "48", "training.shaping-steps": "0",
    "training.snapshots-per-doubling": "2",
}  # fmt: skip
"""Reward by the outcome alone, and new critics: smaller learning rates, and a longer horizon."""
SCORE = SUCCESS | STRONG | LONG | RESTLESS | CAREFUL
TURNS = {"training.schedule.kind": "leapfrog", "training.schedule.period-steps": "10000000"}


@dataclass(frozen=True)
class Stage:
    """A stage: its arena, training time, threshold (`asked`), and the stages from which it continues."""

    arena: str
    train: str
    asked: float
    after: tuple[str, ...] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    against: Literal["", "idle", "initial"] = ""


BLOCKS = ("push-anymal", "push-leatherback")
SCORERS = ("soccer-score", "soccer-score-leatherback")
STAGES = {
    "walk": Stage("anymal-walk", "10m", 0.9),
    "push-anymal": Stage("block-push-anymal", "15m", 0.8, ("walk",), PUSH, "idle"),
    "push-leatherback": Stage("block-push-leatherback", "15m", 0.8, (), PUSH, "idle"),
    "by-team-simultaneous": Stage("sumo-by-team", "30m", 0.86, BLOCKS, MATCH, "initial"),
    "by-team-leapfrog": Stage("sumo-by-team", "30m", 0.86, BLOCKS, MATCH | TURNS, "initial"),
    "galaga-aim": Stage("galaga-aim-1v1", "5m", 0.9),
    "galaga-fly": Stage("galaga-fly-1v1", "5m", 0.9),
    "galaga-leapfrog": Stage("galaga-1v1", "15m", 0.92, ("galaga-aim", "galaga-fly"), MATCH | TURNS, "initial"),
    "galaga-aim-2v2": Stage("galaga-aim-2v2", "5m", 0.9),
    "galaga-fly-2v2": Stage("galaga-fly-2v2", "5m", 0.9),
    "galaga-2v2-leapfrog": Stage(
        "galaga-2v2", "15m", 0.92, ("galaga-aim-2v2", "galaga-fly-2v2"), MATCH | TURNS, "initial"
    ),
    "soccer-walk": Stage("soccer-walk", "10m", 0.9),
    "soccer-ball": Stage("soccer-ball", "10m", 0.9, ("soccer-walk",), PUSH),
    "soccer-score-easy": Stage("soccer-score", "5m", 0.7, ("soccer-ball",), SCORE | EASY),
    "soccer-score": Stage("soccer-score", "15m", 0.7, ("soccer-score-easy",), SCORE),
    "soccer-score-leatherback-easy": Stage("soccer-score-leatherback", "5m", 0.7, (), SCORE | FREE | EASY),
    "soccer-score-leatherback": Stage(
        "soccer-score-leatherback", "15m", 0.7, ("soccer-score-leatherback-easy",), SCORE | FREE
    ),
    "soccer-leapfrog": Stage("soccer-1v1", "30m", 0.74, SCORERS, MATCH | TURNS | FREE, "initial"),
    "soccer-2v2-leapfrog": Stage("soccer-2v2", "30m", 0.74, SCORERS, MATCH | TURNS | FREE, "initial"),
}


def main() -> None:
    """Train, play and write the JSON after each seed."""
    parser = make_parser(__doc__, out_required=True)
    parser.add_argument("stage", choices=STAGES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--store", type=Path, required=True, help="the folder for the seeds' stores")
    parser.add_argument("--train", help="training time (default: the stage's)")
    parser.add_argument("--after", nargs="*", help="continue from these leagues or policies (default: the stage's)")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--episodes", type=int, default=512, help="for each snapshot; 0: train only")
    parser.add_argument("--batch", type=int, default=8192, help="of them at once")
    own, further = split_arguments(sys.argv[1:])
    args = parser.parse_args(own, argparse.Namespace(flags=further))
    result = {**run_info(args.commit), "asked": STAGES[args.stage].asked, "seeds": []}
    for seed in args.seeds:
        store = args.store / f"seed{seed}"
        train(args, store, seed)
        if not args.episodes:
            continue
        result["seeds"].append({"seed": seed, **measure(args, store)})
        write(result, args.out)
        print(json.dumps({k: v for k, v in result["seeds"][-1].items() if k not in ("curve", "runs")}), flush=True)


def train(args: argparse.Namespace, store: Path, seed: int) -> None:
    """Train for the stage's time, in processes of its own."""
    stage = STAGES[args.stage]
    after = stage.after if args.after is None else args.after
    settings = {
        "store": str(store), "league": args.stage, "arena.name": stage.arena, **LEARNER, **stage.settings,
        "training.worlds": str(args.worlds), "seed": str(seed), "budget.training_time": args.train or stage.train,
        "budget.rating_time": "0s", **({"after": ",".join(after)} if after else {}),
    }  # fmt: skip
    flags = [f"--{name}={value}" for name, value in settings.items()]
    command = [sys.executable, "-m", "league", "run", *flags, *args.flags]
    if code := subprocess.run(command, check=False).returncode:
        sys.exit(code)  # it has printed the error


def measure(args: argparse.Namespace, where: Path) -> dict:
    """Play each snapshot's episodes; return the curve and the first snapshot above the threshold."""
    asked = STAGES[args.stage].asked
    with Store.open(where) as store:
        config = configuration.loads(store.league(args.stage).config)
        state = LeagueState.of(store, args.stage)
        last = state.newest
        assert last is not None
        pairs = opponents(state, STAGES[args.stage].against)
        began = time.monotonic()
        ladder, voids, _ = rate(store, config, args.stage, pairs, args.episodes, args.batch)
        curve = [
            {"snapshot": s.name, "seconds": round(s.seconds, 1), "steps": s.step, **score(ladder, s, other)}
            for s, other in pairs
        ]
        own = [s for s, _ in pairs]
        return {
            "training_seconds": round(last.seconds, 1),
            "iterations": last.iteration,
            "steps": last.step,
            "steps_per_second_learning_included": round(last.step / last.seconds),
            "against": STAGES[args.stage].against or None,
            "reached": {
                player.name: next((p for p in curve if p["low"] > asked and p["snapshot"] in names), None)
                for player in state.players
                for names in [{s.name for s in state.history(player.name)}]
            },
            "newest": [curve[own.index(state.history(player.name)[-1])] for player in state.players],
            "void_episodes": voids,
            "rating_seconds": round(time.monotonic() - began, 1),
            "runs": [bare(run.config) for run in store.runs(args.stage)],
            "curve": curve,
        }


def opponents(state: LeagueState, against: str) -> list[Pair]:
    """Return every snapshot of every player with its opponent; None in an arena of one team."""

    def other(player: Player) -> Snapshot | None:
        if against == "initial":
            (them,) = (p for p in state.players if p.team != player.team)
            return state.history(them.name)[0]
        return next((s for s in state.snapshots if s.script == against), None)

    return [(s, other(player)) for player in state.players for s in state.history(player.name)]


if __name__ == "__main__":
    main()
