"""HARL-A's curricula on one GPU, from the first stage to the matches: how soon robots learn them, over seeds.

    python benchmarks/stages.py walk --seeds 1 2 3 --store runs/stages --out benchmarks/results/walk-h100.json
    python benchmarks/stages.py push-anymal --seeds 1 2 3 --store runs/stages --out benchmarks/results/push-h100.json
    python benchmarks/stages.py by-team-leapfrog --store runs/stages --out benchmarks/results/by-team-leapfrog-h100.json

Trains by `league run` with nothing else on the GPU, each seed in a store of its own; a stage that goes on from others
finds their leagues in the same store, or, by `--after`, policies that come with the league. Then every snapshot plays
`--episodes` fresh episodes: alone, against `idle`, or in a match against the other side's initial snapshot, the one
that leaves the curriculum. A snapshot has succeeded where the lower end of its 95 % interval is above what the stage
asks. The same command goes on where it was stopped; what follows `--` are
further flags of `league run`.
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

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

from benchmarks.ablations import CAREFUL, EASY, FREE, LONG, RESTLESS, STRONG, SUCCESS  # noqa: E402
from benchmarks.episodes import Pair, bare, rate, score  # noqa: E402
from benchmarks.record import commit, machine, own_and_further  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.standing import Standing  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.records import Player, Snapshot  # noqa: E402
from storage.store import Store  # noqa: E402

LEARNER = {
    "learner.architecture.hidden": "128,128,128", "learner.architecture.activation": "elu", "learner.lr": "1e-3",
    "learner.critic-lr": "1e-3", "learner.gamma": "0.99", "learner.initial-std": "0.6",
    "learner.normalise-observations": "true", "training.rollout": "24", "training.snapshots-per-doubling": "4",
    "training.turn": "32", "workers.match": "0",
}  # fmt: skip
"""As in the presets of these curricula."""

PUSH = {"training.shaping-steps": "50000000"}
MATCH = {
    "learner.lr": "3e-4", "learner.gamma": "0.995", "training.rollout": "48", "training.shaping-steps": "0",
    "training.snapshots-per-doubling": "2",
}  # fmt: skip
"""The outcome alone as reward, and fresh critics: smaller steps, and a longer view."""
SCORE = SUCCESS | STRONG | LONG | RESTLESS | CAREFUL
TURNS = {"training.schedule.kind": "leapfrog", "training.schedule.period-steps": "10000000"}


@dataclass(frozen=True)
class Stage:
    """A stage to be shown: where, for how long, what is asked, and from which stage it goes on."""

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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", choices=STAGES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--store", type=Path, required=True, help="the folder for the seeds' stores")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--train", help="train for so long (default: as the stage says)")
    parser.add_argument("--after", nargs="*", help="go on from these leagues or policies (default: as the stage says)")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--episodes", type=int, default=512, help="for each snapshot; 0: train only")
    parser.add_argument("--batch", type=int, default=8192, help="of them at once")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    own, further = own_and_further(sys.argv[1:])
    args = parser.parse_args(own, argparse.Namespace(flags=further))
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": args.commit or commit(), "machine": machine(),
        "versions": versions(), "asked": STAGES[args.stage].asked, "seeds": [],
    }  # fmt: skip
    for seed in args.seeds:
        store = args.store / f"seed{seed}"
        train(args, store, seed)
        if not args.episodes:
            continue
        result["seeds"].append({"seed": seed, **measure(args, store)})
        args.out.write_text(json.dumps(result, indent=1) + "\n")
        print(json.dumps({k: v for k, v in result["seeds"][-1].items() if k not in ("curve", "runs")}), flush=True)


def train(args: argparse.Namespace, store: Path, seed: int) -> None:
    """Train until the stage's time is over, in processes of its own."""
    stage = STAGES[args.stage]
    after = stage.after if args.after is None else args.after
    settings = {
        "store": str(store), "league": args.stage, "arena.name": stage.arena, **LEARNER, **stage.settings,
        "training.worlds": str(args.worlds), "seed": str(seed), "budget.train": args.train or stage.train,
        "budget.rate": "0s", **({"after": ",".join(after)} if after else {}),
    }  # fmt: skip
    flags = [f"--{name}={value}" for name, value in settings.items()]
    command = [sys.executable, "-m", "league", "run", *flags, *args.flags]
    if code := subprocess.run(command, check=False).returncode:
        sys.exit(code)  # it has said why


def measure(args: argparse.Namespace, where: Path) -> dict:
    """Play each snapshot's episodes, and tell the curve and when it had what is asked."""
    asked = STAGES[args.stage].asked
    with Store.open(where) as store:
        config = configuration.loads(store.league(args.stage).config)
        standing = Standing.of(store, args.stage)
        last = standing.newest
        assert last is not None
        pairs = opponents(standing, STAGES[args.stage].against)
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
                for player in standing.players
                for names in [{s.name for s in standing.history(player.name)}]
            },
            "newest": [curve[own.index(standing.history(player.name)[-1])] for player in standing.players],
            "void_episodes": voids,
            "rating_seconds": round(time.monotonic() - began, 1),
            "runs": [bare(run.config) for run in store.runs(args.stage)],
            "curve": curve,
        }


def opponents(standing: Standing, against: str) -> list[Pair]:
    """Every snapshot of every player, with whom it is tried against; nobody in an arena of one team."""

    def other(player: Player) -> Snapshot | None:
        if against == "initial":
            (them,) = (p for p in standing.players if p.team != player.team)
            return standing.history(them.name)[0]
        return next((s for s in standing.snapshots if s.script == against), None)

    return [(s, other(player)) for player in standing.players for s in standing.history(player.name)]


if __name__ == "__main__":
    main()
